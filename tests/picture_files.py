"""Image files as other programs write them. PIL is the independent reader and writer of the
tests.
"""

import io
import struct
import zlib

import numpy as np
import pyvips
from PIL import Image

P3 = bytes(pyvips.Image.profile_load("p3"))
"""The ICC profile of Display P3."""


def smooth(height: int = 48, width: int = 64) -> np.ndarray:
    """Returns an image with smooth gradients, (height, width, 3) uint8."""
    down, across = np.mgrid[:height, :width]
    return np.stack([down * 3, across * 3, 255 - down - across], axis=2).astype(np.uint8)


def random_image(height=24, width=40, channels=3, dtype=np.uint8, seed=1) -> np.ndarray:
    """Returns an image of random integers, (height, width, channels)."""
    levels = np.iinfo(dtype).max + 1
    return np.random.default_rng(seed).integers(0, levels, (height, width, channels), dtype)


def file_of(image: np.ndarray | Image.Image, kind: str, **options: object) -> bytes:
    """Returns the file that PIL writes."""
    file = io.BytesIO()
    image = image if isinstance(image, Image.Image) else Image.fromarray(image.squeeze())
    image.save(file, kind, **options)
    return file.getvalue()


def png_chunk(name: bytes, content: bytes) -> bytes:
    return (
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
    )


def png_with(*chunks: tuple[bytes, bytes], array: np.ndarray | None = None) -> bytes:
    """Returns a PNG with chunks (name, content) after its header."""
    data = file_of(smooth() if array is None else array, "PNG")
    return b"".join((data[:33], *(png_chunk(*chunk) for chunk in chunks), data[33:]))


def tiff_with(array: np.ndarray, *tags: tuple, **options: object) -> bytes:
    """Returns the file that tifffile writes, with tags (number, type, count, value)."""
    import tifffile  # noqa: PLC0415  (few tests need it)

    file = io.BytesIO()
    kind = {"photometric": "rgb" if array.ndim == 3 else "minisblack", "metadata": None}
    tifffile.imwrite(file, array, extratags=[(*tag, True) for tag in tags], **{**kind, **options})
    return file.getvalue()


def exr_of(channels: dict[str, np.ndarray], **header: object) -> bytes:
    """Returns the file that OpenEXR writes."""
    import OpenEXR  # noqa: PLC0415  (few tests need it)

    file = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    channels = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    OpenEXR.File(header, channels).write(file)
    return file.getvalue()


def pil(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data))


def exif_block(orientation: int = 6) -> bytes:
    """Returns an EXIF block as cameras write it: big-endian, with a maker note, a date, and GPS."""
    exif = Image.Exif()
    exif.endian = ">"
    exif[274] = orientation
    exif[271] = "Sextant"
    exif[306] = "2020:01:02 03:04:05"
    exif.get_ifd(34665).update(
        {33434: (1, 125), 37500: b"maker\0note\xff", 36867: "2020:01:02 03:04:05"}
    )
    exif.get_ifd(34853).update({1: "N", 2: (48.0, 8.0, 0.0)})
    return exif.tobytes()


XYZ_TO_CAMERA = ((0.9, -0.3, -0.1), (-0.5, 1.4, 0.1), (-0.1, 0.2, 0.7))
CAMERA_NEUTRAL = (0.5, 1.0, 0.7)


def dng_file(mosaic: np.ndarray, orientation: int = 1, *more_tags: tuple) -> bytes:
    """Returns a DNG with this colour filter array, (H, W) uint16, in the pattern RGGB, of a camera
    Sextant One.
    """

    def rationals(values):
        return [part for value in np.ravel(values) for part in (round(10000 * value), 10000)]

    tags = [
        (50706, 1, 4, bytes((1, 4, 0, 0))),  # DNGVersion
        (50707, 1, 4, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        (50708, 2, 0, "Sextant One"),  # UniqueCameraModel
        (33421, 3, 2, (2, 2)),  # CFARepeatPatternDim
        (33422, 1, 4, bytes((0, 1, 1, 2))),  # CFAPattern
        (50714, 4, 1, 0),  # BlackLevel
        (50717, 4, 1, 65535),  # WhiteLevel
        (50721, 10, 9, rationals(XYZ_TO_CAMERA)),  # ColorMatrix1
        (50728, 5, 3, rationals(CAMERA_NEUTRAL)),  # AsShotNeutral
        (50778, 3, 1, 21),  # CalibrationIlluminant1: D65
        (271, 2, 0, "Sextant"),
        (272, 2, 0, "One"),
        (274, 3, 1, orientation),
        *more_tags,
    ]
    return tiff_with(mosaic, *tags, photometric=32803, rowsperstrip=32)


def mosaic(height: int = 96, width: int = 128) -> np.ndarray:
    """Returns a colour filter array (H, W) uint16 with smooth gradients."""
    down, across = np.mgrid[:height, :width]
    return (1000 + 90 * down + 150 * across).astype(np.uint16)
