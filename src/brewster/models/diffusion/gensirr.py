"""Converts the checkpoint of GenSIRR (Li et al. 2026, "Rectifying Latent Space for Generative Single-Image Reflection
Removal") to a folder in diffusers' layout with its prompt and task.

    convert(Path("GenSIRR.pt"), Path("gensirr"))        # then: brewster window.jpg --model gensirr

GenSIRR is FLUX.1 Kontext with other weights of transformer and VAE, and a stored prompt embedding. For its task, see
`gensirr_task`.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from brewster.errors import ModelError
from brewster.models.diffusion.backbones.kontext import Kontext
from brewster.models.diffusion.backbones.registry import build_on_meta
from brewster.models.diffusion.prompt import PROMPT_FILE, PromptEmbedding
from brewster.models.diffusion.task import TASK_FILE, gensirr_task, save_task
from brewster.models.diffusion.tensors import check_new
from brewster.models.zoo import TINY_PREFIX

_PREFIX: Final = "net_g."
_PROMPT_TEXT: Final = "GenSIRR's stored embedding"
_IGNORED: Final = ("text_encoder.",)
"""Weights that inference does not use."""


def convert(checkpoint: Path, folder: Path, *, base_model: str = "kontext", short_side_px: int = 768) -> None:
    """Reads the checkpoint and writes the folder. The weights keep their precision.

    `base_model` is "kontext", or "tiny:kontext" for tests. `short_side_px`, that of the input, is 768 or 512. Raises
    ModelError if the file is no such checkpoint; OutputError if the folder cannot be written.
    """
    check_new(folder)
    if base_model.removeprefix(TINY_PREFIX) != Kontext.name:
        happened = f"the base model {base_model} was given for GenSIRR"
        raise ModelError(happened, f"expected {Kontext.name}", "leave the base model out")
    state = _read_checkpoint(checkpoint)
    prompt = _prompt(checkpoint, state)
    backbone = build_on_meta(base_model)
    parts: dict[str, nn.Module] = {"transformer.": backbone.transformer, "vae.": backbone.vae}
    unknown = [key for key in state if not key.startswith((*parts, *_IGNORED))]
    if unknown:
        raise _refused(f"{checkpoint} contains {unknown[0]}", f"expected only {', '.join(parts)}")
    for prefix, part in parts.items():
        weights = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        try:
            part.load_state_dict(weights, strict=True, assign=True)
        except RuntimeError as error:
            reason = " ".join(str(error).split())[:200]
            happened = f"{checkpoint} does not match the {prefix[:-1]} of {backbone.name}: {reason}"
            raise _refused(happened, f"expected the weights of a {type(part).__name__}") from error
    backbone.save(folder)
    prompt.save(folder / PROMPT_FILE)
    save_task(gensirr_task(short_side_px), folder / TASK_FILE)


def _read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The weights by name without the prefix net_g. Only tensors are read: the file cannot run code."""
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        reason = " ".join(str(error).split())[:200]
        expected = "expected a checkpoint of GenSIRR that contains tensors only"
        raise ModelError(f"{path} cannot be read ({reason})", expected, "download it again") from error
    content = content if isinstance(content, Mapping) else {type(content).__name__: None}
    module = content.get("module")
    weights = {str(key): value for key, value in module.items()} if isinstance(module, Mapping) else {}
    if not any(key.startswith(_PREFIX) for key in weights):
        found = ", ".join(map(str, list(content)[:5]))
        expected = f'expected a checkpoint of GenSIRR: weights {_PREFIX}... under "module"'
        raise _refused(f"{path} contains {found}", expected)
    return {key.removeprefix(_PREFIX): value for key, value in weights.items() if key.startswith(_PREFIX)}


def _prompt(path: Path, state: dict[str, Tensor]) -> PromptEmbedding:
    """Removes the prompt from the state, and returns it."""
    names = ("prompt_embeds", "pooled_prompt_embeds", "text_ids")
    try:
        embeds, pooled, ids = (state.pop(f"cached_{name}") for name in names)
    except KeyError as error:
        raise _refused(f"{path} lacks {error}", "expected the stored prompt embedding") from error
    if ids.count_nonzero():
        raise _refused(f"{path} has position ids of the prompt that are not zero", "expected zeros")
    return PromptEmbedding(Kontext.name, _PROMPT_TEXT, embeds.detach().clone(), pooled.detach().clone())


def _refused(happened: str, expected: str) -> ModelError:
    return ModelError(happened, expected, "use the file GenSIRR.pt")
