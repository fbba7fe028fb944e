"""What a large recipe will cost, before anything is downloaded: tokens, memory by part, and time, as estimates.

estimate = estimate_resources(recipe, CARDS["RTX 4090"])
print(estimate.table())
estimate.check_fits()

Parameters and operations are counted on a backbone without memory (torch's device "meta"); memory is arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from typing import Final, final

import torch
from torch.utils.flop_counter import FlopCounterMode

from brewster.errors import DeviceError
from brewster.models.diffusion.backbones import build, find_family
from brewster.models.diffusion.families.family import Backbone
from brewster.models.diffusion.panels import fit_panel
from brewster.models.diffusion.prompt import PromptEmbedding
from brewster.models.zoo import TINY
from brewster.training.recipe import LoraRecipe

_GIB: Final = 1 << 30
_SQUARE_PHOTO_PX: Final = (4096, 4096)
"""A large square photo, whose panels fill the budget best."""
_PROMPT_TOKENS: Final = 512
_BYTES_PER_WEIGHT: Final = {None: 2.0, "int8": 1.01, "float8": 1.01, "nf4": 0.52}
"""A weight, with its share of the scales: 22.2, 11.2 and 5.8 GiB were counted for FLUX.1 Kontext."""
_BYTES_PER_LORA_WEIGHT: Final = 16
"""A weight of the LoRA, its gradient and two moments, all float32; 8-bit moments take 10."""
_HIDDEN_STATES_PER_BLOCK: Final = 36
"""What a block keeps while it is computed again, in hidden states; one more for every block is kept throughout."""
_OVERHEAD_GIB: Final = 1.5
"""CUDA itself, and the VAE at work."""
_FORWARD_PASSES_PER_STEP: Final = 3
"""A step in forward passes: forward, once more for the checkpoints, and back, as the base has no gradients."""
_EFFICIENCY: Final = 0.4
"""Of a card's greatest speed."""


@final
@dataclass(frozen=True)
class GraphicsCard:
    """A graphics card: memory in GiB, and its dense bf16 speed in TFLOP a second as its maker states it."""

    name: str
    memory_gib: float
    tflops: float


CARDS: Final = {
    card.name: card
    for card in (
        GraphicsCard("RTX 3090", 24, 71), GraphicsCard("RTX 4090", 24, 165), GraphicsCard("RTX 5090", 32, 210), GraphicsCard("L40S", 48, 362),
        GraphicsCard("A100", 80, 312), GraphicsCard("H100", 80, 989), GraphicsCard("H200", 141, 989),
    )
}  # fmt: skip
"""name -> card. The paper's is the RTX 4090."""


@final
@dataclass(frozen=True)
class ResourceEstimate:
    """The estimates for a recipe on a card."""

    recipe: LoraRecipe
    card: GraphicsCard
    panel: tuple[int, int]
    generated_tokens: int
    condition_tokens: int
    parameters: int
    lora_parameters: int
    memory_gib: dict[str, float]
    tflop: float

    @property
    def total_gib(self) -> float:
        """All parts of the memory."""
        return sum(self.memory_gib.values())

    @property
    def seconds(self) -> float:
        """A step on the card."""
        return self.tflop / (_EFFICIENCY * self.card.tflops)

    def table(self) -> str:
        """The estimate in lines of name and value; all memory and time are estimates."""
        recipe, (width, height) = self.recipe, self.panel
        rows = {
            "backbone": f"{recipe.backbone}, {self.parameters / 1e9:.2f} billion parameters",
            "LoRA": f"rank {recipe.rank}, {self.lora_parameters / 1e6:.1f} million parameters",
            "panels": f"{' '.join(recipe.panels)}, {width} x {height} each, for a square photo",
            "tokens": f"{self.generated_tokens} generated, {self.condition_tokens} shown, {_PROMPT_TOKENS} of text",
            **{f"memory, {name}": f"{gib:.1f} GiB" for name, gib in self.memory_gib.items()},
            "memory": f"{self.total_gib:.1f} GiB of {self.card.memory_gib:g} on {self.card.name}, as an estimate",
            "a step": f"{self.tflop:.0f} TFLOP, {self.seconds:.1f} s, as an estimate",
            "in all": f"{recipe.steps} steps, {self.seconds * recipe.steps / 3600:.1f} hours, as an estimate",
        }
        return "\n".join(f"{name:24}{value}" for name, value in rows.items())

    def check_fits(self) -> None:
        """Lets pass what fits into the card.

        Raises:
            DeviceError: it does not (says what would).
        """
        if self.total_gib <= self.card.memory_gib:
            return
        raise DeviceError(
            f"{self.recipe.backbone} needs about {self.total_gib:.1f} GiB",
            f"at most the {self.card.memory_gib:g} GiB of {self.card.name}",
            self._cure(),
        )

    def _cure(self) -> str:
        for quantise in ("int8", "nf4"):
            weights = self.parameters * _BYTES_PER_WEIGHT[quantise] / _GIB
            spared = self.memory_gib["base"] - weights
            if spared > 0 and self.total_gib - spared <= self.card.memory_gib:
                return f'set quantise = "{quantise}", which takes {self.total_gib - spared:.1f} GiB'
        return "lower budget_px or rank, take a smaller backbone (klein) or a larger card"


def find_card(name: str | None = None) -> GraphicsCard:
    """The card of this name, or the one that is here; without either, the paper's.

    Raises:
        DeviceError: nobody knows a card of this name.
    """
    if name is None:
        return _local_gpu() if torch.cuda.is_available() else CARDS["RTX 4090"]
    known = {other.lower(): card for other, card in CARDS.items()}
    if name.lower() in known:
        return known[name.lower()]
    close = get_close_matches(name.lower(), known, n=1)
    raise DeviceError(
        f"there is no card {name!r} in the table",
        f"one of {', '.join(CARDS)}",
        f"did you mean {known[close[0]].name}?" if close else "choose one like yours",
    )


def is_local_gpu(card: GraphicsCard) -> bool:
    """Whether this is the card of this machine."""
    return torch.cuda.is_available() and card == _local_gpu()


def estimate_resources(recipe: LoraRecipe, card: GraphicsCard) -> ResourceEstimate:
    """Counts what the recipe takes; some seconds.

    Raises:
        ModelError: the backbone is not named as in the table.
        MissingExtra: diffusers is not installed.
    """
    backbone = _meta_backbone(recipe)
    fit = fit_panel(_SQUARE_PHOTO_PX, recipe.layout, budget_px=recipe.budget_px, multiple=backbone.multiple)
    tokens_per_panel = (fit.panel[0] // backbone.multiple) * (fit.panel[1] // backbone.multiple)
    generated_tokens = tokens_per_panel * len(recipe.panels)
    condition_tokens = generated_tokens if "I" in recipe.panels else tokens_per_panel
    parameters, vae, lora_parameters = (
        _count_parameters(backbone),
        sum(each.numel() for each in backbone.vae.parameters()),
        _count_lora_parameters(backbone, recipe),
    )
    memory = {
        "base": parameters * _BYTES_PER_WEIGHT[recipe.quantise] / _GIB,
        "VAE": 2 * vae / _GIB,
        "LoRA and AdamW": lora_parameters * _BYTES_PER_LORA_WEIGHT / _GIB,
        "activations": _activation_bytes(backbone, generated_tokens + condition_tokens + _PROMPT_TOKENS)
        / _GIB,
        "rest": _OVERHEAD_GIB,
    }
    tflop = (
        _FORWARD_PASSES_PER_STEP * recipe.batch * _forward_tflop(backbone, generated_tokens, condition_tokens)
    )
    return ResourceEstimate(
        recipe,
        card,
        fit.panel,
        generated_tokens,
        condition_tokens,
        parameters,
        lora_parameters,
        memory,
        tflop,
    )


def _local_gpu() -> GraphicsCard:
    """The card that is here, at the speed of a known one of its name; else of the paper's."""
    found = torch.cuda.get_device_properties(0)
    speed = next(
        (card.tflops for name, card in CARDS.items() if name in found.name), CARDS["RTX 4090"].tflops
    )
    return GraphicsCard(found.name, found.total_memory / _GIB, speed)


def _meta_backbone(recipe: LoraRecipe) -> Backbone:
    name = recipe.backbone.removeprefix(TINY)
    family = find_family(name)
    size = family.tiny if recipe.backbone.startswith(TINY) else family.real
    return build(name, size, device="meta", dtype=torch.bfloat16)


def _count_parameters(backbone: Backbone) -> int:
    return sum(parameter.numel() for parameter in backbone.transformer.parameters())


def _count_lora_parameters(backbone: Backbone, recipe: LoraRecipe) -> int:
    layers = map(backbone.transformer.get_submodule, backbone.lora_targets())
    return sum(recipe.rank * (layer.in_features + layer.out_features) for layer in layers)


def _activation_bytes(backbone: Backbone, tokens: int) -> int:
    """Bytes: every block's input, and one whole block, in bf16."""
    transformer, config = backbone.transformer, backbone.transformer.config
    blocks = len(transformer.transformer_blocks) + len(getattr(transformer, "single_transformer_blocks", ()))
    hidden: int = config.num_attention_heads * config.attention_head_dim
    return 2 * tokens * hidden * (blocks + _HIDDEN_STATES_PER_BLOCK)


def _forward_tflop(backbone: Backbone, generated_tokens: int, condition_tokens: int) -> float:
    """TFLOP of one prediction, counted by torch without computing anything."""
    prompt = backbone.random_prompt(backbone.transformer, 0)
    words = {
        name: (tensor[:, :1].expand(1, _PROMPT_TOKENS, -1) if tensor.ndim == 3 else tensor).to("meta")
        for name, tensor in prompt.tensors.items()
    }
    latents, condition = (
        torch.empty(1, backbone.channels, 1, count, device="meta")
        for count in (generated_tokens, condition_tokens)
    )
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        embedding = PromptEmbedding(prompt.backbone, prompt.text, **words)
        backbone.predict(latents, condition, torch.empty(1, device="meta"), embedding, 1.0)
    return float(counter.get_total_flops()) / 1e12
