"""What a prediction costs: parameters, operations and activations of a backbone, and a table of graphics cards.

Parameters and operations are counted on a backbone on the device "meta" (`build_on_meta`), which has no storage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Final, final

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from brewster.errors import DeviceError
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.memory import GIB
from brewster.models.diffusion.prompt import PromptEmbedding

PROMPT_TOKENS: Final = 512
EFFICIENCY: Final = 0.4
"""Assumed speed of a transformer divided by the peak speed of the GPU."""
_HIDDEN_STATES_PER_BLOCK: Final = 36
"""Activations of one block while it computes, in hidden states."""


@final
@dataclass(frozen=True)
class GraphicsCard:
    """A GPU: memory in GiB, and peak dense bf16 speed in TFLOP/s from its data sheet."""

    name: str
    memory_gib: float
    tflops: float


CARDS: Final = {
    card.name: card
    for card in (
        GraphicsCard("RTX 4060", 8, 30), GraphicsCard("RTX 3060", 12, 25), GraphicsCard("RTX 4070", 12, 58),
        GraphicsCard("RTX 4060 Ti 16 GB", 16, 44), GraphicsCard("RTX 4080", 16, 97),
        GraphicsCard("RTX 3090", 24, 71), GraphicsCard("RTX 4090", 24, 165), GraphicsCard("RTX 5090", 32, 210), GraphicsCard("L40S", 48, 362),
        GraphicsCard("A100", 80, 312), GraphicsCard("H100", 80, 989), GraphicsCard("H200", 141, 989),
    )
}  # fmt: skip
"""Name -> GPU. The paper uses the RTX 4090."""


def find_gpu(name: str | None = None) -> GraphicsCard:
    """Returns the GPU of this name; without a name, the local GPU, or the RTX 4090 if there is none.

    Raises:
        DeviceError: the name is not in `CARDS`.
    """
    if name is None:
        return _local_gpu() if torch.cuda.is_available() else CARDS["RTX 4090"]
    known = {other.lower(): card for other, card in CARDS.items()}
    if name.lower() in known:
        return known[name.lower()]
    matches = get_close_matches(name.lower(), known, n=1)
    raise DeviceError(
        f"there is no GPU {name!r} in the table",
        f"expected one of {', '.join(CARDS)}",
        f"did you mean {known[matches[0]].name}?" if matches else "choose the most similar GPU",
    )


def check_gpu_memory(name: str, needed_gib: float, card: GraphicsCard, cure: str) -> None:
    """Checks that an estimate for the model `name` fits into the memory of a GPU; `cure` says what to do if it does not.

    Raises:
        DeviceError: it does not fit.
    """
    if needed_gib > card.memory_gib:
        raise DeviceError(
            f"{name} needs about {needed_gib:.1f} GiB",
            f"expected at most the {card.memory_gib:g} GiB of {card.name}",
            cure,
        )


def cost_table(
    model: Mapping[str, str],
    time: Mapping[str, str],
    *,
    memory_gib: Mapping[str, float],
    card: GraphicsCard,
    host_memory: str,
    download_gb: float,
    text_encoder_gb: float,
) -> str:
    """Returns an estimate as lines of name and value: the rows of the model, memory, host memory and download, and the rows of the time.

    Args:
        model: rows about the model.
        time: rows about the operations and the time.
        memory_gib: the GPU memory of each part. Their sum is a row of its own.
        card: the GPU.
        host_memory: the host memory, in GiB, with a remark if necessary.
        download_gb: the size of all downloads.
        text_encoder_gb: the size of the text encoders in it.
    """
    total = sum(memory_gib.values())
    rows = {
        **model,
        **{f"memory, {name}": f"{gib:.1f} GiB" for name, gib in memory_gib.items()},
        "memory": f"{total:.1f} GiB of {card.memory_gib:g} on {card.name} (estimate)",
        "host memory": f"{host_memory} (estimate)",
        "download": f"{download_gb:.0f} GB, of which {text_encoder_gb:.0f} GB are text encoders (estimate)",
        **time,
    }
    return "\n".join(f"{name:24}{value}" for name, value in rows.items())


def is_local_gpu(card: GraphicsCard) -> bool:
    """Whether this is the GPU of this machine."""
    return torch.cuda.is_available() and card == _local_gpu()


def _local_gpu() -> GraphicsCard:
    """Returns the local GPU. Its speed is that of the GPU in `CARDS` with its name, or of the RTX 4090 if there is none."""
    found = torch.cuda.get_device_properties(0)
    speed = next(
        (card.tflops for name, card in CARDS.items() if name in found.name), CARDS["RTX 4090"].tflops
    )
    return GraphicsCard(found.name, found.total_memory / GIB, speed)


def count_parameters(module: nn.Module) -> int:
    """The number of parameters of a module."""
    return sum(parameter.numel() for parameter in module.parameters())


def count_blocks(backbone: Backbone) -> int:
    """The number of transformer blocks."""
    transformer = backbone.transformer
    return len(transformer.transformer_blocks) + len(getattr(transformer, "single_transformer_blocks", ()))


def hidden_state_bytes(backbone: Backbone, tokens: int) -> int:
    """The memory in bytes of one hidden state of this number of tokens, in bf16."""
    config = backbone.transformer.config
    return 2 * tokens * int(config.num_attention_heads * config.attention_head_dim)


def block_bytes(backbone: Backbone, tokens: int) -> int:
    """The memory in bytes of the activations of one block while it computes, in bf16."""
    return _HIDDEN_STATES_PER_BLOCK * hidden_state_bytes(backbone, tokens)


def forward_tflop(backbone: Backbone, generated_tokens: int, condition_tokens: int) -> float:
    """Returns the TFLOP of one prediction. They are counted on the device "meta", which computes nothing."""
    prompt = backbone.random_prompt(backbone.transformer, 0)
    prompt_tensors = {
        name: (tensor[:, :1].expand(1, PROMPT_TOKENS, -1) if tensor.ndim == 3 else tensor).to("meta")
        for name, tensor in prompt.tensors.items()
    }
    latents, condition = (
        torch.empty(1, backbone.channels, 1, count, device="meta")
        for count in (generated_tokens, condition_tokens)
    )
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        embedding = PromptEmbedding(prompt.backbone, prompt.text, **prompt_tensors)
        backbone.predict(latents, condition, torch.empty(1, device="meta"), embedding, 1.0)
    return float(counter.get_total_flops()) / 1e12
