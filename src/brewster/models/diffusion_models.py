"""The table of diffusion models, which `brewster models list` prints. This module needs no torch and no download."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

from brewster.errors import ModelError

_OPEN: Final = "no account needed"
_GATED: Final = "gated: accept the licence on its page, then run `hf auth login`"


@final
@dataclass(frozen=True)
class DiffusionModel:
    """A row of the table. Sizes are computed from the numbers of parameters, not measured."""

    name: str
    hub_id: str
    licence: str
    allows_commercial_use: bool
    download_gb: float
    """The transformer and the VAE in bfloat16, in GB; for a LoRA those of its base."""
    memory_gib: float
    """GPU memory for separation, in GiB, with the weights in `weight_format`: `Placement.gpu_gib`, rounded up."""
    weight_format: str
    output: str
    access: str = _OPEN
    text_encoder_gb: float = 0
    """The download of the text encoders, which encode a prompt once. 0 if the prompt is part of the model."""
    base_model: str | None = None
    """The hub id of the base of a LoRA or finetuned model."""
    offloaded_memory_gib: float = 4.5
    """GPU memory for separation, in GiB, with the weights offloaded to host memory."""
    is_opened_by_name: bool = True
    """Whether --model takes the name. Otherwise `brewster models import` converts the model first."""


DIFFUSION_MODELS: Final = {
    model.name: model
    for model in (
        DiffusionModel(
            "windowseat", "huawei-bayerlab/windowseat-reflection-removal-v1-0", "Apache-2.0", allows_commercial_use=True,
            download_gb=41, memory_gib=13, weight_format="nf4", output="transmission; reflection derived",
            base_model="Qwen/Qwen-Image-Edit-2509",
        ),
        DiffusionModel(
            "gensirr", "lime-j/GenSIRR", "none stated; its base: FLUX.1 [dev] Non-Commercial License",
            allows_commercial_use=False, download_gb=24, memory_gib=15, weight_format="int8",
            output="transmission; reflection derived",
            access="run `hf download lime-j/GenSIRR GenSIRR.pt --local-dir .`, then `brewster models import GenSIRR.pt FOLDER`",
            base_model="black-forest-labs/FLUX.1-Kontext-dev", is_opened_by_name=False,
        ),
        DiffusionModel(
            "kontext", "black-forest-labs/FLUX.1-Kontext-dev", "FLUX.1 [dev] Non-Commercial License",
            allows_commercial_use=False, download_gb=24, memory_gib=15, weight_format="int8",
            output="a base for LoRAs; without one, an edit by prompt", access=_GATED, text_encoder_gb=9.8,
        ),
        DiffusionModel(
            "klein", "black-forest-labs/FLUX.2-klein-base-4B", "Apache-2.0", allows_commercial_use=True,
            download_gb=7.9, memory_gib=11, weight_format="bf16",
            output="a base for LoRAs; without one, an edit by prompt", text_encoder_gb=8,
        ),
        DiffusionModel(
            "qwen", "Qwen/Qwen-Image-Edit", "Apache-2.0", allows_commercial_use=True,
            download_gb=41, memory_gib=13, weight_format="nf4",
            output="a base for LoRAs; without one, an edit by prompt", text_encoder_gb=16.6,
        ),
    )
}  # fmt: skip
"""name -> model."""


def check_is_converted(model: str) -> None:
    """Checks that this is not the name or hub id of a published model that must be converted first.

    Raises:
        ModelError: it is. The message says how to get and convert the model.
    """
    for row in DIFFUSION_MODELS.values():
        if model in (row.name, row.hub_id) and not row.is_opened_by_name:
            raise ModelError(
                f"{model} is a checkpoint of another program, which --model does not open",
                "expected the folder that `brewster models import` writes",
                row.access,
            )


def licence_of(hub_id: str) -> str:
    """The licence of a repository on the hub, for a message before its download."""
    licences = {model.hub_id: model.licence for model in DIFFUSION_MODELS.values()}
    licences |= {
        model.base_model: model.licence
        for model in DIFFUSION_MODELS.values()
        if model.base_model and model.base_model not in licences
    }
    return licences.get(hub_id, "see its page on the hub")
