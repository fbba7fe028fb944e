"""What can be asked of a separation, written once: the command line, its help and a web form are made from it.

The metadata of each field are keywords of `pydantic.Field`, so that `pydantic.TypeAdapter(Options)` gives an
HTTP API its checks and its JSON schema, while `brewster --help` needs no pydantic.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypedDict, final

from brewster.errors import BrewsterError
from brewster.files import DEFAULT_MAX_PIXELS, SUFFIXES

Layer = Literal["transmission", "reflection", "confidence"]
Quality = Literal["draft", "standard", "best"]
Container = Literal["jpeg", "png", "tiff", "webp", "avif", "heic", "exr", "hdr"]
Device = Literal["auto", "cuda", "rocm", "directml", "coreml", "cpu"]

Quantisation = Literal["int8", "float8", "nf4"]
"""How a large base is stored that would not fit as it is: 8 bits by torchao, 4 by bitsandbytes."""


class DiffusionOptions(TypedDict, total=False):
    """What can be asked of large image models alone; see `Options` for what each is."""

    base: str | None
    quantise: Quantisation | None
    steps: int | None
    average: int
    plain: bool


_FLOAT_CONTAINERS = ("tiff", "exr")
_SUFFIXES = {"jpeg": ".jpg"}  # the others are the container's name


def _about(description: str, **limits: int) -> dict[str, Any]:
    return {"description": description, **limits}


@final
@dataclass(frozen=True)
class Options:
    """What can be asked of a separation."""

    layers: tuple[Layer, ...] = field(
        default=("transmission", "reflection"),
        metadata=_about("The layers to write, with commas between: transmission, reflection, confidence."),
    )
    strength: float = field(
        default=1.0,
        metadata=_about(
            "How much to separate, from 0 (the photo as it is) to 1 (the whole separation).", ge=0, le=1
        ),
    )
    quality: Quality = field(
        default="standard",
        metadata=_about("How closely the network looks: draft is fastest, best is slowest."),
    )
    additive: bool = field(
        default=False,
        metadata=_about(
            "Write layers that sum to the photo exactly: 32-bit floats in linear light, TIFF or EXR."
        ),
    )
    format: Container | None = field(
        default=None,
        metadata=_about("Write transmission and reflection in this container instead of the photo's own."),
    )
    model: str = field(
        default="compact",
        metadata=_about(
            "The model to use: a name from `brewster models list`, an .onnx file, or a LoRA's folder or hub id."
        ),
    )
    device: Device = field(
        default="auto",
        metadata=_about("Where the network runs; auto takes the fastest device that is there."),
    )
    base: str | None = field(
        default=None,
        metadata=_about(
            "Of a LoRA: the folder or hub id of its base, if that lies not where it was trained."
        ),
    )
    quantise: Quantisation | None = field(
        default=None,
        metadata=_about("Of large models: store the weights in 8 or 4 bits, as small cards need it."),
    )
    steps: int | None = field(
        default=None,
        metadata=_about(
            "Of large models: steps for each look, 20 if not said otherwise, and 4 for a draft.", ge=1
        ),
    )
    average: int = field(
        default=1,
        metadata=_about("Of large models: how many answers are averaged.", ge=1),
    )
    plain: bool = field(
        default=False,
        metadata=_about(
            "Of large models: the transmission as it is drawn, enlarged, without the photo's own detail."
        ),
    )
    max_pixels: int = field(
        default=DEFAULT_MAX_PIXELS,
        metadata=_about("Refuse photos of more pixels than this, before decoding them.", ge=1),
    )

    def __post_init__(self) -> None:
        """Refuses values that do not go together."""
        if self.additive and self.format not in (None, *_FLOAT_CONTAINERS):
            raise BrewsterError(
                f"additive layers were asked for as {self.format}",
                "their 32-bit floats fit only into TIFF and EXR",
                "choose format tiff or exr, or leave additive out",
            )

    def load_options(self) -> dict[str, Any]:
        """The keywords for loading a `Separator`."""
        large = {name: getattr(self, name) for name in DiffusionOptions.__annotations__}
        asked = {name: value for name, value in large.items() if value != getattr(Options, name)}
        return {"model": self.model, "device": self.device, **asked}

    def call_options(self) -> dict[str, Any]:
        """The keywords for calling a `Separator`."""
        return {name: getattr(self, name) for name in ("strength", "quality", "additive", "max_pixels")}

    def container(self, layer: str, own: str) -> str:
        """The container of a layer of a photo whose own container is `own`; confidence is always PNG."""
        if layer == "confidence":
            return "png"
        if self.additive and own not in _FLOAT_CONTAINERS:
            own = "tiff"
        return self.format or own

    def suffix(self, layer: str, source: Path) -> str | None:
        """The suffix of a layer's file; None where it is the source's."""
        own = SUFFIXES.get(source.suffix.lower(), "")
        container = self.container(layer, own)
        return None if container == own else _SUFFIXES.get(container, f".{container}")
