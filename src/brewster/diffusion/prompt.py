"""The paper's prompt and its embedding. Stored with the LoRA, so inference needs no text encoder.

"We embed the prompt into the model as a feature specific to the task" (paper, Text-to-image Model
Fine-tuning). Therefore training and inference do not load the text encoders (4.9 billion parameters
for kontext).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from brewster.diffusion.tensors import read_tensors, write_tensors
from brewster.errors import ModelError

if TYPE_CHECKING:
    import torch
    from jaxtyping import Float
    from torch import Tensor

PROMPT: Final = (
    "This set of three images showcases an image decomposition task; "
    "[IMAGE1] captures an image looking through a transparent glass, both the scene behind the "
    "glass and the"
    " reflection of the glass could be seen; "
    "[IMAGE2] displays the transmission of glass with reflection removed; "
    "[IMAGE3] shows only the reflection of glass without transmission; "
    "[IMAGE1] could be decomposed to [IMAGE2] and [IMAGE3]."
)
"""The paper's prompt, word for word (Experimental Setup, box PROMPT); its paragraphs are joined by
spaces.
"""

PROMPTS: Final[dict[str, str]] = {
    "paper": PROMPT,
    "none": "",
    "generic": "Remove the reflection.",
    "detailed": (
        "This photograph was taken through a pane of glass. Remove everything that is mirrored "
        "in the glass: lamps,"
        " windows, people and bright haze in front of it. Show only the scene behind the glass, "
        "as if the pane were"
        " not there, with the same framing, sharpness, colours and brightness, and change "
        "nothing else."
    ),
}
"""Prompts by name. "none", "generic" and "detailed" are for a backbone without a LoRA (paper,
Comparing to original Flux model). The paper shows results of such prompts without their texts, so
brewster defines these texts.
"""

PROMPT_FILE: Final = "prompt.safetensors"
_FORMAT: Final = "brewster prompt 1"


@final
@dataclass(frozen=True, eq=False)
class PromptEmbedding:
    """The embedding of a prompt by the text encoders of one backbone.

    `embeds` is (1, tokens, width). `pooled`, (1, width), is for backbones that take a pooled vector
    as well. `negative`, (1, tokens, width), is the embedding of the empty prompt, which
    classifier-free guidance needs.
    """

    backbone: str
    text: str
    embeds: Float[Tensor, "1 l d"]
    pooled: Float[Tensor, "1 p"] | None = None
    negative: Float[Tensor, "1 m d"] | None = None

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, without those that are None."""
        named = {"embeds": self.embeds, "negative": self.negative, "pooled": self.pooled}
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    @property
    def sha256(self) -> str:
        """SHA-256 of backbone, text and tensors; independent of file and device."""
        import torch  # noqa: PLC0415 - recipes are read without torch

        digest = hashlib.sha256(f"{self.backbone}\0{self.text}".encode())
        for name, tensor in sorted(self.tensors.items()):
            digest.update(f"\0{name} {tensor.dtype} {tuple(tensor.shape)}\0".encode())
            digest.update(tensor.detach().cpu().contiguous().view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()

    def to(self, device: torch.device | str, dtype: torch.dtype) -> PromptEmbedding:
        """Copies the embedding to this device and dtype."""
        moved = {name: tensor.to(device, dtype) for name, tensor in self.tensors.items()}
        return PromptEmbedding(self.backbone, self.text, **moved)

    def save(self, path: Path) -> None:
        """Writes a safetensors file. The same embedding always gives the same bytes."""
        metadata = {
            "kind": _FORMAT,
            "backbone": self.backbone,
            "text": self.text,
            "sha256": self.sha256,
        }
        write_tensors(path, self.tensors, metadata)


def load_prompt(path: Path, backbone: str) -> PromptEmbedding:
    """Reads a file that `PromptEmbedding.save` wrote."""
    tensors, metadata = read_tensors(path)
    known = {"embeds", "pooled", "negative"}
    is_prompt = metadata.get("kind") == _FORMAT and {"embeds"} <= set(tensors) <= known
    found = metadata.get("backbone") if is_prompt else "nothing"
    if found != backbone:
        raise ModelError(
            f"{path} was encoded for {found}",
            f"expected a prompt for {backbone}, in a file of kind {_FORMAT!r}",
            f"encode it with {backbone}'s text encoder",
        )
    prompt = PromptEmbedding(backbone, metadata.get("text", ""), **tensors)
    if prompt.sha256 != metadata.get("sha256"):
        happened = f"{path} does not have the digest in its metadata"
        raise ModelError(happened, f"expected {metadata.get('sha256')}", "copy it again")
    return prompt
