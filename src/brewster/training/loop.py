"""The training loop: `run(trainer, out, on_step)` starts or resumes a run of any `Trainer`.

A step depends on the trainer's state and on (seed, step) only: on a CPU, a resumed run ends with
the same weights, bit for bit, as an uninterrupted one with the same number of threads. A run can be
resumed with more steps.
"""

from __future__ import annotations

import io
import json
import pickle
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final, Protocol

import torch
from pydantic import ValidationError
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from brewster.base.files import write_atomically
from brewster.base.settings import flatten
from brewster.errors import ModelError, RecipeError
from brewster.photo import Photo
from brewster.photo.srgb import to_linear
from brewster.training.plots import LOG_FILE
from brewster.training.recipe import TrainingRecipe

StepCallback = Callable[[int, int, Mapping[str, float], bool], None]
"""Called after every step with (step, steps, metrics, logged); `logged`: the metrics were logged.
"""

StartCallback = Callable[[int, int, float], None]
"""Called before the first step with (completed steps, steps, seconds); 0, steps, 0 in a new run."""

CHECKPOINT_FILE: Final = "checkpoint.pt"
SAMPLES_FILE: Final = "samples.png"
_START_FRESH: Final = "delete it to start again, or choose another folder with -o"
_CHECKPOINT_ERRORS: Final = (
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    LookupError,
    EOFError,
    pickle.UnpicklingError,
)
_NOT_COMPARED: Final = ("steps", "report_every", "checkpoint_every", "init")
"""Recipe values that may change when a run is resumed."""


@dataclass(frozen=True)
class Checkpoint:
    """The state of a trainer after `step` steps and `seconds` of training, and its recipe as JSON.
    In the file, the keys of `state` are at the same level.
    """

    step: int
    recipe: str
    state: Mapping[str, Any]
    seconds: float = 0.0

    def write(self, path: Path) -> None:
        """Writes or replaces the file atomically: a killed process leaves either the old or the new
        checkpoint.
        """
        stream = io.BytesIO()
        torch.save(
            {"step": self.step, "recipe": self.recipe, "seconds": self.seconds, **self.state},
            stream,
        )
        write_atomically(path, stream.getvalue(), overwrite=True)

    @classmethod
    def read(cls, path: Path) -> Checkpoint:
        """Reads a checkpoint without running code from it. Raises ModelError if it cannot be
        read.
        """
        try:
            state = dict(torch.load(path, map_location="cpu", weights_only=True))
            # Checkpoints of brewster 0.1.0 have no seconds.
            step = state.pop("step")
            recipe = state.pop("recipe")
            seconds = state.pop("seconds", 0.0)
            return cls(step, recipe, state, seconds)
        except _CHECKPOINT_ERRORS as error:
            raise ModelError(
                f"{path} cannot be read ({type(error).__name__})",
                "expected a checkpoint written by brewster train",
                _START_FRESH,
            ) from error


class Trainer(Protocol):
    """A network with its optimiser and its data. `state_dict` holds all of its mutable state."""

    @property
    def recipe(self) -> TrainingRecipe:
        """The recipe of the run."""

    def initialize(self) -> None:
        """Loads the initial state that the recipe selects. Called when a new run starts, not when a
        run is resumed.
        """

    def training_step(self, step: int) -> dict[str, float]:
        """Trains on the batch of `step` (from 0). Returns `loss` and its terms, `loss_NAME`."""

    def state_dict(self) -> dict[str, Any]:
        """Returns everything that the next step depends on, as tensors, numbers and strings by
        name.
        """

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state that `state_dict` returned."""

    def validate(self) -> tuple[dict[str, float], Tensor]:
        """Returns the validation metrics by name, and samples as one sRGB-encoded image, (H, W, 3)
        in 0..1.
        """

    def export(self, folder: Path) -> Path:
        """Writes the model for inference into `folder`. Returns the path of the model."""


def open_trainer(recipe: TrainingRecipe, device: str = "auto") -> Trainer:
    """Creates the trainer of a recipe, for `run`.

    Args:
        recipe: the recipe, whose class names the trainer.
        device: "auto" or "cpu". A diffusion backbone is trained on a CPU only if "cpu" is chosen
            explicitly.
    """
    trainer: Trainer = resolve_name(recipe.trainer)(recipe, device=device)
    return trainer


def run(
    trainer: Trainer,
    out: Path,
    on_step: StepCallback,
    on_start: StartCallback = lambda _completed, _steps, _seconds: None,
) -> None:
    """Trains until the last step of the recipe. If `out` contains a checkpoint, resumes its run.

    Writes `checkpoint.pt` every `checkpoint_every` steps. Every `report_every` steps, validates,
    appends a line to `log.jsonl`, and writes `samples.png` and TensorBoard events. The logged
    `seconds` include the time before an interruption. If the recipe has no data (a count of 0), the
    trainer keeps its initial weights.

    Raises:
        RecipeError: `out` contains a run of another recipe, or a run with more steps.
        ModelError: a checkpoint is missing, damaged or of another network, or the loss is NaN or
            infinite.
        OutputError: `out` cannot be written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    recipe = trainer.recipe
    completed_steps, seconds_before = _resume_or_initialize(trainer, out / CHECKPOINT_FILE)
    log = out / LOG_FILE
    if log.exists():
        # A killed run may have written lines after its last checkpoint, and an incomplete last
        # line.
        lines = log.read_text().splitlines()
        valid = [
            line
            for line in lines
            if line.endswith("}") and json.loads(line)["step"] <= completed_steps
        ]
        if valid != lines:
            write_atomically(log, "".join(f"{line}\n" for line in valid).encode(), overwrite=True)
    on_start(completed_steps, recipe.steps, seconds_before)
    started = time.monotonic() - seconds_before
    steps = 0 if recipe.data.is_empty else recipe.steps
    if completed_steps >= steps:
        return  # a writer would create a file
    with SummaryWriter(out, purge_step=completed_steps + 1) as events:
        for step in range(completed_steps + 1, 1 + steps):
            metrics = trainer.training_step(step - 1)
            is_last = step == recipe.steps
            logged = is_last or step % recipe.report_every == 0
            if logged:
                scores, image = trainer.validate()
                metrics |= scores | {"seconds": time.monotonic() - started}
                line = {name: round(value, 5) for name, value in {"step": step, **metrics}.items()}
                with log.open("a") as stream:
                    stream.write(f"{json.dumps(line)}\n")
                linear = to_linear(image.clamp(0, 1)).numpy()
                Photo.from_array(linear, encoding="linear").save(
                    out / SAMPLES_FILE, depth=8, overwrite=True
                )
                for name, value in metrics.items():
                    events.add_scalar(name, value, step)
                events.add_image("samples", image.clamp(0, 1), step, dataformats="HWC")
                events.flush()
            if is_last or step % recipe.checkpoint_every == 0:
                seconds = time.monotonic() - started
                checkpoint = Checkpoint(
                    step, recipe.model_dump_json(), trainer.state_dict(), seconds
                )
                checkpoint.write(out / CHECKPOINT_FILE)
            on_step(step, recipe.steps, metrics, logged)


def _resume_or_initialize(trainer: Trainer, path: Path) -> tuple[int, float]:
    """Restores the checkpoint at `path`, or initializes the trainer. Returns the completed steps,
    and their seconds.
    """
    if not path.exists():
        trainer.initialize()
        return 0, 0.0
    checkpoint = Checkpoint.read(path)
    recipe = trainer.recipe
    before = _compared_values(checkpoint.recipe, recipe)
    now = _compared_values(recipe.model_dump_json(), recipe)
    if before != now:
        # `before` is empty if the stored recipe is not valid in the current schema. No change can
        # be listed then.
        names = [name for name in before | now if before and before.get(name) != now.get(name)]
        changes = ", ".join(f"{name} was {before.get(name)}, is {now.get(name)}" for name in names)
        raise RecipeError(
            f"{path} belongs to a run of another recipe{f': {changes}' if changes else ''}",
            "expected the recipe with which the run started; only these values may change: "
            f"{', '.join(_NOT_COMPARED)}",
            "restore the values, or choose another folder with -o",
        )
    if checkpoint.step > recipe.steps:
        raise RecipeError(
            f"{path} has {checkpoint.step} completed steps, but the recipe has steps = "
            f"{recipe.steps}",
            f"expected steps of at least {checkpoint.step}: a run can be made longer, but not "
            "shorter",
            "raise steps, or choose another folder with -o",
        )
    try:
        trainer.load_state_dict(checkpoint.state)
    except (RuntimeError, ValueError, KeyError) as error:
        raise ModelError(
            f"{path} contains another network",
            "expected a checkpoint of the network that the recipe trains",
            _START_FRESH,
        ) from error
    return checkpoint.step, checkpoint.seconds


def _compared_values(text: str, recipe: TrainingRecipe) -> dict[str, object]:
    """Returns the values of a stored recipe that must be equal for a run to resume, by path
    ("data.pairs_share").

    A value that it lacks, because it was added later, has its default. Empty if the stored recipe
    is not valid.
    """
    try:
        stored = type(recipe).model_validate_json(text)
    except ValidationError:
        return {}
    return dict(flatten(stored.model_dump(mode="json", exclude=set(_NOT_COMPARED))))
