"""Exports a trained network to ONNX, which runs without torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from onnx import ModelProto, TensorProto, helper, numpy_helper
from torch import nn

from brewster.files import write_atomically
from brewster.models.compact import LinearSeparator

_OPSET = 18
_SMALLEST_WEIGHT = 16


def export_onnx(network: nn.Module, path: Path, stride: int) -> None:
    """Writes the network as an ONNX file: input `photo`, outputs `transmission` and `reflection`.

    All are linear light, (1, 3, H, W), H and W multiples of `stride`. The weights are stored in half precision, which halves
    the file; the network still computes in float32.

    Raises:
        TargetError: the file cannot be written.
    """
    height, width = (torch.export.Dim(name, min=1, max=256) for name in ("rows", "columns"))
    example = torch.rand(1, 3, 4 * stride, 5 * stride)
    with _without_warnings():
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
    write_atomically(path, with_half_weights(program.model_proto).SerializeToString(), overwrite=True)


def with_half_weights(model: ModelProto) -> ModelProto:
    """Changes the graph in place: weights are stored as float16 and cast to float32 before use. Returns `model`.

    ONNX Runtime folds the casts when it loads the file, so inference takes no extra time. Small tensors are not changed:
    they are constants of the graph, such as the coefficients of the sRGB curve.
    """
    graph = model.graph
    casts = []
    for index, weight in enumerate(graph.initializer):
        values = numpy_helper.to_array(weight)
        if values.dtype == np.float32 and values.size >= _SMALLEST_WEIGHT:
            half = f"{weight.name}_half"
            casts.append(helper.make_node("Cast", [half], [weight.name], to=TensorProto.FLOAT))
            graph.initializer[index].CopyFrom(numpy_helper.from_array(values.astype(np.float16), half))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return model


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Hides the exporter's warnings about a missing torchvision, which is not needed, and about its own deprecated calls."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(before)
