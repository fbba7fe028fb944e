"""Reads LoRAs of other programs: the key styles of peft, diffusers, kohya's sd-scripts and ComfyUI,
with the names of layers in diffusers.

Any rank and any selection of layers are accepted. The scale alpha / rank of a layer is multiplied
into its B matrix, so the change of a layer's weight is B @ A. Keys that are not understood are an
error, never ignored.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from torch import Tensor, nn

from brewster.errors import ModelError

_PREFIXES: Final = {
    "base_model.model.": "peft",
    "model.diffusion_model.": "ComfyUI",
    "diffusion_model.": "ComfyUI",
    "transformer.": "diffusers",
    "lora_unet_": "kohya",
    "lora_transformer_": "kohya",
}
"""Prefix of a key -> the program that writes it. A key may have several of these prefixes."""
_PREFIX: Final = re.compile(f"^({'|'.join(map(re.escape, _PREFIXES))})+")
_KEY: Final = re.compile(
    r"(?P<layer>.+?)\.(?:(?P<matrix>lora_A|lora_B|lora_down|lora_up)(?:\.(?!weight$)[^.]+)?\.weight|alpha)"
)
"""A layer, then `lora_A`, `lora_B` (peft) or `lora_down`, `lora_up` (kohya), the name of the
adapter, or `alpha`.
"""
DOWN_SUFFIX: Final = ".lora_A.weight"
UP_SUFFIX: Final = ".lora_B.weight"
"""The suffixes of the keys of a layer's two matrices in a state dict of brewster, peft and
diffusers.
"""
_SUFFIXES: Final = {
    "lora_A": DOWN_SUFFIX,
    "lora_down": DOWN_SUFFIX,
    "lora_B": UP_SUFFIX,
    "lora_up": UP_SUFFIX,
    None: "alpha",
}

ScalingFunction = Callable[[str, int], float]
"""The factor alpha / rank for a layer, by its name in the file, and its rank."""


def read_lora_layers(
    tensors: Mapping[str, Tensor],
    transformer: nn.Module,
    backbone: str,
    scale: ScalingFunction | None = None,
) -> dict[str, Tensor]:
    """The two matrices of each layer with the keys of `lora_state_dict`, float32, with the scale
    multiplied into B. The transformer may be on the device "meta". `scale` is for files without
    alphas; by default 1, as in other programs.
    """
    layers = {
        name: module
        for name, module in transformer.named_modules()
        if isinstance(module, nn.Linear)
    }
    names = {name.replace(".", "_"): name for name in layers} | {
        name: name for name in layers
    }  # kohya writes _
    state: dict[str, Tensor] = {}
    for name, parts in _parse(tensors, backbone).items():
        if parts.keys() == {"alpha"}:
            raise _unknown(f"{name}.alpha", tensors, backbone)
        if name not in names:
            raise _unknown(name, tensors, backbone)
        if not parts.keys() >= {DOWN_SUFFIX, UP_SUFFIX}:
            raise ModelError(
                f"the LoRA has only one of two matrices for {name}",
                "expected both",
                "copy the file again",
            )
        layer = names[name]
        down = parts[DOWN_SUFFIX].float()
        up = parts[UP_SUFFIX].float()
        if layer + DOWN_SUFFIX in state:
            raise _repeated(layer)
        rank = len(down)
        expected = layers[layer].out_features, layers[layer].in_features
        if (*up.shape, *down.shape) != (expected[0], rank, rank, expected[1]):
            raise ModelError(
                f"the LoRA of {layer} has matrices of {tuple(up.shape)} and {tuple(down.shape)}",
                f"expected a layer with {expected[0]} x {expected[1]} weights",
                "use the base with which it was trained",
            )
        factor = (
            float(parts["alpha"]) / rank
            if "alpha" in parts
            else scale(name, rank)
            if scale
            else 1.0
        )
        state |= {layer + DOWN_SUFFIX: down, layer + UP_SUFFIX: up * factor}
    return dict(sorted(state.items()))


def lora_format(tensors: Mapping[str, Tensor]) -> str:
    """The program whose key style a LoRA file has: peft, diffusers, kohya, ComfyUI, or unknown."""
    styles = {
        style for key in tensors for prefix, style in _PREFIXES.items() if key.startswith(prefix)
    }
    if not styles:
        is_plain = any(match and match["matrix"] for match in map(_KEY.fullmatch, tensors))
        return "peft" if is_plain else "unknown"
    return " and ".join(sorted(styles))


def _parse(tensors: Mapping[str, Tensor], backbone: str) -> dict[str, dict[str, Tensor]]:
    """The parts of each layer, by its name in the file without prefix: matrices by suffix, and
    perhaps "alpha".
    """
    layers: dict[str, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if not (match := _KEY.fullmatch(key)):
            raise _unknown(key, tensors, backbone)
        name = _PREFIX.sub("", match["layer"])
        part = _SUFFIXES[match["matrix"]]
        if part in layers.setdefault(name, {}):
            raise _repeated(name)
        layers[name][part] = tensor
    if not layers:
        happened = "the file contains no LoRA"
        raise ModelError(
            happened, "expected matrices lora_A and lora_B for each layer", "check the file"
        )
    return layers


def _repeated(layer: str) -> ModelError:
    cure = "use a file with one LoRA, in one style of keys"
    return ModelError(
        f"the file has more than one LoRA for the layer {layer}", "expected each layer once", cure
    )


def _unknown(key: str, tensors: Mapping[str, Tensor], backbone: str) -> ModelError:
    happened = (
        f"the key {key} of the LoRA, in the style of {lora_format(tensors)}, belongs to "
        f"no layer of {backbone}"
    )
    if re.match("(double|single)_blocks", key):
        cure = (
            "convert it with lora_state_dict of diffusers (docs/diffusion-models.md), or "
            "choose its base or another file"
        )
        return ModelError(
            happened, f"expected the names of the linear layers of {backbone} in diffusers", cure
        )
    return ModelError(
        happened,
        f"expected only two LoRA matrices for each of some linear layers of {backbone}",
        "choose the base with which it was trained, or another file of this LoRA, without DoRA, "
        "LoKr or biases",
    )


def scaling_from_config(settings: Mapping[str, Any], prefix: str = "") -> ScalingFunction:
    """alpha / rank from the settings of peft: `lora_alpha`, `alpha_pattern` and `use_rslora`
    (Kalajdzievski 2023). `prefix` is that of the keys in the settings, such as "transformer." in
    the metadata that diffusers writes.
    """
    values = {key.removeprefix(prefix): value for key, value in settings.items()}
    patterns = {
        key.removeprefix(prefix): float(alpha)
        for key, alpha in (values.get("alpha_pattern") or {}).items()
    }

    def scale(name: str, rank: int) -> float:
        found = (alpha for key, alpha in patterns.items() if re.match(rf"(.*\.)?({key})$", name))
        alpha = next(found, float(values.get("lora_alpha", rank)))
        return alpha / (math.sqrt(rank) if values.get("use_rslora") else rank)

    return scale
