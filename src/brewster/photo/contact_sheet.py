"""Contact sheets: one row for each photo or sample, with its images and its name."""

import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import count, islice
from pathlib import Path
from typing import Final

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.base.files import write_atomically
from brewster.base.remote_path import Location
from brewster.photo import srgb
from brewster.photo.file_info import format_name_of
from brewster.photo.history import PROGRAM, recorded_parameters, with_layer_history
from brewster.photo.photo import Photo

_ROW_PX = 240
_LABEL_PX = 24
_GAP_PX = 8
_LAYER: Final = "contact sheet"
"""The name of a sheet in its history, where the layers of a photo have theirs."""
_MAX_ROWS = 200  # their height is 54,400 pixels; a JPEG has at most 65,535
Encoded = NDArray[np.uint8]

_SYSTEM_FONTS: Final = Path("/etc/fonts/fonts.conf")
_PACKAGED_FONTS: Final = Path(__file__).with_name("fonts") / "fonts.conf"
"""DejaVu Sans, for systems without fonts: without it, a caption consists of boxes, and fontconfig
prints an error.
"""


def is_contact_sheet(path: Path) -> bool:
    """Returns whether a file is a contact sheet that `write_contact_sheets` wrote, by the history
    in its metadata.
    """
    return (recorded_parameters(path, PROGRAM) or {}).get("layer") == _LAYER


def is_free_for_sheet(path: Path, *, overwrite: bool) -> bool:
    """Returns whether a contact sheet may have this path.

    Args:
        path: the image file of the sheet.
        overwrite: whether a file that is no contact sheet is replaced.
    """
    return overwrite or not path.exists() or is_contact_sheet(path)


def write_contact_sheets(
    path: Path,
    rows: Iterable[tuple[str, Sequence[Location | bytes]]],
    max_pixels: int,
    *,
    overwrite: bool = False,
) -> Iterator[Path]:
    """Writes contact sheets, and yields the path of each.

    Args:
        path: the image file of the first sheet. A sheet has at most 200 rows; further ones have a
            number: `sheet.jpg`, `sheet-2.jpg` and so on. A contact sheet of an earlier run is
            replaced.
        rows: the label of each row, and its images: files, or the bytes of files. They are read
            when their sheet is written.
        max_pixels: the largest number of pixels of an image.
        overwrite: whether files that are no contact sheets are replaced, too.

    Raises:
        PhotoError: an image cannot be read or has more than `max_pixels` pixels.
        OutputError: a sheet cannot be written, or another file has its name.
    """
    if not _SYSTEM_FONTS.exists():
        os.environ.setdefault(
            "FONTCONFIG_FILE", str(_PACKAGED_FONTS)
        )  # ignored on Windows and macOS
    remaining = iter(rows)
    for number in count(1):
        images = [
            _row([Photo.open(file, max_pixels=max_pixels) for file in files], label)
            for label, files in islice(remaining, _MAX_ROWS)
        ]
        if not images:
            return
        width = max(image.shape[1] for image in images)
        gaps = ([(0, 0), (0, width - image.shape[1]), (0, 0)] for image in images)
        padded = [
            np.pad(image, gap, constant_values=255) for image, gap in zip(images, gaps, strict=True)
        ]
        sheet = path if number == 1 else path.with_stem(f"{path.stem}-{number}")
        photo = with_layer_history(Photo(np.concatenate(padded)), _LAYER, {})
        data = photo.encode(format_name_of(sheet))
        write_atomically(sheet, data, overwrite=overwrite or is_contact_sheet(sheet))
        yield sheet


def side_by_side(photos: Sequence[Photo], height: int = _ROW_PX) -> Encoded:
    """Returns the photos side by side as 8-bit sRGB, (height, W, 3), with white gaps. Small photos
    are not enlarged.
    """
    gap = np.full((height, _GAP_PX, 3), 255, np.uint8)
    images = []
    for photo in photos:
        scale = min(height / photo.size[1], 1)
        width, rows = (max(1, round(scale * side)) for side in photo.size)
        image = srgb.to_8bit(photo.resized(width, rows))
        images += [np.pad(image, [(0, height - rows), (0, 0), (0, 0)], constant_values=255), gap]
    return np.concatenate(images[:-1], axis=1)


def _row(photos: Sequence[Photo], label: str) -> Encoded:
    """Returns a row with its label below, 8-bit sRGB, (272, W, 3)."""
    images = side_by_side(photos)
    canvas = np.full((_ROW_PX + _LABEL_PX + _GAP_PX, images.shape[1], 3), 255, np.uint8)
    canvas[:_ROW_PX] = images
    printable = "".join(letter if letter.isprintable() else "?" for letter in label)
    escaped = printable.replace("&", "&amp;").replace("<", "&lt;")  # Pango reads markup
    # If the path is too long for the row, only its end is shown.
    text = pyvips.Image.text(escaped, dpi=90).numpy()[:_LABEL_PX, -images.shape[1] :]
    canvas[_ROW_PX : _ROW_PX + text.shape[0], : text.shape[1]] = 255 - text[..., None]
    return canvas
