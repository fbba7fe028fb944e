"""The log of a training run, and the sheet of samples."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

LOG_FILE: Final = "log.jsonl"
CAPTION_PX: Final = 20
"""Height of a line of text on a sheet of samples."""
_DPI: Final = 128  # a power of two: sides in inches, and therefore in pixels, are exact


def read_log(folder: Path) -> list[dict[str, float]]:
    """Returns the lines of the log in `folder`: `step` and the metrics by name. Empty without a
    log.
    """
    log = folder / LOG_FILE
    return [dict(json.loads(line)) for line in log.read_text().splitlines()] if log.exists() else []


def sample_sheet(
    columns: Sequence[str], rows: Sequence[tuple[str, Float[Tensor, "3 h w"]]]
) -> Float[Tensor, "sheet_h w 3"]:
    """Returns an sRGB-encoded sheet with a line of column titles, and for each row a caption above
    its images.

    The images of a row, of equal widths, are side by side. The height is CAPTION_PX + rows
    (CAPTION_PX + h).
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  (slow to import)

    _, height, width = rows[0][1].shape
    pitch = CAPTION_PX + height
    sheet_height = CAPTION_PX + len(rows) * pitch
    figure = Figure(figsize=(width / _DPI, sheet_height / _DPI), dpi=_DPI, facecolor="white")

    def write(text: str, x: float, top: int, **style: Any) -> None:  # noqa: ANN401  (matplotlib)
        y = 1 - (top + CAPTION_PX / 2) / sheet_height
        figure.text(x, y, text, va="center", fontsize=7, color="#222222", parse_math=False, **style)

    for column, title in enumerate(columns):
        write(title, (column + 0.5) / len(columns), 0, ha="center", weight="bold")
    for row, (caption, _) in enumerate(rows):
        write(caption, 4 / width, CAPTION_PX + row * pitch)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="rgba", dpi=_DPI)
    pixels = np.frombuffer(drawn.getvalue(), np.uint8).reshape(sheet_height, width, 4)
    sheet = torch.from_numpy(pixels[..., :3] / np.float32(255))
    for row, (_, images) in enumerate(rows):
        top = 2 * CAPTION_PX + row * pitch
        sheet[top : top + height] = images.permute(1, 2, 0)
    return sheet
