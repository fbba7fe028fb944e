"""Helpers for tests of the command line: a model, image files, the command in its own process, and
its output.
"""

import json
import subprocess
import sys

import numpy as np
import onnx
from onnx import TensorProto, helper

from brewster import Photo

LAYERS = ("transmission", "reflection")


def write_onnx(path, nodes, constants, **channels):
    """Writes an ONNX model from `photo`, and other inputs with these channels, to the two layers.
    Returns its path.
    """

    def image(name, count=3):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, count, "height", "width"])

    inputs = [image("photo"), *(image(name, count) for name, count in channels.items())]
    initializers = [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(
        nodes, path.stem, inputs, [image(name) for name in LAYERS], initializers
    )
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path
    )
    return path


def write_pane(path):
    """Writes an ONNX model whose transmission is 80 % and whose reflection is 20 % of the photo.
    Returns its path.
    """
    nodes = [helper.make_node("Mul", ["photo", f"{name}_share"], [name]) for name in LAYERS]
    shares = {
        f"{name}_share": np.array(share, np.float32)
        for name, share in zip(LAYERS, (0.8, 0.2), strict=True)
    }
    return write_onnx(path, nodes, shares)


def image_bytes(width=60, height=40, format_name="jpeg", seed=1):
    """Returns an image of random 10x10 blocks as the bytes of a file."""
    small = np.random.default_rng(seed).integers(
        0, 256, (height // 10 + 1, width // 10 + 1, 3), np.uint8
    )
    array = np.kron(small, np.ones((10, 10, 1), np.uint8))[:height, :width]
    return Photo.from_array(array, encoding="srgb").encode(format_name)


def run_process(*args, **kwargs):
    """Runs the command `brewster` in its own process."""
    return subprocess.run(
        [sys.executable, "-m", "brewster", *map(str, args)],
        capture_output=True,
        check=False,
        **kwargs,
    )


def list_files(folder):
    """The paths of all files below a folder, sorted."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def layer_files(*names, suffix="jpg"):
    """The file names of the layers of these photos, sorted."""
    return sorted(f"{name}.{layer}.{suffix}" for name in names for layer in LAYERS)


def json_lines(out):
    """The JSON values in the lines of the output."""
    return [json.loads(line) for line in out.splitlines()]


def error_lines(err):
    """The lines of standard error that are error messages."""
    return [line for line in err.splitlines() if line.startswith("error: ")]
