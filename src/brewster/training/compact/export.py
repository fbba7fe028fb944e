"""Exports a trained network to ONNX, which runs without torch."""

import logging
import warnings
from collections.abc import Mapping
from pathlib import Path

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from brewster.base.files import write_atomically
from brewster.errors import ModelError, read_errors
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.models.half_weights import HALF_SUFFIX, with_half_weights
from brewster.separation.models.linear_separator import LinearSeparator
from brewster.separation.models.networks import MAX_STRIDE, NetworkEntry

_OPSET = 18
_PREFIX = "network."
"""The prefix of the weights' names: `LinearSeparator` contains the network."""


def export_onnx(network: nn.Module, path: Path, entry: NetworkEntry) -> None:
    """Writes the network as ONNX: input `photo`, outputs `transmission` and `reflection`, linear
    light, (1, 3, H, W).

    H and W are multiples of MAX_STRIDE. Networks that take hints have a second input `hints`, (1,
    2, H, W). The weights are stored in half precision; the network computes in float32. Raises
    OutputError if the file cannot be written.
    """
    names = ["photo", "hints"][: 1 + entry.takes_hints]
    _export(
        LinearSeparator(network, to_encoded, to_linear),
        path,
        dict(zip(names, (3, 2), strict=False)),
        ["transmission", "reflection"],
    )


def export_film_light(network: nn.Module, path: Path) -> None:
    """Writes a `FilmLightNetwork` as ONNX, see there: inputs `transmission`, `reflection`, `photo`
    and `prior`, output `moved`. See `export_onnx`.
    """
    names = ("transmission", "reflection", "photo", "prior")
    _export(network, path, dict.fromkeys(names, 3), ["moved"])


def _export(
    network: nn.Module, path: Path, channels: Mapping[str, int], outputs: list[str]
) -> None:
    """Writes a network as ONNX, see `export_onnx`.

    Args:
        network: takes images of one size.
        path: that of the file.
        channels: those of each input, by name.
        outputs: the names of the outputs.
    """
    height, width = (torch.export.Dim(name, min=1, max=256) for name in ("rows", "columns"))
    examples = [torch.rand(1, count, 4 * MAX_STRIDE, 5 * MAX_STRIDE) for count in channels.values()]
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    # torchvision is not needed, the exporter calls deprecated functions, and the inputs have the
    # same size
    logger.setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        warnings.filterwarnings("ignore", message=".*axis name", category=UserWarning)
        program = torch.onnx.export(
            network.eval(),
            tuple(examples),
            input_names=list(channels),
            output_names=outputs,
            dynamic_shapes={
                name: {2: MAX_STRIDE * height, 3: MAX_STRIDE * width} for name in channels
            },
            opset_version=_OPSET,
            dynamo=True,
            verbose=False,
        )
    logger.setLevel(level)
    assert program is not None
    model = with_half_weights(program.model_proto)
    write_atomically(path, model.SerializeToString(), overwrite=True)


def read_weights(path: Path) -> dict[str, Tensor]:
    """Returns the weights of a network in a file of `export_onnx`, in the half precision of the
    file, by name. Raises ModelError if the file cannot be read.
    """
    expected = "expected a model that brewster train has exported"
    with read_errors(path, ModelError, expected, "check the file", (Exception,)):
        graph = onnx.load(path).graph
    return {
        tensor.name.removeprefix(_PREFIX).removesuffix(HALF_SUFFIX): torch.tensor(
            numpy_helper.to_array(tensor)
        ).float()
        for tensor in graph.initializer
        if tensor.name.startswith(_PREFIX)
    }
