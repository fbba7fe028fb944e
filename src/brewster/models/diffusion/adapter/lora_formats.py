"""Reads LoRAs of other programs: the key styles of peft, diffusers, kohya's sd-scripts and ComfyUI.

    layers = read_lora_layers(tensors, backbone.transformer, "kontext", scaling_from_config(settings))
    attach_layers(backbone, layers)         # in lora.py

Any rank and any selection of layers are accepted. The scale alpha / rank of a layer is multiplied into its B matrix, so the change of a
layer's weight is B @ A. Keys that are not understood are an error, never ignored.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, final

from torch import Tensor, nn

from brewster.errors import ModelError

if TYPE_CHECKING:
    from jaxtyping import Float

_PREFIXES: Final = {
    "base_model.model.": "peft",
    "model.diffusion_model.": "ComfyUI",
    "diffusion_model.": "ComfyUI",
    "transformer.": "diffusers",
    "lora_unet_": "kohya",
    "lora_transformer_": "kohya",
}
"""Prefix of a key -> the program that writes it. A key may have several of these prefixes."""
_KEY: Final = re.compile(
    r"(?P<module>.+?)\.(?:(?P<matrix>lora_A|lora_B|lora_down|lora_up)(?:\.(?!weight$)[^.]+)?\.weight|(?P<alpha>alpha))"
)
"""A layer, then `lora_A`, `lora_B` (peft) or `lora_down`, `lora_up` (kohya), the name of the adapter, or `alpha`."""
DOWN_SUFFIX: Final = ".lora_A.weight"
UP_SUFFIX: Final = ".lora_B.weight"
"""The suffixes of the keys of a layer's two matrices in a state dict of brewster, peft and diffusers."""
_DOWN: Final = ("lora_A", "lora_down")
_UNSUPPORTED: Final = {
    r"dora_scale|lora_magnitude": "DoRA matrices",
    r"lokr_": "LoKr matrices",
    r"hada_": "LoHa matrices",
    r"\.diff(_b)?$": "differences of whole weights",
    r"\.bias$": "biases",
    r"\.processor\.(qkv|proj)_lora": "keys of XLabs",
    r"lora\.(down|up)\.": "keys of an old version of diffusers",
    r"(^|\.)(lora_te|text_encoder|te1_|te2_)": "a LoRA that also changes a text encoder",
}
"""Regular expression for a part of a key -> what a file with this key contains."""

_STREAM_NAMES: Final = {
    "img_attn.qkv": ("attn.to_q", "attn.to_k", "attn.to_v"),
    "img_attn.proj": ("attn.to_out.0",),
    "txt_attn.qkv": ("attn.add_q_proj", "attn.add_k_proj", "attn.add_v_proj"),
    "txt_attn.proj": ("attn.to_add_out",),
}
_ORIGINAL_NAMES: Final[dict[str, dict[str, dict[str, tuple[str, ...]]]]] = {
    "kontext": {
        "double_blocks.{}.": {
            **_STREAM_NAMES,
            "img_mod.lin": ("norm1.linear",), "txt_mod.lin": ("norm1_context.linear",),
            "img_mlp.0": ("ff.net.0.proj",), "img_mlp.2": ("ff.net.2",),
            "txt_mlp.0": ("ff_context.net.0.proj",), "txt_mlp.2": ("ff_context.net.2",),
        },
        "single_blocks.{}.": {
            "linear1": ("attn.to_q", "attn.to_k", "attn.to_v", "proj_mlp"),
            "linear2": ("proj_out",), "modulation.lin": ("norm.linear",),
        },
        "": {
            "img_in": ("x_embedder",), "txt_in": ("context_embedder",), "final_layer.linear": ("proj_out",),
            "final_layer.adaLN_modulation.1": ("norm_out.linear",),
            "time_in.in_layer": ("time_text_embed.timestep_embedder.linear_1",),
            "time_in.out_layer": ("time_text_embed.timestep_embedder.linear_2",),
            "vector_in.in_layer": ("time_text_embed.text_embedder.linear_1",),
            "vector_in.out_layer": ("time_text_embed.text_embedder.linear_2",),
            "guidance_in.in_layer": ("time_text_embed.guidance_embedder.linear_1",),
            "guidance_in.out_layer": ("time_text_embed.guidance_embedder.linear_2",),
        },
    },
    "klein": {
        "double_blocks.{}.": {
            **_STREAM_NAMES,
            "img_mlp.0": ("ff.linear_in",), "img_mlp.2": ("ff.linear_out",),
            "txt_mlp.0": ("ff_context.linear_in",), "txt_mlp.2": ("ff_context.linear_out",),
        },
        "single_blocks.{}.": {"linear1": ("attn.to_qkv_mlp_proj",), "linear2": ("attn.to_out",)},
        "": {
            "img_in": ("x_embedder",), "txt_in": ("context_embedder",), "final_layer.linear": ("proj_out",),
            "final_layer.adaLN_modulation.1": ("norm_out.linear",),
            "time_in.in_layer": ("time_guidance_embed.timestep_embedder.linear_1",),
            "time_in.out_layer": ("time_guidance_embed.timestep_embedder.linear_2",),
            "double_stream_modulation_img.lin": ("double_stream_modulation_img.linear",),
            "double_stream_modulation_txt.lin": ("double_stream_modulation_txt.linear",),
            "single_stream_modulation.lin": ("single_stream_modulation.linear",),
        },
    },
}  # fmt: skip
"""Backbone -> prefix -> layer in the original code of the model -> its layers in diffusers. If an original
layer has several layers in diffusers, its rows are their rows, one layer after the other. Qwen has the same names in both."""
_BLOCKS: Final = {"double_blocks.{}.": "transformer_blocks", "single_blocks.{}.": "single_transformer_blocks"}
_SCALE_SHIFT_SWAPPED: Final = "norm_out.linear"
"""The layer whose two halves, scale and shift, have the opposite order in the original code."""


@final
@dataclass(frozen=True, eq=False)
class LowRankLayer:
    """The LoRA of one linear layer: the change of its weight is `up @ down`."""

    down: Float[Tensor, "r i"]
    up: Float[Tensor, "o r"]

    @property
    def rank(self) -> int:
        """The number of rows of `down`."""
        return len(self.down)


ScalingFunction = Callable[[str, int], float]
"""The factor alpha / rank for a layer, by its name in the file, and its rank."""


def read_lora_layers(
    tensors: Mapping[str, Tensor], transformer: nn.Module, backbone: str, scale: ScalingFunction | None = None
) -> dict[str, LowRankLayer]:
    """The LoRA of each layer by the layer's name in the transformer, float32, with the scale multiplied in.

    Only names and shapes of the transformer are read, so it may be on the device "meta". The scale alpha / rank is for files
    without alphas; by default 1, as in diffusers, sd-scripts and ComfyUI. Raises ModelError if a key is not understood, a
    matrix is missing, a layer occurs twice, or a layer or shape is not that of the transformer. The message names the style of
    the keys.
    """
    matrices, alphas = _parse(tensors, backbone)
    targets = _layer_names(transformer, backbone)
    layers: dict[str, LowRankLayer] = {}
    for name, pair in matrices.items():
        if name not in targets:
            raise _unknown(name, tensors, backbone)
        if set(pair) != {"down", "up"}:
            raise ModelError(
                f"the LoRA has only one of two matrices for {name}", "expected both", "copy the file again"
            )
        rank = len(pair["down"])
        factor = alphas[name] / rank if name in alphas else scale(name, rank) if scale else 1.0
        layer = LowRankLayer(pair["down"].float(), pair["up"].float() * factor)
        parts = _split(name, layer, targets[name], transformer)
        if repeated := sorted(parts.keys() & layers.keys()):
            raise _repeated(repeated[0])
        layers |= parts
    return layers


def adapted_layers(state: Mapping[str, Tensor]) -> list[str]:
    """Returns the names of the layers whose weights are in `state`, which has keys as those of `lora_state_dict`, sorted."""
    return sorted(key.removesuffix(UP_SUFFIX) for key in state if key.endswith(UP_SUFFIX))


def to_state_dict(layers: Mapping[str, LowRankLayer]) -> dict[str, Tensor]:
    """The weights with the names that `lora_state_dict` uses."""
    state: dict[str, Tensor] = {}
    for name, layer in sorted(layers.items()):
        state |= {name + DOWN_SUFFIX: layer.down, name + UP_SUFFIX: layer.up}
    return state


def lora_format(tensors: Mapping[str, Tensor]) -> str:
    """The program whose key style a LoRA file has: peft, diffusers, kohya, ComfyUI, or unknown."""
    styles = {style for key in tensors for prefix, style in _PREFIXES.items() if key.startswith(prefix)}
    if not styles:
        is_plain = any(match and match["matrix"] for match in map(_KEY.fullmatch, tensors))
        return "peft" if is_plain else "unknown"
    return " and ".join(sorted(styles))


def _parse(
    tensors: Mapping[str, Tensor], backbone: str
) -> tuple[dict[str, dict[str, Tensor]], dict[str, float]]:
    """The matrices "down" and "up" of each layer, and the alphas, by the layer's name in the file without its prefix."""
    matrices: dict[str, dict[str, Tensor]] = {}
    alphas: dict[str, float] = {}
    for key, tensor in tensors.items():
        match = _KEY.fullmatch(key)
        if not match:
            raise _unknown(key, tensors, backbone)
        name, part = match["module"], "down" if match["matrix"] in _DOWN else "up"
        while prefix := next((prefix for prefix in _PREFIXES if name.startswith(prefix)), ""):
            name = name.removeprefix(prefix)
        if name in alphas if match["alpha"] else part in matrices.get(name, {}):
            raise _repeated(name)
        if match["alpha"]:
            alphas[name] = float(tensor)
        else:
            matrices.setdefault(name, {})[part] = tensor
    if unused := sorted(alphas.keys() - matrices.keys()):
        raise _unknown(f"{unused[0]}.alpha", tensors, backbone)
    if not matrices:
        raise ModelError(
            "the file contains no LoRA",
            "expected matrices lora_A and lora_B for each layer",
            "check the file",
        )
    return matrices, alphas


def _layer_names(transformer: nn.Module, backbone: str) -> dict[str, tuple[str, ...]]:
    """Name of a layer in a file -> its layers in diffusers. kohya writes _ for each dot."""
    linear = [name for name, module in transformer.named_modules() if isinstance(module, nn.Linear)]
    names: dict[str, tuple[str, ...]] = {name: (name,) for name in linear}
    for prefix, table in _ORIGINAL_NAMES.get(backbone, {}).items():
        blocks = _BLOCKS.get(prefix)
        count = len(transformer.get_submodule(blocks)) if blocks else 1  # type: ignore[arg-type]
        for index in range(count):
            start = f"{blocks}.{index}." if blocks else ""
            for original, parts in table.items():
                targets = tuple(start + part for part in parts)
                if set(targets) <= names.keys():
                    names[prefix.format(index) + original] = targets
    return {name.replace(".", "_"): targets for name, targets in names.items()} | names


def _split(
    name: str, layer: LowRankLayer, targets: tuple[str, ...], transformer: nn.Module
) -> dict[str, LowRankLayer]:
    """Divides a layer of the original code into its layers in diffusers, which have equal matrices `down`."""
    sizes = [int(transformer.get_submodule(target).out_features) for target in targets]  # type: ignore[arg-type]
    if sum(sizes) != len(layer.up):
        raise ModelError(
            f"the LoRA of {name} has {len(layer.up)} rows",
            f"expected {sum(sizes)}",
            "use the base with which it was trained",
        )
    parts = layer.up.split(sizes)  # type: ignore[no-untyped-call]
    if targets == (_SCALE_SHIFT_SWAPPED,) and not name.startswith("norm_out"):
        parts = (layer.up.roll(len(layer.up) // 2, dims=0),)
    layers = {
        target: LowRankLayer(layer.down.clone(), part.clone())  # safetensors refuses shared memory
        for target, part in zip(targets, parts, strict=True)
    }
    for target, part in layers.items():
        check_shape(target, part, transformer.get_submodule(target))
    return layers


def check_shape(name: str, layer: LowRankLayer, module: Any) -> None:  # noqa: ANN401 - quantized layers differ in type
    """Checks that the LoRA fits a linear layer. Raises ModelError if the module is not a linear layer, or has another shape."""
    expected = (module.out_features, module.in_features) if hasattr(module, "out_features") else None
    up, down = tuple(layer.up.shape), tuple(layer.down.shape)
    if expected is None or up != (expected[0], layer.rank) or down != (layer.rank, expected[1]):
        raise ModelError(
            f"the LoRA of {name} has matrices of {up} and {down}",
            f"expected a layer with {' x '.join(map(str, expected))} weights"
            if expected
            else "expected a linear layer",
            "use the base with which it was trained",
        )


def _repeated(layer: str) -> ModelError:
    cure = "use a file with one LoRA, in one style of keys"
    return ModelError(
        f"the file has more than one LoRA for the layer {layer}", "expected each layer once", cure
    )


def _unknown(key: str, tensors: Mapping[str, Tensor], backbone: str) -> ModelError:
    for pattern, kind in _UNSUPPORTED.items():
        if found := next((name for name in tensors if re.search(pattern, name)), ""):
            return ModelError(
                f"the file has {kind} ({found})",
                "expected only LoRA matrices of the transformer, with the keys of peft, diffusers, sd-scripts or ComfyUI",
                "use another file of this LoRA, or another LoRA",
            )
    return ModelError(
        f"the key {key} of the LoRA, in the style of {lora_format(tensors)}, belongs to no layer of {backbone}",
        f"expected two matrices for each of some linear layers of {backbone}",
        "choose the base with which it was trained",
    )


def scaling_from_config(settings: Mapping[str, Any], prefix: str = "") -> ScalingFunction:
    """alpha / rank from the settings of peft: `lora_alpha`, `alpha_pattern` and `use_rslora` (Kalajdzievski 2023).
    `prefix` is that of the keys in the settings, such as "transformer." in the metadata that diffusers writes."""
    values = {key.removeprefix(prefix): value for key, value in settings.items()}
    patterns = {
        key.removeprefix(prefix): float(alpha) for key, alpha in (values.get("alpha_pattern") or {}).items()
    }

    def scale(name: str, rank: int) -> float:
        found = (alpha for key, alpha in patterns.items() if re.match(rf"(.*\.)?({key})$", name))
        alpha = next(found, float(values.get("lora_alpha", rank)))
        return alpha / (math.sqrt(rank) if values.get("use_rslora") else rank)

    return scale
