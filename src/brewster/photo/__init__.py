"""Reads and writes photos. A `Photo` has the stored pixels, their colour space and the metadata of
their file.

    photo = Photo.open("window.jpg")
    photo.with_linear(photo.linear() * 0.5).save("darker.jpg")

Only this package imports pyvips. OpenEXR, pillow-heif and rawpy are imported when a file needs
them.
"""

from brewster.base.files import DEFAULT_MAX_PIXELS
from brewster.photo.decode import read_size
from brewster.photo.file_info import FileInfo
from brewster.photo.formats.hdr import read_exr_layers, write_exr_layers
from brewster.photo.in_memory import Encoding
from brewster.photo.mask import Hints, Mask
from brewster.photo.photo import Photo, Source

__all__ = [
    "DEFAULT_MAX_PIXELS",
    "Encoding",
    "FileInfo",
    "Hints",
    "Mask",
    "Photo",
    "Source",
    "read_exr_layers",
    "read_size",
    "write_exr_layers",
]
