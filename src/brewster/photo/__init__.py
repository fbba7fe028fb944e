"""Photographs in and out: `Photo` keeps the stored pixels and knows their light and their file.

    photo = Photo.open("window.jpg")
    photo.with_linear(photo.linear() * 0.5).save("darker.jpg")

pyvips is used in this room only (decode, encode), OpenEXR and pillow-heif only when such a file comes along.
"""

from brewster.files import DEFAULT_MAX_PIXELS
from brewster.photo.decode import read_size
from brewster.photo.file_info import DEPTHS, FileInfo
from brewster.photo.hdr_formats import read_layers, write_layers
from brewster.photo.photo import Encoding, Photo, Source

__all__ = [
    "DEFAULT_MAX_PIXELS",
    "DEPTHS",
    "Encoding",
    "FileInfo",
    "Photo",
    "Source",
    "read_layers",
    "read_size",
    "write_layers",
]
