"""The state of a run on disk: written atomically, read back bit for bit."""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from brewster.errors import ModelError
from brewster.files import write_atomically

AFRESH = "delete it to start afresh, or name another folder with -o"


@dataclass(frozen=True)
class Checkpoint:
    """Everything that a step depends on; the data and the schedule follow from step and recipe."""

    step: int
    network: dict[str, Tensor]
    average: dict[str, Tensor]
    optimizer: dict[str, Any]
    recipe: str

    def write(self, path: Path) -> None:
        """Replaces the file in one move: a kill leaves the old checkpoint or the new one.

        Raises:
            TargetError: it cannot be written.
        """
        stream = io.BytesIO()
        torch.save(vars(self), stream)
        write_atomically(path, stream.getvalue(), overwrite=True)

    @classmethod
    def read(cls, path: Path, cure: str = AFRESH) -> Checkpoint:
        """Reads a checkpoint; no code in it is run. `cure` is what an error advises.

        Raises:
            ModelError: missing, damaged, or not a checkpoint of ours.
        """
        try:
            return cls(**torch.load(path, map_location="cpu", weights_only=True))
        except (OSError, RuntimeError, TypeError, EOFError, pickle.UnpicklingError) as error:
            raise ModelError(
                f"{path} cannot be read ({type(error).__name__})",
                "a checkpoint written by brewster train",
                cure,
            ) from error
