"""From a trained network to a file that needs no torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import nn

from brewster.files import write_atomically
from brewster.models.compact import LinearSeparator

_OPSET = 18


def export_onnx(network: nn.Module, path: Path, stride: int) -> None:
    """Writes `photo` -> `transmission`, `reflection`, linear light (1, 3, H, W), H and W multiples of `stride`.

    Raises:
        TargetError: the file cannot be written.
    """
    height, width = (torch.export.Dim(name, min=1, max=256) for name in ("rows", "columns"))
    example = torch.rand(1, 3, 4 * stride, 5 * stride)
    with _quietly():
        program = torch.onnx.export(
            LinearSeparator(network).eval(),
            (example,),
            input_names=["photo"],
            output_names=["transmission", "reflection"],
            dynamic_shapes={"photo": {2: stride * height, 3: stride * width}},
            opset_version=_OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    write_atomically(path, program.model_proto.SerializeToString(), overwrite=True)


@contextmanager
def _quietly() -> Iterator[None]:
    """The exporter warns of a torchvision that nobody needs, and of its own old calls."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(before)
