"""Images of a training run: results.png with the curves of the log, and the sheet of samples."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
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
_SUBPLOT_TITLES: Final = {
    "loss": "loss of the batch",
    "loss_": "terms of the loss",
    "psnr_gain_db_": "PSNR gain over the input, dB",
    "worse_": "share of pairs worse than the input",
    "exposure_": "exposure, prediction / photo",
}
"""Name or prefix of metrics -> title of the subplot. Metrics with one prefix share a subplot; others have their own."""
_MAX_COLUMNS: Final = 3
_DPI: Final = 128  # a power of two: sides in inches, and therefore in pixels, are exact


def read_log(folder: Path) -> list[dict[str, float]]:
    """Returns the lines of the log in `folder`: `step` and the metrics by name. Empty without a log."""
    log = folder / LOG_FILE
    return [dict(json.loads(line)) for line in log.read_text().splitlines()] if log.exists() else []


def plot_log(lines: Sequence[Mapping[str, float]]) -> bytes:
    """Plots the lines of the log, at least one, against their `step`. Returns the bytes of a PNG file."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (slow to import)

    subplots: dict[str, dict[str, str]] = {}
    for name in dict.fromkeys(name for line in lines for name in line if name not in ("step", "seconds")):
        title, label = _subplot_of(name)
        subplots.setdefault(title, {})[name] = label
    columns = min(_MAX_COLUMNS, len(subplots))
    rows = -(-len(subplots) // columns)
    figure = Figure(figsize=(4 * columns, 3.25 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flat
    for axis, (title, metrics) in zip(axes, subplots.items(), strict=False):
        for name, label in metrics.items():
            points = [(line["step"], line[name]) for line in lines if name in line]
            axis.plot(*zip(*points, strict=True), marker="o", markersize=3, linewidth=1.4, label=label)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("training step", fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.25)
        if any(metrics.values()):
            axis.legend(fontsize=8)
    for axis in list(axes)[len(subplots) :]:
        axis.set_visible(False)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})
    return data.getvalue()


def sample_sheet(
    columns: Sequence[str], rows: Sequence[tuple[str, Float[Tensor, "3 h w"]]]
) -> Float[Tensor, "sheet_h w 3"]:
    """Returns an sRGB-encoded sheet with a line of column titles, and for each row a caption above its images.

    The images of a row, of equal widths, are side by side. The height is CAPTION_PX + rows (CAPTION_PX + h)."""
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


def _subplot_of(name: str) -> tuple[str, str]:
    """Returns the title of a metric's subplot, and the label of its curve, "" for an only curve."""
    if name in _SUBPLOT_TITLES:
        return _SUBPLOT_TITLES[name], ""
    for prefix, title in _SUBPLOT_TITLES.items():
        if prefix.endswith("_") and name.startswith(prefix):
            return title, name.removeprefix(prefix).replace("_", " ")
    return name.replace("_", " "), ""
