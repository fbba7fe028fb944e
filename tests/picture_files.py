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
