"""The state of a run on disk: written atomically, read back bit for bit."""

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

START_FRESH = "delete it to start afresh, or name another folder with -o"


@dataclass(frozen=True)
class Checkpoint:
    """Everything that a step depends on; the data and the schedule follow from step and recipe.

    In the file the parts of the state stand beside `step` and `recipe`.
    """

    step: int
    recipe: str
    state: Mapping[str, Any]

    def write(self, path: Path) -> None:
        """Replaces the file in one move: a kill leaves the old checkpoint or the new one.

        Raises:
            TargetError: it cannot be written.
        """
        stream = io.BytesIO()
        torch.save({"step": self.step, "recipe": self.recipe, **self.state}, stream)
        write_atomically(path, stream.getvalue(), overwrite=True)

    @classmethod
    def read(cls, path: Path, cure: str = START_FRESH) -> Checkpoint:
        """Reads a checkpoint; no code in it is run. `cure` is what an error advises.

        Raises:
            ModelError: missing, damaged, or not a checkpoint of ours.
        """
        try:
            state = dict(torch.load(path, map_location="cpu", weights_only=True))
            return cls(state.pop("step"), state.pop("recipe"), state)
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
                "a checkpoint written by brewster train",
                cure,
            ) from error


@contextmanager
def mismatch_as_model_error(path: Path, cure: str) -> Iterator[None]:
    """Tells plainly that the state in a checkpoint does not fit what it is put into.

    Raises:
        ModelError: it does not.
    """
    try:
        yield
    except (RuntimeError, ValueError, KeyError) as error:
        raise ModelError(
            f"{path} holds another network", "a checkpoint of the network that the recipe trains", cure
        ) from error
