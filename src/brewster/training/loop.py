"""The training loop, the only one: `run(trainer, out, report)` runs or resumes, bit for bit, whatever learns.

Every step depends on the trainer's state and on (seed, step) alone: no hidden state, so on the CPU a killed run that
resumes ends with the same weights, to the last bit, as one that never stopped (same machine, same number of threads).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final, Protocol

from pydantic import ValidationError
from torch import Tensor

from brewster.errors import RecipeError
from brewster.files import write_atomically
from brewster.photo import Photo
from brewster.srgb import to_linear
from brewster.training.checkpoint import AFRESH, Checkpoint, fitting
from brewster.training.distributed import is_main_process
from brewster.training.recipe import TrainingRecipe
from brewster.training.tensorboard import TensorBoardLog

Report = Callable[[int, int, Mapping[str, float], bool], None]
"""Called with (step, steps, numbers, logged) after every step; `logged` says that the numbers went into the log."""

CHECKPOINT: Final = "checkpoint.pt"
LOG: Final = "log.jsonl"
SAMPLES: Final = "samples.png"
_MAY_CHANGE: Final = {"start_from", "steps", "report_every", "checkpoint_every"}


class Trainer(Protocol):
    """What can be trained: a network with its optimiser and its data, and no memory but its state."""

    @property
    def recipe(self) -> TrainingRecipe:
        """What it learns, and for how long."""
        ...

    def initialize(self) -> None:
        """Takes up what the recipe starts from; called where there is no run to go on with."""
        ...

    def training_step(self, step: int) -> dict[str, float]:
        """Learns from this step's batch; its loss, and the parts of it, by name."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that the next step depends on: tensors, numbers and words by name."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from what `state` gave."""
        ...

    def validate(self) -> tuple[dict[str, float], Tensor]:
        """How good it is, by name, and what it makes of a few photos: (H, W, 3), sRGB-encoded, in 0..1."""
        ...

    def export(self, folder: Path) -> Path:
        """Writes what users need of it into this folder; where that is."""
        ...


def run(trainer: Trainer, out: Path, report: Report) -> None:
    """Trains to the end of the recipe in folder `out`, from its checkpoint if there is one.

    Where several processes learn together, the first alone writes.

    A recipe whose data are none (a count of 0) takes no step: the trainer stays as it starts.

    `out` receives `checkpoint.pt` and, at every report, a line in `log.jsonl`, `samples.png`, and both in a file for
    TensorBoard, where that is installed.

    Raises:
        RecipeError: `out` holds a run of another recipe.
        ModelError: a checkpoint is missing, damaged or of another network, or the loss is not a number.
        TargetError: `out` cannot be written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    recipe = trainer.recipe
    begun = _take_up(trainer, out / CHECKPOINT)
    if is_main_process():
        _forget_after(begun, out / LOG)
    started, steps = time.monotonic(), 0 if recipe.data.is_empty else recipe.steps
    with closing(TensorBoardLog(out, begun)) as board:
        for step in range(begun + 1, 1 + steps):
            numbers, last = trainer.training_step(step - 1), step == recipe.steps
            logged = is_main_process() and (last or step % recipe.report_every == 0)
            if logged:
                scores, picture = trainer.validate()
                numbers |= scores | {"seconds": time.monotonic() - started}
                _log(out / LOG, {"step": step, **numbers})
                _write_picture(out / SAMPLES, picture)
                board.log(step, numbers, picture)
            if is_main_process() and (last or step % recipe.checkpoint_every == 0):
                Checkpoint(step, recipe.model_dump_json(), trainer.state_dict()).write(out / CHECKPOINT)
            report(step, recipe.steps, numbers, logged)


def last_numbers(folder: Path) -> dict[str, float]:
    """What a run in this folder logged last; nothing if it has not."""
    log = folder / LOG
    lines = log.read_text().splitlines() if log.exists() else []
    return dict(json.loads(lines[-1])) if lines else {}


def _take_up(trainer: Trainer, saved: Path) -> int:
    """Goes on with the run if it has begun, else begins it where its recipe says; how many steps are taken."""
    if not saved.exists():
        trainer.initialize()
        return 0
    checkpoint = _of_this_recipe(Checkpoint.read(saved), trainer.recipe, saved)
    with fitting(saved, AFRESH):
        trainer.load_state_dict(checkpoint.state)
    return checkpoint.step


def _of_this_recipe(checkpoint: Checkpoint, recipe: TrainingRecipe, path: Path) -> Checkpoint:
    before, now = _identity(checkpoint.recipe, recipe), _identity(recipe.model_dump_json(), recipe)
    if before == now:
        return checkpoint
    changed = ", ".join(name for name in now if before and before.get(name) != now[name])
    raise RecipeError(
        f"{path} belongs to another recipe{f' (other values: {changed})' if changed else ''}",
        "a run resumes only with the recipe that it began with",
        "choose another folder with -o",
    )


def _identity(text: str, recipe: TrainingRecipe) -> dict[str, object]:
    """What a run must keep to be resumed: all but how long it is, how often it reports, and where it started from.

    What a recipe does not name, such as a value that is newer than the run, counts as its default.
    """
    try:
        return type(recipe).model_validate_json(text).model_dump(exclude=_MAY_CHANGE)
    except ValidationError:
        return {}


def _log(path: Path, numbers: Mapping[str, float]) -> None:
    with path.open("a") as stream:
        stream.write(json.dumps({name: round(value, 5) for name, value in numbers.items()}) + "\n")


def _forget_after(step: int, log: Path) -> None:
    """Drops the lines that a killed run wrote after its last checkpoint, the last of them perhaps half."""
    lines = log.read_text().splitlines() if log.exists() else []
    kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
    if kept != lines:
        write_atomically(log, "".join(f"{line}\n" for line in kept).encode(), overwrite=True)


def _write_picture(path: Path, encoded: Tensor) -> None:
    light = to_linear(encoded.clamp(0, 1)).numpy()
    Photo.from_array(light, encoding="linear").save(path, depth=8, overwrite=True)
