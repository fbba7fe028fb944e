"""Image files as other programs write them. PIL is the independent reader and writer of the tests."""

import io

import numpy as np
from PIL import Image


def smooth(height: int = 48, width: int = 64) -> np.ndarray:
    """Returns an image with smooth gradients, (height, width, 3) uint8."""
    down, across = np.mgrid[:height, :width]
    return np.stack([down * 3, across * 3, 255 - down - across], axis=2).astype(np.uint8)


def file_of(array: np.ndarray, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(array.squeeze()).save(file, kind, **options)
    return file.getvalue()


def pil(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data))


def exif_block(orientation: int = 6) -> bytes:
    """Returns an EXIF block as cameras write it: big-endian, with a maker note, a date, and GPS."""
    exif = Image.Exif()
    exif.endian = ">"
    exif[274], exif[271], exif[306] = orientation, "Sextant", "2020:01:02 03:04:05"
    exif.get_ifd(34665).update({33434: (1, 125), 37500: b"maker\0note\xff", 36867: "2020:01:02 03:04:05"})
    exif.get_ifd(34853).update({1: "N", 2: (48.0, 8.0, 0.0)})
    return exif.tobytes()


XYZ_TO_CAMERA = ((0.9, -0.3, -0.1), (-0.5, 1.4, 0.1), (-0.1, 0.2, 0.7))
CAMERA_NEUTRAL = (0.5, 1.0, 0.7)


def dng_file(mosaic: np.ndarray, orientation: int = 1, *more_tags: tuple) -> bytes:
    """Returns a DNG with this colour filter array, (H, W) uint16, in the pattern RGGB. Its camera is a Sextant One. A tag is
    (number, type, count, value)."""
    import tifffile  # noqa: PLC0415  (few tests need it)

    def rationals(values):
        return [part for value in np.ravel(values) for part in (round(10000 * value), 10000)]

    tags = [
        (50706, 1, 4, bytes((1, 4, 0, 0)), True),  # DNGVersion
        (50707, 1, 4, bytes((1, 1, 0, 0)), True),  # DNGBackwardVersion
        (50708, 2, 0, "Sextant One", True),  # UniqueCameraModel
        (33421, 3, 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, 1, 4, bytes((0, 1, 1, 2)), True),  # CFAPattern
        (50714, 4, 1, 0, True),  # BlackLevel
        (50717, 4, 1, 65535, True),  # WhiteLevel
        (50721, 10, 9, rationals(XYZ_TO_CAMERA), True),  # ColorMatrix1
        (50728, 5, 3, rationals(CAMERA_NEUTRAL), True),  # AsShotNeutral
        (50778, 3, 1, 21, True),  # CalibrationIlluminant1: D65
        (271, 2, 0, "Sextant", True),
        (272, 2, 0, "One", True),
        (274, 3, 1, orientation, True),
        *((*tag, True) for tag in more_tags),
    ]
    file = io.BytesIO()
    tifffile.imwrite(file, mosaic, photometric=32803, extratags=tags, metadata=None, rowsperstrip=32)
    return file.getvalue()


def mosaic(height: int = 96, width: int = 128) -> np.ndarray:
    """Returns a colour filter array (H, W) uint16 with smooth gradients."""
    down, across = np.mgrid[:height, :width]
    return (1000 + 90 * down + 150 * across).astype(np.uint16)
