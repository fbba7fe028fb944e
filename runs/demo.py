"""The script of `make demo`: separates photos and writes a sheet of photo, transmission and
reflection.

.venv/bin/python runs/demo.py tests/pictures
"""

import sys
import time
from pathlib import Path

import numpy as np

from brewster import Photo, Separator
from brewster.batch import SeparationTask, plan_files
from brewster.errors import BrewsterError
from brewster.photo.contact_sheet import side_by_side

OUT = Path("out/demo")
ROW_PX = 240


def main(source: Path) -> int:
    separator = Separator.load("compact")
    OUT.mkdir(parents=True, exist_ok=True)
    rows = []
    failures = 0
    for task in plan_files(source, OUT):
        try:
            rows.append(separate(separator, task))
        except BrewsterError as error:
            failures += 1
            print(f"error: {task.name}: {error}", file=sys.stderr)
    if rows:
        width = max(row.shape[1] for row in rows)
        padded = [
            np.pad(row, [(0, 8), (0, width - row.shape[1]), (0, 0)], constant_values=255)
            for row in rows
        ]
        sheet = OUT / "sheet.png"
        Photo.from_array(np.concatenate(padded), encoding="srgb").save(sheet, overwrite=True)
        print(f"photo | transmission | reflection, side by side: {sheet}")
    return 1 if failures or not rows else 0


def separate(separator: Separator, task: SeparationTask) -> np.ndarray:
    """Separates one photo and saves its layers. Returns its row of the sheet."""
    started = time.perf_counter()
    result = separator(task.source)
    for layer, target in task.outputs.items():
        getattr(result, layer).save(target, overwrite=True)
    print(f"{task.name}: {time.perf_counter() - started:.2f} s")
    print(*(f"  {target}" for target in task.outputs.values()), sep="\n")
    return side_by_side((result.photo, result.transmission, result.reflection), ROW_PX)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
