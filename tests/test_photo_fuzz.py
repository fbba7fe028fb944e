"""Mutated image files: each is read, or raises a PhotoError, and nothing is printed."""

import numpy as np
import pytest

from brewster.cli.terminal import standard_output
from brewster.errors import PhotoError
from brewster.photo import Photo
from picture_files import exif_block, file_of, smooth

MUTATIONS = 400
"""Number of mutations of each file. All files together take about two minutes."""

IMAGE = smooth(24, 32)
IMAGE_16BIT = IMAGE.astype(np.uint16) * 257


def encoded_by_brewster(format_name, array=IMAGE):
    return Photo.from_array(array, encoding="srgb").encode(format_name)


FILES = {
    "jpeg": lambda: file_of(IMAGE, "JPEG", exif=exif_block()),
    "jpeg, progressive": lambda: file_of(IMAGE, "JPEG", progressive=True),
    "png": lambda: file_of(IMAGE, "PNG"),
    "png, 16 bit": lambda: encoded_by_brewster("png", IMAGE_16BIT),
    "tiff": lambda: file_of(IMAGE, "TIFF"),
    "tiff, lzw": lambda: file_of(IMAGE, "TIFF", compression="tiff_lzw"),
    "webp": lambda: file_of(IMAGE, "WEBP"),
    "webp, lossless": lambda: file_of(IMAGE, "WEBP", lossless=True),
    "avif": lambda: file_of(IMAGE, "AVIF"),
    "heic": lambda: encoded_by_brewster("heic"),
    "gif": lambda: file_of(IMAGE, "GIF"),
    "exr": lambda: encoded_by_brewster("exr"),
    "hdr": lambda: encoded_by_brewster("hdr"),
}


def mutated(data, rng):
    """Returns the bytes with one to four changes: bytes are set, flipped, deleted or doubled, or the end is cut off."""
    changed = bytearray(data)
    header = min(len(data), 600)  # half of the changes are in the header
    for _ in range(rng.integers(1, 5)):
        position = int(rng.integers(0, header if rng.integers(2) else max(1, len(changed))))
        change = rng.choice(["set", "flip", "drop", "double", "cut"], p=[0.4, 0.3, 0.1, 0.1, 0.1])
        if change == "set":
            changed[position : position + 1] = [rng.choice([0, 1, 127, 128, 255])]
        elif change == "flip":
            changed[position : position + 1] = [data[position % len(data)] ^ (1 << int(rng.integers(8)))]
        elif change == "drop":
            del changed[position : position + int(rng.integers(1, 9))]
        elif change == "double":
            changed[position:position] = changed[position : position + int(rng.integers(1, 9))]
        else:
            del changed[max(position, 1) :]
    return bytes(changed)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_mutated_file_is_read_or_refused_and_nothing_is_printed(name, capfd):
    data, rng = FILES[name](), np.random.default_rng(list(name.encode()))
    outcomes = {"read": 0, "refused": 0}
    with standard_output.reserved():
        for number in range(MUTATIONS):
            try:
                photo = Photo.open(mutated(data, rng), max_pixels=10_000)
                light = photo.linear()
                photo.with_linear(light).encode("png")
            except PhotoError:
                outcomes["refused"] += 1
            else:
                assert np.isfinite(light).all(), number
                outcomes["read"] += 1
    assert min(outcomes.values()) > 0  # otherwise the mutations are too strong or too weak
    assert capfd.readouterr().out == ""
