"""The table of diffusion models with a name: their repositories on the hub, licences and needs. It
needs no torch.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from brewster.options import Quantization

TINY_PREFIX: Final = "tiny:"
"""The prefix for the tiny version of a backbone: the same classes with few, random weights, for
tests and demos.
"""
_BASE: Final = "a base for LoRAs; without one, an edit by prompt"
_OPEN: Final = "no account needed"
_GATED: Final = "gated: accept the licence on its page, then run `hf auth login`"


@final
@dataclass(frozen=True)
class DiffusionModel:
    """A row of the table."""

    name: str
    hub_id: str
    licence: str
    allows_commercial_use: bool
    backbone: str
    """The key in `BACKBONE_COSTS`, from which memory and download are computed."""
    output: str
    access: str = _OPEN
    quantization: Quantization | None = None
    """The quantization of the base in the published inference code."""
    has_prompt: bool = False
    """Whether the encoded prompt is part of the model, so that no text encoder is needed."""
    base_model: str | None = None
    """The hub id of the base of a LoRA or finetuned model."""


DIFFUSION_MODELS: Final = {
    model.name: model
    for model in (
        DiffusionModel(
            "windowseat",
            "huawei-bayerlab/windowseat-reflection-removal-v1-0",
            "Apache-2.0",
            allows_commercial_use=True,
            backbone="qwen",
            output="transmission; reflection derived",
            quantization="nf4",
            has_prompt=True,
            base_model="Qwen/Qwen-Image-Edit-2509",
        ),
        DiffusionModel(
            "kontext",
            "black-forest-labs/FLUX.1-Kontext-dev",
            "FLUX.1 [dev] Non-Commercial License",
            allows_commercial_use=False,
            backbone="kontext",
            output=_BASE,
            access=_GATED,
        ),
        DiffusionModel(
            "klein",
            "black-forest-labs/FLUX.2-klein-base-4B",
            "Apache-2.0",
            allows_commercial_use=True,
            backbone="klein",
            output=_BASE,
        ),
        DiffusionModel(
            "qwen",
            "Qwen/Qwen-Image-Edit",
            "Apache-2.0",
            allows_commercial_use=True,
            backbone="qwen",
            output=_BASE,
        ),
    )
}
"""name -> model."""


def licence_of(hub_id: str) -> str:
    """The licence of a repository on the hub, for a message before its download."""
    models = DIFFUSION_MODELS.values()
    owners = [model for model in models if model.hub_id == hub_id] or [
        model for model in models if model.base_model == hub_id
    ]
    return owners[0].licence if owners else "see its page on the hub"


def name_of(source: str) -> str:
    """Returns the short name of a diffusion model for reports: its last part, without a colon."""
    return Path(source).resolve().name.replace(":", "-")
