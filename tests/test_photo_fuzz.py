"""Mutated picture files: each is read, or refused by an error of ours, and nothing is printed."""

import numpy as np
import pytest

from brewster.cli.terminal import standard_output
from brewster.errors import PhotoError
from brewster.photo import Photo
from picture_files import exif_block, file_of, smooth

MUTATIONS = 400
"""Of each file: some thousands in all, about two minutes."""

PICTURE = smooth(24, 32)
DEEP = PICTURE.astype(np.uint16) * 257


def ours(container, array=PICTURE):
    return Photo.from_array(array, encoding="srgb").encode(container)


FILES = {
    "jpeg": lambda: file_of(PICTURE, "JPEG", exif=exif_block()),
    "jpeg, progressive": lambda: file_of(PICTURE, "JPEG", progressive=True),
    "png": lambda: file_of(PICTURE, "PNG"),
    "png, 16 bit": lambda: ours("png", DEEP),
    "tiff": lambda: file_of(PICTURE, "TIFF"),
    "tiff, lzw": lambda: file_of(PICTURE, "TIFF", compression="tiff_lzw"),
    "webp": lambda: file_of(PICTURE, "WEBP"),
    "webp, lossless": lambda: file_of(PICTURE, "WEBP", lossless=True),
    "avif": lambda: file_of(PICTURE, "AVIF"),
    "heic": lambda: ours("heic"),
    "gif": lambda: file_of(PICTURE, "GIF"),
    "exr": lambda: ours("exr"),
    "hdr": lambda: ours("hdr"),
}


def mutated(data, rng):
    """The bytes with a few of them changed, left out, doubled, or the end cut off."""
    changed = bytearray(data)
    header = min(len(data), 600)  # half of the changes are where a file says what it is
    for _ in range(rng.integers(1, 5)):
        place = int(rng.integers(0, header if rng.integers(2) else max(1, len(changed))))
        how = rng.choice(["set", "flip", "drop", "double", "cut"], p=[0.4, 0.3, 0.1, 0.1, 0.1])
        if how == "set":
            changed[place : place + 1] = [rng.choice([0, 1, 127, 128, 255])]
        elif how == "flip":
            changed[place : place + 1] = [data[place % len(data)] ^ (1 << int(rng.integers(8)))]
        elif how == "drop":
            del changed[place : place + int(rng.integers(1, 9))]
        elif how == "double":
            changed[place:place] = changed[place : place + int(rng.integers(1, 9))]
        else:
            del changed[max(place, 1) :]
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
    assert min(outcomes.values()) > 0  # or the mutations were too harsh, or too mild
    assert capfd.readouterr().out == ""
