"""Writes index.parquet, with a row for each sample of a dataset, and preview.png, which shows the
first samples.
"""

import tomllib
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path
from typing import Any, Final

import numpy as np

from brewster.base.files import atomic_path, write_atomically
from brewster.base.remote_path import Location
from brewster.photo import Photo
from brewster.photo.contact_sheet import side_by_side
from brewster.render.dataset.store import SCENE_FILE, STATISTICS, StoredSample, read_dataset
from brewster.render.sample import SAMPLE_IMAGES

INDEX_FILE = "index.parquet"
PREVIEW_FILE = "preview.png"
_BATCH_ROWS: Final = 1000

COLUMNS: Final = {
    "recipe": ("string", "recipe"),
    "seed": ("int64", "seed"),
    "orders": ("string", "orders"),
    "width": ("int64", "camera.width"),
    "height": ("int64", "camera.height"),
    "thickness_mm": ("float64", "glass.panes.0.thickness_mm"),
    "refractive_index": ("float64", "glass.panes.0.refractive_index"),
    "roughness": ("float64", "glass.panes.0.roughness"),
    "wedge_deg": ("float64", "glass.panes.0.wedge_deg"),
    "absorption_red_per_m": ("float64", "glass.panes.0.absorption_per_m.0"),
    "absorption_green_per_m": ("float64", "glass.panes.0.absorption_per_m.1"),
    "absorption_blue_per_m": ("float64", "glass.panes.0.absorption_per_m.2"),
    "gap_mm": ("float64", "glass.gap_mm"),
    "glass_heading_deg": ("float64", "glass.heading_deg"),
    "glass_pitch_deg": ("float64", "glass.pitch_deg"),
    "fov_deg": ("float64", "camera.fov_deg"),
    "aperture_mm": ("float64", "camera.aperture_mm"),
    "focus_mm": ("float64", "camera.focus_mm"),
    **{
        f"{side}_{source}_{name}": (kind, f"{side}.{source}.{path}")
        for side in ("behind", "front")
        for source, distance_key in (("map", "radius_mm"), ("plane", "distance_mm"))
        for name, kind, path in (
            ("file", "string", "source.file"),
            ("luminance", "float64", "luminance"),
            (distance_key, "float64", distance_key),
        )
    },
    "burst_frame": ("int64", "burst.frame"),
    "burst_frames": ("int64", "burst.frames"),
    "jpeg_quality": ("int64", "camera_response.jpeg_quality"),
    "exposure_ev": ("float64", "outcome.exposure_ev"),
    "mirror_exposure_ev": ("float64", "outcome.mirror_exposure_ev"),
    **{name: ("float64", f"outcome.{name}") for name in STATISTICS},
    "renderer": ("string", "outcome.renderer"),
    "version": ("string", "outcome.version"),
}
"""The type of each column of the index, and its path in scene.toml. Pane 0 is the pane nearest to
the camera.
"""


def write_index(out: Path) -> None:
    """Writes index.parquet, with a row for each sample in order. Its bytes depend only on the
    samples and their paths.

    The column `path` is the folder or the shard of the sample, relative to `out`.
    """
    import pyarrow as pa  # noqa: PLC0415  (not needed to read a dataset)
    from pyarrow import parquet  # noqa: PLC0415

    kinds = {"index": "int64", "path": "string", "panes": "int64"} | {
        name: kind for name, (kind, _) in COLUMNS.items()
    }
    schema = pa.schema([(name, pa.type_for_alias(kind)) for name, kind in kinds.items()])
    rows = map(_row, read_dataset(out))
    with atomic_path(out / INDEX_FILE) as part, parquet.ParquetWriter(part, schema) as writer:
        while batch := list(islice(rows, _BATCH_ROWS)):
            writer.write_batch(pa.RecordBatch.from_pylist(batch, schema=schema))


def _row(entry: StoredSample) -> dict[str, Any]:
    scene = tomllib.loads(entry.read(SCENE_FILE).decode())
    columns = {"index": entry.index, "path": entry.path.name, "panes": len(scene["glass"]["panes"])}
    return columns | {name: _lookup(scene, path.split(".")) for name, (_, path) in COLUMNS.items()}


def _lookup(table: Any, path: list[str]) -> Any:  # noqa: ANN401  (any value of TOML)
    """Returns the value at a path, or None if the scene has no such part."""
    for part in path:
        if isinstance(table, dict) and part not in table:
            return None
        table = table[int(part) if isinstance(table, list) else part]
    return table


_ROW_PX: Final = 120
_GAP_PX: Final = 4
_SHEET_ROWS = 20
_SHEET_COLUMNS = 2


def write_preview(out: Path) -> None:
    """Writes preview.png with the first 40 samples, in two columns. Each sample is a row of five
    images.
    """
    entries = list(islice(read_dataset(out), _SHEET_ROWS * _SHEET_COLUMNS))
    if entries:
        rows = []
        for first in range(min(len(entries), _SHEET_ROWS)):
            shown = product(entries[first::_SHEET_ROWS], SAMPLE_IMAGES)
            images = [Photo.open(entry.read(f"{layer}.jpg")) for entry, layer in shown]
            rows.append(side_by_side(images, min(_ROW_PX, max(image.size[1] for image in images))))
        width = max(row.shape[1] for row in rows)
        gaps = ([(0, _GAP_PX), (0, width - row.shape[1]), (0, 0)] for row in rows)
        padded = [
            np.pad(row, gap, constant_values=255) for row, gap in zip(rows, gaps, strict=True)
        ]
        data = Photo.from_array(np.concatenate(padded), encoding="srgb").encode("png")
        write_atomically(out / PREVIEW_FILE, data, overwrite=True)


SHEET_IMAGES: Final = ("photo", "transmission", "reflection")
"""The images in a row of a contact sheet."""


def sheet_rows(out: Path) -> Iterator[tuple[str, list[Location | bytes]]]:
    """Yields the rows of a contact sheet: the name of each sample of the dataset `out`, and the
    bytes of its SHEET_IMAGES, which are JPEG files.
    """
    for entry in read_dataset(out):
        yield entry.name, [entry.read(f"{image}.jpg") for image in SHEET_IMAGES]
