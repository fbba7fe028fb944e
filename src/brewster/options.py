"""The options of a separation: type, default, limits and meaning of each, written once.

The command line, its help and the schema of HTTP requests are generated from `Options`, and so are
the defaults of the Python API. The docstring below a field is its help. Its metadata are the group
of functions that take it, and limits: keywords of `pydantic.Field`, by which pydantic checks the
values of `Options` and of HTTP requests.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypedDict, final, get_type_hints

from brewster.base.files import DEFAULT_MAX_PIXELS, LAYER_FORMATS
from brewster.base.image_formats import FORMATS, SUFFIXES, FormatName, canonical_format
from brewster.errors import BrewsterError, invalid_value

if TYPE_CHECKING:
    from pydantic import ConfigDict, TypeAdapter

Layer = Literal["transmission", "reflection", "confidence", "layered"]
Quality = Literal["draft", "standard"]
Device = Literal["auto", "cuda", "rocm", "directml", "coreml", "cpu"]

Quantization = Literal["int8", "nf4"]
"""The number format of the weights of a base model: int8 by torchao, nf4 (4 bits) by bitsandbytes.
"""

Offload = Literal["auto", "none", "layers"]
"""Whether the weights of a diffusion model are kept in host memory and copied to the GPU layer by
layer.
"""

BurstMethod = Literal["auto", "motion", "light", "single"]
"""How a burst is to be separated. auto: by the motion of the layers, or by the change of the light
if the camera stood, if the measurement agrees with the photos. motion: by the motion in any case.
light: by the change of the light. single: the reference photo alone.
"""


class LoadOptions(TypedDict, total=False):
    """The keywords of `Separator.load` besides the model, for type checkers: the fields of this
    group of `Options`. All but the device are for diffusion models.
    """

    device: Device
    base_model: str | None
    quantization: Quantization | None
    offload: Offload
    guidance: float | None
    steps: int | None
    ensemble_size: int
    no_guided_upsampling: bool


MAX_BURST_PHOTOS: Final = 15
"""Larger bursts take longer and are hardly better."""
MAX_LIGHT_PHOTOS: Final = 60
"""The same for the method light: a time-lapse."""
DEFAULT_FRAMES: Final = 7
"""The number of frames that are chosen from a video."""

FILM_AUTO: Final = "auto"
FILM_NO: Final = "no"

Group = Literal["batch", "call", "load", "burst"]
"""What takes an option: batch, only what reads and writes files; call, the call of a `Separator`;
load, `Separator.load`; burst, the separation of several photos, or of a film.
"""

PYDANTIC_CONFIG: Final[ConfigDict] = {"use_attribute_docstrings": True, "allow_inf_nan": False}
"""Of a dataclass: the docstring below a field is its description. Floats are finite."""


def _option(default: Any, group: Group, **limits: int) -> Any:  # noqa: ANN401  (a field of any type)
    return field(default=default, metadata={"group": group, **limits})


@final
@dataclass(frozen=True)
class Options:
    """The options of a separation, of one photo or of a burst.

    The values are checked, and converted to the types of their fields. The path of a mask may be a
    text, and a format may be one of its suffixes, such as `jpg`. Raises BrewsterError if a value is
    invalid, or `additive` is set and the format does not store 32-bit floats.
    """

    __pydantic_config__ = PYDANTIC_CONFIG

    layers: tuple[Layer, ...] = _option(("transmission", "reflection"), "batch")
    """The layers to write, separated by commas: transmission, reflection, confidence; layered
    is one OpenRaster file (.ora) with both layers, for image editors.
    """
    strength: float = _option(1.0, "call", ge=0, le=1)
    """How much of the separation to apply, from 0 (the unchanged photo) to 1 (the full
    separation).
    """
    quality: Quality = _option("standard", "call")
    """Number and size of the input scales: draft is faster than standard."""
    mask: Path | None = _option(None, "call")
    """A grey image of the size of the photo that scales the strength: white is separated, black
    stays unchanged.
    """
    hints: Path | None = _option(None, "call")
    """An image of the size of the photo that helps the model: red where there is reflection,
    green where there is only the scene, rough strokes on black or transparent.
    """
    film: str = _option(FILM_AUTO, "batch")
    """The film that a phone recorded around the photo (Live Photo, Motion Photo): auto uses it
    if it helps, no does not; or the path of a film.
    """
    additive: bool = _option(False, "call")
    """Write layers that sum to the photo exactly: 32-bit floats in linear light, TIFF or EXR."""
    format: FormatName | None = _option(None, "batch")
    """The file format of the transmission and the reflection; by default, the format of the
    photo.
    """
    model: str = _option("compact", "load")
    """The model to use: a name from `brewster models list`, an .onnx file, the folder of a
    training run, or a LoRA's folder or hub id.
    """
    device: Device = _option("auto", "load")
    """The device that runs the model; auto selects the fastest one available."""
    base_model: str | None = _option(None, "load")
    """For a LoRA: the folder or hub id of its base model, if it has moved since training."""
    quantization: Quantization | None = _option(None, "load")
    """For diffusion models: store the weights in 8 or 4 bits; the default is the setting of the
    training, or fewer bits if the GPU has too little memory for it.
    """
    offload: Offload = _option("auto", "load")
    """For diffusion models: layers keeps the weights in host memory and copies each block to
    the GPU while it computes, which is slower; auto does this only if the weights do not fit
    into the free GPU memory.
    """
    guidance: float | None = _option(None, "load", ge=1)
    """For diffusion models: the guidance scale, by default that of the model."""
    steps: int | None = _option(None, "load", ge=1)
    """For diffusion models: sampling steps for each prediction; by default those of the model,
    usually 20; at most 4 for draft.
    """
    ensemble_size: int = _option(1, "load", ge=1)
    """For diffusion models: the number of predictions that are averaged."""
    no_guided_upsampling: bool = _option(False, "load")
    """For diffusion models: enlarge the generated transmission without adding fine detail from
    the photo.
    """
    max_pixels: int = _option(DEFAULT_MAX_PIXELS, "call", ge=1)
    """Refuse photos with more pixels than this, before they are decoded."""
    frames: int = _option(DEFAULT_FRAMES, "burst", ge=2, le=MAX_BURST_PHOTOS)
    """The number of frames to choose from a video."""
    all_frames: bool = _option(False, "burst")
    """Separate all frames of a video with the layers of one solution, and write the layers as
    videos.
    """
    reference: int | None = _option(None, "burst", ge=1, le=MAX_LIGHT_PHOTOS)
    """The photo of a burst to separate: 1 is the first one; by default, the middle one."""
    method: BurstMethod = _option("auto", "burst")
    """How to separate a burst: auto by the motion of the layers, or by the change of the light
    if the camera stood, if the measurement agrees with the photos; motion by the motion in any
    case, light by the light, single the reference photo alone.
    """
    swap: bool = _option(False, "burst")
    """Exchange the measured layers of a burst: which of them is behind the glass is not always
    certain.
    """

    def __post_init__(self) -> None:
        """Checks and converts all values that differ from their defaults."""
        if isinstance(self.format, str):
            object.__setattr__(self, "format", canonical_format(self.format))
        for option in fields(self):
            value = getattr(self, option.name)
            if type(value) is not type(option.default) or value != option.default:
                from pydantic import ValidationError  # noqa: PLC0415  (slow, and not needed for the default options)

                try:
                    checked = _validators()[option.name].validate_python(value)
                except ValidationError as error:
                    raise invalid_value({**error.errors()[0], "loc": (option.name,)}) from error
                object.__setattr__(self, option.name, checked)
        if not self.layers:
            raise BrewsterError(
                "layers is empty", "expected at least one layer", "add a layer, or leave layers out"
            )
        if self.additive and self.format and not FORMATS[self.format].has_float32:
            raise BrewsterError(
                f"additive layers were requested as {self.format}",
                "expected tiff or exr, because only these store 32-bit floats",
                "choose format tiff or exr, or leave additive out",
            )

    def load_options(self) -> dict[str, Any]:
        """Returns the keywords for `Separator.load`."""
        return {name: getattr(self, name) for name in option_names("load")}

    def call_options(self) -> dict[str, Any]:
        """Returns the keywords for calling a `Separator`."""
        return {name: getattr(self, name) for name in option_names("call")}

    @property
    def reference_index(self) -> int | None:
        """The index of the photo of a burst to separate, from 0, or None for the middle one."""
        return self.reference and self.reference - 1

    def format_name(self, layer: str, source_format: str) -> str:
        """Returns the file format of a layer. Confidence is always PNG.

        Args:
            layer: the name of the layer, such as "transmission".
            source_format: the format of the photo, such as "jpeg".
        """
        if layer in LAYER_FORMATS:
            return LAYER_FORMATS[layer]
        if self.additive and not FORMATS[source_format].has_float32:
            source_format = "tiff"
        return self.format or source_format

    def suffix(self, layer: str, photo_suffix: str) -> str:
        """Returns the suffix of a layer's file: that of the photo if the format is the same, such
        as `.JPG`.

        If brewster does not write the format of the photo, the suffix is that of the format that
        replaces it: .tiff for RAW files, .png for GIF and OpenRaster.

        Args:
            layer: the name of the layer, such as "transmission".
            photo_suffix: the suffix of the photo, an image suffix such as ".JPG".
        """
        source_format = SUFFIXES[photo_suffix.lower()]
        format_name = self.format_name(layer, source_format.written_as)
        is_same = layer not in LAYER_FORMATS and format_name == source_format.name
        return photo_suffix if is_same else FORMATS[format_name].suffixes[0]


def option_names(*groups: Group) -> tuple[str, ...]:
    """Returns the names of the options of these groups, in the order of `Options`.

    Args:
        groups: names of groups.
    """
    return tuple(option.name for option in fields(Options) if option.metadata["group"] in groups)


def check_keywords(given: Iterable[str], *groups: Group) -> None:
    """Checks the names of keywords. Raises TypeError if one is not an option of these groups.

    Args:
        given: the names.
        groups: names of groups.
    """
    expected = option_names(*groups)
    if unknown := sorted({*given} - {*expected}):
        raise TypeError(f"there is no option {unknown[0]}; expected {', '.join(expected)}")


def field_schemas(settings: type[Any]) -> Mapping[str, Mapping[str, Any]]:
    """Returns the JSON schema of each field of a dataclass, by name. The description is the
    docstring below the field, in one line.

    Args:
        settings: a dataclass with `PYDANTIC_CONFIG`.
    """
    from pydantic import TypeAdapter  # noqa: PLC0415  (slow, and needed only for help and schemas)

    schemas = TypeAdapter(settings).json_schema()["properties"]
    return {
        name: {**schema, "description": " ".join(schema["description"].split())}
        for name, schema in schemas.items()
    }


@cache
def _validators() -> Mapping[str, TypeAdapter[Any]]:
    from pydantic import Field, TypeAdapter  # noqa: PLC0415

    hints = get_type_hints(Options)
    limits = {
        option.name: Field(ge=option.metadata.get("ge"), le=option.metadata.get("le"))
        for option in fields(Options)
    }
    types: dict[str, Any] = {name: Annotated[hints[name], limits[name]] for name in limits}
    return {name: TypeAdapter(hint, config=PYDANTIC_CONFIG) for name, hint in types.items()}
