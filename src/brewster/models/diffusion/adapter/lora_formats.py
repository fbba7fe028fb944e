"""Reads LoRAs of other programs: the key styles of peft, diffusers, kohya's sd-scripts and ComfyUI.

Any rank and any selection of layers are accepted. The scale alpha / rank of a layer is multiplied into its B matrix, so
the change of a layer's weight is B @ A. Keys that are not understood are an error, never ignored."""

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
"""A layer, then `lora_A`, `lora_B` (peft) or `lora_down`, `lora_up` (kohya), the name of the adapter, or `alpha`."""
DOWN_SUFFIX: Final = ".lora_A.weight"
UP_SUFFIX: Final = ".lora_B.weight"
"""The suffixes of the keys of a layer's two matrices in a state dict of brewster, peft and diffusers."""
_SUFFIXES: Final = {
    "lora_A": DOWN_SUFFIX, "lora_down": DOWN_SUFFIX, "lora_B": UP_SUFFIX, "lora_up": UP_SUFFIX, None: "alpha",
}  # fmt: skip

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
"""Backbone -> prefix -> layer in the original code of the model -> its layers in diffusers. If an original layer has
several layers in diffusers, its rows are their rows, one layer after the other. Qwen has the same names in both."""
_BLOCKS: Final = {"double_blocks.{}.": "transformer_blocks", "single_blocks.{}.": "single_transformer_blocks"}
_SCALE_SHIFT_SWAPPED: Final = "norm_out.linear"
"""The layer whose two halves, scale and shift, have the opposite order in the original code."""

ScalingFunction = Callable[[str, int], float]
"""The factor alpha / rank for a layer, by its name in the file, and its rank."""


def read_lora_layers(
    tensors: Mapping[str, Tensor], transformer: nn.Module, backbone: str, scale: ScalingFunction | None = None
) -> dict[str, Tensor]:
    """The two matrices of each layer with the keys of `lora_state_dict`, float32, with the scale multiplied into B. The
    transformer may be on the device "meta". `scale` is for files without alphas; by default 1, as in other programs."""
    targets = _layer_names(transformer, backbone)
    state: dict[str, Tensor] = {}
    for name, parts in _parse(tensors, backbone).items():
        if parts.keys() == {"alpha"}:
            raise _unknown(f"{name}.alpha", tensors, backbone)
        if name not in targets:
            raise _unknown(name, tensors, backbone)
        if not parts.keys() >= {DOWN_SUFFIX, UP_SUFFIX}:
            raise ModelError(
                f"the LoRA has only one of two matrices for {name}", "expected both", "copy the file again"
            )
        down, up = parts[DOWN_SUFFIX].float(), parts[UP_SUFFIX].float()
        rank = len(down)
        up = up * (float(parts["alpha"]) / rank if "alpha" in parts else scale(name, rank) if scale else 1.0)
        # A layer of the original code may be several in diffusers, which have equal matrices `down`.
        modules = {target: transformer.get_submodule(target) for target in targets[name]}
        sizes = [int(module.out_features) for module in modules.values()]  # type: ignore[arg-type]
        if sum(sizes) != len(up):
            happened = f"the LoRA of {name} has {len(up)} rows"
            raise ModelError(happened, f"expected {sum(sizes)}", "use the base with which it was trained")
        if targets[name] == (_SCALE_SHIFT_SWAPPED,) and not name.startswith("norm_out"):
            up = up.roll(len(up) // 2, dims=0)
        split = up.split(sizes)  # type: ignore[no-untyped-call]
        for (target, module), rows in zip(modules.items(), split, strict=True):
            if target + DOWN_SUFFIX in state:
                raise _repeated(target)
            check_shape(target, down, rows, module)
            # safetensors refuses tensors that share memory.
            state |= {target + DOWN_SUFFIX: down.clone(), target + UP_SUFFIX: rows.clone()}
    return dict(sorted(state.items()))


def adapted_layers(state: Mapping[str, Tensor]) -> list[str]:
    """Returns the names of the layers whose weights are in `state`, which has the keys of `lora_state_dict`, sorted."""
    return sorted(key.removesuffix(UP_SUFFIX) for key in state if key.endswith(UP_SUFFIX))


def lora_format(tensors: Mapping[str, Tensor]) -> str:
    """The program whose key style a LoRA file has: peft, diffusers, kohya, ComfyUI, or unknown."""
    styles = {style for key in tensors for prefix, style in _PREFIXES.items() if key.startswith(prefix)}
    if not styles:
        is_plain = any(match and match["matrix"] for match in map(_KEY.fullmatch, tensors))
        return "peft" if is_plain else "unknown"
    return " and ".join(sorted(styles))


def _parse(tensors: Mapping[str, Tensor], backbone: str) -> dict[str, dict[str, Tensor]]:
    """The parts of each layer, by its name in the file without prefix: matrices by suffix, and perhaps "alpha"."""
    layers: dict[str, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if not (match := _KEY.fullmatch(key)):
            raise _unknown(key, tensors, backbone)
        name, part = _PREFIX.sub("", match["layer"]), _SUFFIXES[match["matrix"]]
        if part in layers.setdefault(name, {}):
            raise _repeated(name)
        layers[name][part] = tensor
    if not layers:
        happened = "the file contains no LoRA"
        raise ModelError(happened, "expected matrices lora_A and lora_B for each layer", "check the file")
    return layers


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


def check_shape(name: str, down: Tensor, up: Tensor, module: Any) -> None:  # noqa: ANN401
    """Checks that the LoRA fits the module, which must be a linear layer of this shape."""
    expected = (module.out_features, module.in_features) if hasattr(module, "out_features") else None
    if expected is None or (*up.shape, *down.shape) != (expected[0], len(down), len(down), expected[1]):
        raise ModelError(
            f"the LoRA of {name} has matrices of {tuple(up.shape)} and {tuple(down.shape)}",
            f"expected a layer with {' x '.join(map(str, expected))} weights"
            if expected
            else "expected a linear layer",
            "use the base with which it was trained",
        )


def _repeated(layer: str) -> ModelError:
    cure = "use a file with one LoRA, in one style of keys"
    return ModelError(f"the file has more than one LoRA for the layer {layer}", "expected each layer once", cure)


def _unknown(key: str, tensors: Mapping[str, Tensor], backbone: str) -> ModelError:
    return ModelError(
        f"the key {key} of the LoRA, in the style of {lora_format(tensors)}, belongs to no layer of {backbone}",
        f"expected only two LoRA matrices for each of some linear layers of {backbone}",
        "choose the base with which it was trained, or another file of this LoRA, without DoRA, LoKr or biases",
    )


def scaling_from_config(settings: Mapping[str, Any], prefix: str = "") -> ScalingFunction:
    """alpha / rank from the settings of peft: `lora_alpha`, `alpha_pattern` and `use_rslora` (Kalajdzievski 2023).
    `prefix` is that of the keys in the settings, such as "transformer." in the metadata that diffusers writes."""
    values = {key.removeprefix(prefix): value for key, value in settings.items()}
    patterns = {key.removeprefix(prefix): float(alpha) for key, alpha in (values.get("alpha_pattern") or {}).items()}

    def scale(name: str, rank: int) -> float:
        found = (alpha for key, alpha in patterns.items() if re.match(rf"(.*\.)?({key})$", name))
        alpha = next(found, float(values.get("lora_alpha", rank)))
        return alpha / (math.sqrt(rank) if values.get("use_rslora") else rank)

    return scale
