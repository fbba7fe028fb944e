"""The state of a run on disk: written atomically, read back bit for bit."""

from __future__ import annotations

import os
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from brewster.errors import ModelError


@dataclass(frozen=True)
class Checkpoint:
    """Everything that a step depends on; the data and the schedule follow from step and recipe."""

    step: int
    network: dict[str, Tensor]
    average: dict[str, Tensor]
    optimizer: dict[str, Any]
    recipe: str

    def write(self, path: Path) -> None:
        """Replaces the file in one move: a kill leaves the old checkpoint or the new one."""
        partial = path.with_suffix(".partial")
        with partial.open("wb") as stream:
            torch.save(vars(self), stream)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)

    @classmethod
    def read(cls, path: Path) -> Checkpoint:
        """Reads a checkpoint; no code in it is run.

        Raises:
            ModelError: not a checkpoint of ours, or damaged.
        """
        try:
            return cls(**torch.load(path, map_location="cpu", weights_only=True))
        except (OSError, RuntimeError, TypeError, EOFError, pickle.UnpicklingError) as error:
            raise ModelError(
                f"{path} cannot be read ({type(error).__name__})",
                "a checkpoint written by brewster train",
                "delete it to start afresh, or name another folder with -o",
            ) from error
