"""Checkpoints of training runs. They are written atomically and restored bit for bit."""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from brewster.errors import ModelError
from brewster.files import write_atomically

START_FRESH = "delete it to start again, or choose another folder with -o"


@dataclass(frozen=True)
class Checkpoint:
    """The state of a trainer after `step` steps and `seconds` of training, and its recipe as JSON.

    Batches and learning rates need no state, because they are functions of step and recipe. In the file, the keys of
    `state` are at the same level as `step`, `recipe` and `seconds`.
    """

    step: int
    recipe: str
    state: Mapping[str, Any]
    seconds: float = 0.0

    def write(self, path: Path) -> None:
        """Writes or replaces the file atomically: a killed process leaves either the old or the new checkpoint.

        Raises:
            OutputError: the file cannot be written.
        """
        stream = io.BytesIO()
        torch.save({"step": self.step, "recipe": self.recipe, "seconds": self.seconds, **self.state}, stream)
        write_atomically(path, stream.getvalue(), overwrite=True)

    @classmethod
    def read(cls, path: Path, cure: str = START_FRESH) -> Checkpoint:
        """Reads a checkpoint without running code from it (`weights_only`). `cure` is the advice in the error message.

        Raises:
            ModelError: the file is missing, damaged, or not a checkpoint of brewster.
        """
        try:
            state = dict(torch.load(path, map_location="cpu", weights_only=True))
            # Checkpoints of brewster 0.1.0 have no seconds.
            step, recipe, seconds = state.pop("step"), state.pop("recipe"), state.pop("seconds", 0.0)
            return cls(step, recipe, state, seconds)
        except (
            OSError,
            RuntimeError,
            TypeError,
            ValueError,
            LookupError,
            EOFError,
            pickle.UnpicklingError,
        ) as error:
            raise ModelError(
                f"{path} cannot be read ({type(error).__name__})",
                "expected a checkpoint written by brewster train",
                cure,
            ) from error


@contextmanager
def mismatch_as_model_error(path: Path, cure: str) -> Iterator[None]:
    """Replaces an error of `load_state_dict` in its block by a ModelError with the path of the checkpoint.

    Raises:
        ModelError: the state does not match the network.
    """
    try:
        yield
    except (RuntimeError, ValueError, KeyError) as error:
        raise ModelError(
            f"{path} contains another network",
            "expected a checkpoint of the network that the recipe trains",
            cure,
        ) from error
