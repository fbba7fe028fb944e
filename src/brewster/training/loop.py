"""The training loop: `run(trainer, out, on_step)` starts or resumes a run of any `Trainer`.

A step depends on the trainer's state and on (seed, step) only. On a CPU, a run that was killed and resumed therefore ends
with bit-identical weights to an uninterrupted run (same machine, same number of threads).
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
from brewster.training.checkpoint import START_FRESH, Checkpoint, mismatch_as_model_error
from brewster.training.distributed import is_main_process
from brewster.training.recipe import TrainingRecipe
from brewster.training.tensorboard import TensorBoardLog

StepCallback = Callable[[int, int, Mapping[str, float], bool], None]
"""Called after every step with (step, steps, metrics, logged); `logged` is true if the metrics were written to the log."""

CHECKPOINT: Final = "checkpoint.pt"
LOG: Final = "log.jsonl"
SAMPLES: Final = "samples.png"
_NOT_COMPARED: Final = {"start_from", "steps", "report_every", "checkpoint_every"}
"""Recipe values that may change when a run is resumed."""


class Trainer(Protocol):
    """A network with its optimiser and its data. `state_dict` holds all of its mutable state."""

    @property
    def recipe(self) -> TrainingRecipe:
        """The recipe of the run."""
        ...

    def initialize(self) -> None:
        """Loads what the recipe starts from. Called once, when a new run starts, not when a run is resumed."""
        ...

    def training_step(self, step: int) -> dict[str, float]:
        """Trains on the batch of `step` (from 0). Returns the loss and its parts by name."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Returns everything that the next step depends on, as tensors, numbers and strings by name."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state that `state_dict` returned."""
        ...

    def validate(self) -> tuple[dict[str, float], Tensor]:
        """Returns the validation metrics by name, and a picture of sample predictions: (H, W, 3), sRGB-encoded, in 0..1."""
        ...

    def export(self, folder: Path) -> Path:
        """Writes the model for inference into `folder`. Returns the path of the model."""
        ...


def run(trainer: Trainer, out: Path, on_step: StepCallback) -> None:
    """Trains until the last step of the recipe; resumes from the checkpoint in `out` if there is one.

    Every `checkpoint_every` steps it writes `checkpoint.pt` into `out`. Every `report_every` steps it validates, appends a
    line to `log.jsonl`, replaces `samples.png`, and writes both as TensorBoard events if tensorboard is installed. With
    several processes, only rank 0 writes files. A recipe without data (a count of 0) takes no step: the trainer keeps its
    initial weights.

    Raises:
        RecipeError: `out` contains a run of another recipe.
        ModelError: a checkpoint is missing, damaged or of another network, or the loss is NaN or infinite.
        TargetError: `out` cannot be written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    recipe = trainer.recipe
    completed_steps = _resume_or_initialize(trainer, out / CHECKPOINT)
    if is_main_process():
        _truncate_log(completed_steps, out / LOG)
    started, steps = time.monotonic(), 0 if recipe.data.is_empty else recipe.steps
    with closing(TensorBoardLog(out, completed_steps)) as event_log:
        for step in range(completed_steps + 1, 1 + steps):
            metrics, is_last = trainer.training_step(step - 1), step == recipe.steps
            logged = is_main_process() and (is_last or step % recipe.report_every == 0)
            if logged:
                scores, picture = trainer.validate()
                metrics |= scores | {"seconds": time.monotonic() - started}
                _append_log(out / LOG, {"step": step, **metrics})
                _write_picture(out / SAMPLES, picture)
                event_log.log(step, metrics, picture)
            if is_main_process() and (is_last or step % recipe.checkpoint_every == 0):
                Checkpoint(step, recipe.model_dump_json(), trainer.state_dict()).write(out / CHECKPOINT)
            on_step(step, recipe.steps, metrics, logged)


def read_last_metrics(folder: Path) -> dict[str, float]:
    """Returns the last line of the log in `folder`, or an empty dict if there is no log."""
    log = folder / LOG
    lines = log.read_text().splitlines() if log.exists() else []
    return dict(json.loads(lines[-1])) if lines else {}


def _resume_or_initialize(trainer: Trainer, path: Path) -> int:
    """Restores the checkpoint at `path`, or initializes the trainer if there is none. Returns the number of completed steps."""
    if not path.exists():
        trainer.initialize()
        return 0
    checkpoint = _check_recipe(Checkpoint.read(path), trainer.recipe, path)
    with mismatch_as_model_error(path, START_FRESH):
        trainer.load_state_dict(checkpoint.state)
    return checkpoint.step


def _check_recipe(checkpoint: Checkpoint, recipe: TrainingRecipe, path: Path) -> Checkpoint:
    before, now = (
        _compared_values(checkpoint.recipe, recipe),
        _compared_values(recipe.model_dump_json(), recipe),
    )
    if before == now:
        return checkpoint
    changed = ", ".join(name for name in now if before and before.get(name) != now[name])
    raise RecipeError(
        f"{path} belongs to a run of another recipe{f' (different values: {changed})' if changed else ''}",
        "a run is resumed with the recipe that it started with",
        "choose another folder with -o",
    )


def _compared_values(text: str, recipe: TrainingRecipe) -> dict[str, object]:
    """Returns the values that must be equal for a run to resume: all but `_NOT_COMPARED`.

    A value that the stored recipe lacks, because it was added to the schema later, counts as its default.
    """
    try:
        return type(recipe).model_validate_json(text).model_dump(exclude=_NOT_COMPARED)
    except ValidationError:
        return {}


def _append_log(path: Path, metrics: Mapping[str, float]) -> None:
    with path.open("a") as stream:
        stream.write(json.dumps({name: round(value, 5) for name, value in metrics.items()}) + "\n")


def _truncate_log(step: int, log: Path) -> None:
    """Removes the lines that a killed run wrote after its last checkpoint. The last line may be incomplete."""
    lines = log.read_text().splitlines() if log.exists() else []
    kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
    if kept != lines:
        write_atomically(log, "".join(f"{line}\n" for line in kept).encode(), overwrite=True)


def _write_picture(path: Path, encoded: Tensor) -> None:
    light = to_linear(encoded.clamp(0, 1)).numpy()
    Photo.from_array(light, encoding="linear").save(path, depth=8, overwrite=True)
