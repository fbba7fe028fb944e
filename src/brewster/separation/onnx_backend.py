"""Runs an ONNX model as a `Backend`. Only this module imports ONNX Runtime."""

import functools
import os
from contextlib import nullcontext
from pathlib import Path
from threading import Lock
from typing import Final, final

import numpy as np

# Its telemetry, a device id and events with the path of the program, starts with the import (1.31,
# also on Linux)
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime as ort

from brewster.errors import DeviceError, ModelError
from brewster.separation.tiles import Hints, Image

_STRIDE_PX: Final = 32
"""The sides of the input of a network are multiples of this number. Tiles are padded by mirroring
their edges.
"""

# device name: (execution provider of ONNX Runtime, command that installs it), preferred devices
# first
_PROVIDERS: Final = {
    "cuda": ("CUDAExecutionProvider", "pip install onnxruntime-gpu"),
    "rocm": ("ROCMExecutionProvider", "pip install onnxruntime-rocm"),
    "directml": ("DmlExecutionProvider", "pip install onnxruntime-directml"),
    "coreml": ("CoreMLExecutionProvider", "pip install onnxruntime (on macOS)"),
    "cpu": ("CPUExecutionProvider", "pip install onnxruntime"),
}
DEVICES: Final = ("auto", *_PROVIDERS)


def available_devices() -> list[str]:
    """Returns the names of the devices that the installed ONNX Runtime supports, in order of
    preference.
    """
    installed = ort.get_available_providers()
    return [device for device, (provider, _) in _PROVIDERS.items() if provider in installed]


@final
class OnnxBackend:
    """A `Backend` from an ONNX file: input `photo` (1, 3, H, W), outputs `transmission` and
    `reflection`. Thread-safe.

    `takes_hints` tells whether it has a second input `hints` (1, 2, H, W), see
    `brewster.photo.Hints`. With `is_large`, one tile at a time is computed, and the file is not
    read into memory as a whole. `device` is a name from `DEVICES`; "auto" selects the first one
    that starts, in order of preference. Raises ModelError if the file is not an ONNX model, or has
    other inputs and outputs, and DeviceError if the device is unknown, missing, or does not start.
    """

    def __init__(self, model: Path, device: str = "auto", *, is_large: bool = False) -> None:
        self._one_at_a_time = Lock() if is_large else nullcontext()
        self._run_options = ort.RunOptions()
        # Memory is given back after each tile, for the layers at full size
        self._run_options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        data = str(model) if is_large else model.read_bytes()
        reason = ""
        for candidate in _candidates(device):
            try:
                session = _create_session(model, data, candidate)
            except (
                ModelError
            ) as error:  # a GPU without a driver or memory; on the CPU, a damaged model
                if candidate == "cpu":
                    raise
                reason = f": {error.happened}"
                continue
            if session.get_providers()[0] == _PROVIDERS[candidate][0]:
                self.device = candidate
                self._session = session
                self._check_names(model)
                return
        raise DeviceError(
            f"device {device} is installed but does not start{reason}",
            "expected a driver and libraries that match ONNX Runtime",
            "install them, or use --device auto or cpu",
        )

    def __call__(self, tile: Image, hints: Hints | None = None) -> tuple[Image, Image]:
        """Returns the transmission and the reflection of a tile. All three arrays are (H, W, 3), of
        any size, in linear light, about 0..1. `hints` are (H, W, 2) in 0..1. Raises ModelError if
        the model fails on this tile.
        """
        height, width, _ = tile.shape
        margins = [(0, -side % _STRIDE_PX) for side in (height, width)]
        feed = {"photo": tile}
        if self.takes_hints:
            feed["hints"] = np.zeros((height, width, 2), np.float32) if hints is None else hints
        for name, image in feed.items():
            padded = np.pad(image, [*margins, (0, 0)], mode="symmetric")
            feed[name] = np.ascontiguousarray(padded.transpose(2, 0, 1)[None], dtype=np.float32)
        try:
            with self._one_at_a_time:
                outputs = self._session.run(["transmission", "reflection"], feed, self._run_options)
        except Exception as error:
            raise ModelError(
                f"the model failed on a tile of {width}x{height} pixels ({_first_line(error)})",
                "expected a model that accepts all sizes that are multiples of 32",
                "check the model with brewster models verify, or use --device cpu",
            ) from error
        shape = feed["photo"].shape
        if found := [layer.shape for layer in outputs if layer.shape != shape]:
            raise ModelError(
                f"an output of the model has the shape {found[0]}",
                f"expected {shape}, the shape of the input photo",
                "export the model with outputs of the size of its input",
            )
        transmission, reflection = (
            layer[0, :, :height, :width].transpose(1, 2, 0) for layer in outputs
        )
        return transmission, reflection

    def _check_names(self, model: Path) -> None:
        inputs = [value.name for value in self._session.get_inputs()]
        outputs = {value.name for value in self._session.get_outputs()}
        self.takes_hints = inputs == ["photo", "hints"]
        if (
            inputs[:1] != ["photo"]
            or len(inputs) > 1 + self.takes_hints
            or not outputs >= {"transmission", "reflection"}
        ):
            raise ModelError(
                f"{model} has the inputs {inputs} and the outputs {sorted(outputs)}",
                "expected the inputs photo and perhaps hints, and the outputs transmission and "
                "reflection",
                "export it with brewster train",
            )


@final
class OnnxFunction:
    """A function of images from an ONNX file, on the CPU: inputs (1, 3, H, W) with names, one
    output. Thread-safe. Raises ModelError if the file is not an ONNX model.

    Args:
        model: the path of the file.
    """

    def __init__(self, model: Path) -> None:
        self._session = _create_session(model, model.read_bytes(), "cpu")

    def __call__(self, **images: Image) -> Image:
        """Returns the output, (h, w, 3).

        Args:
            images: (H, W, 3) each, of one size, by the names of the inputs. H and W are multiples
                of 32.
        """
        feed = {
            name: np.ascontiguousarray(image.transpose(2, 0, 1)[None], dtype=np.float32)
            for name, image in images.items()
        }
        output: Image = self._session.run(None, feed)[0][0].transpose(1, 2, 0)
        return output


@functools.cache
def _register_exact_arena() -> None:
    """Gives large models an arena that grows by what is requested: the usual one doubles (RDNet 5.2
    GiB in place of 3.4), and without one DSRNet and DSIT take up to twice as long.
    """
    memory = ort.OrtMemoryInfo(
        "Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT
    )
    ort.create_and_register_allocator(memory, ort.OrtArenaCfg(0, 1, -1, -1))


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:120] if str(error) else type(error).__name__


def _create_session(model: Path, data: bytes | str, device: str) -> ort.InferenceSession:
    """Creates a session on the device. If the libraries of the device do not load, ONNX Runtime
    uses the CPU.
    """
    options = ort.SessionOptions()
    options.log_severity_level = 3
    # Threads that wait in a loop take a sixth of the processor time of a photo
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if isinstance(data, str):  # a large model
        _register_exact_arena()
        options.add_session_config_entry("session.use_env_allocators", "1")
        options.enable_mem_pattern = False
    # Ray and our workers limit the number of threads with this variable. ONNX Runtime does not read
    # it.
    threads = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    options.intra_op_num_threads = (
        int(threads) if threads.isdigit() else 0
    )  # 0: one thread per core
    providers = dict.fromkeys([_PROVIDERS[device][0], "CPUExecutionProvider"])
    try:
        return ort.InferenceSession(data, options, list(providers), enable_fallback=0)
    except Exception as error:
        raise ModelError(
            f"{model} is not a model that ONNX Runtime can load on {device} ({_first_line(error)})",
            "expected an .onnx file that brewster train has exported",
            "check the file",
        ) from error


def _candidates(device: str) -> list[str]:
    available = available_devices()
    if device == "auto":
        return available
    if device not in _PROVIDERS:
        raise DeviceError(
            f"the device {device!r} is unknown",
            f"expected one of {', '.join(DEVICES)}",
            "use --device auto",
        )
    if device not in available:
        raise DeviceError(
            f"device {device} is not available to the installed ONNX Runtime",
            f"expected one of {', '.join(available)}",
            f"run: {_PROVIDERS[device][1]}, or use --device auto",
        )
    return [device]
