"""TensorBoard events of a run, in addition to its log: `tensorboard --logdir OUT`. A no-op without tensorboard."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, final

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch.utils.tensorboard import SummaryWriter

IMAGE_TAG = "samples"


@final
class TensorBoardLog:
    """Writes event files to a folder. Events of an interrupted run after `completed_steps` are discarded."""

    def __init__(self, folder: Path, completed_steps: int) -> None:
        self._folder, self._completed_steps = folder, completed_steps

    def log(self, step: int, metrics: Mapping[str, float], image_encoded: Float[Tensor, "h w 3"]) -> None:
        """Writes each metric as a scalar, and the image, sRGB-encoded in 0..1."""
        if self._writer:
            for name, value in metrics.items():
                self._writer.add_scalar(name, value, step)
            self._writer.add_image(IMAGE_TAG, image_encoded.clamp(0, 1), step, dataformats="HWC")
            self._writer.flush()

    def close(self) -> None:
        """Closes the event file, if one was opened."""
        if "_writer" in vars(self) and self._writer:
            self._writer.close()

    @cached_property
    def _writer(self) -> SummaryWriter | None:
        """The writer of the event file, or None without tensorboard. The file is created at the first event, so that a completed
        run that is resumed gets no empty file.
        """
        if not importlib.util.find_spec("tensorboard"):
            return None
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  (imports tensorboard)

        return SummaryWriter(self._folder, purge_step=self._completed_steps + 1)
