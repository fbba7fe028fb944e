"""A LoRA on a large backbone as a trainer: flow matching on the latents of panels (paper, Text-to-image Model Fine-tuning).

trainer = LoraLearner(read_recipe(Path("recipes/train/kontext.toml")))
run(trainer, Path("out/kontext"), report)

A batch is learnt one sample after another, so that each keeps its aspect ratio and a batch needs no more memory than
a sample. Sample, noise and time are functions of (seed, step, slot) alone; several processes divide the slots.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.errors import RecipeError
from brewster.files import write_atomically
from brewster.models.diffusion.adapter.lora import add_lora, load_lora_state, lora_state, save_lora
from brewster.models.diffusion.backbones import encode_prompt, load_backbone
from brewster.models.diffusion.families.family import Backbone
from brewster.models.diffusion.lazy_imports import within_memory
from brewster.models.diffusion.panels import PanelFit, split
from brewster.models.diffusion.pipeline import DecompositionPipeline
from brewster.models.diffusion.prompt import PROMPTS, PromptEmbedding, load_prompt
from brewster.models.diffusion.sampling import STEPS
from brewster.training import distributed
from brewster.training.data.sample_rng import SampleRng
from brewster.training.loop import last_numbers
from brewster.training.lora.latents import (
    EncodedSample,
    LatentEncoder,
    SampleSequence,
    open_samples,
    panels_in,
    with_difference,
)
from brewster.training.lora.model_card import write_card
from brewster.training.losses import finite, gain_db
from brewster.training.recipe import ENCODED_SUFFIX, LoraRecipe
from brewster.training.streams import validation_pairs

FOLDER: Final = "lora"
RECIPE: Final = "recipe.json"
_MAX_GRADIENT_NORM: Final = 1.0
_SHOWN: Final = 4
"""How many pictures of each folder are generated to see how good it is: each takes as long as some steps."""
_ROW_PX: Final = (160, 240)
_LOWER: Final = "lower budget_px or rank, quantise the base, or take a smaller backbone (klein)"


class LoraTrainer:
    """A `Learner`: the backbone, frozen, a float32 LoRA on it, and AdamW.

    Raises:
        RecipeError, PhotoError: the data are missing, damaged or without reflections.
        DownloadError, ModelError, DeviceError, MissingExtra: the backbone cannot be loaded.
    """

    def __init__(self, recipe: LoraRecipe) -> None:
        _refuse_idle(recipe)
        self.recipe = recipe
        samples = open_samples(recipe)
        self._shown = _shown(recipe, samples)
        device = str(distributed.best_device())
        self.backbone = load_backbone(recipe.backbone, device=device, quantise=recipe.quantise)
        self._data = LatentEncoder(samples, self.backbone, recipe)
        self._parameters = add_lora(self.backbone, rank=recipe.rank, alpha=recipe.alpha, seed=recipe.seed)
        self.backbone.transformer.enable_gradient_checkpointing()
        self._optimizer = _adamw(self._parameters, recipe)
        self._prompt: PromptEmbedding | None = None

    @property
    def prompt(self) -> PromptEmbedding:
        """What the backbone is told; known once the run has begun."""
        assert self._prompt, "begin or restore comes first"
        return self._prompt

    def initialize(self) -> None:
        """Takes up the recipe's prompt; a real backbone's text encoder is loaded for it, and forgotten.

        Raises:
            DownloadError, ModelError, DeviceError, MissingExtra: it cannot be had.
        """
        self._prompt = _find_prompt(self.recipe, self.backbone)

    def state_dict(self) -> dict[str, Any]:
        """The LoRA, the optimiser's moments, and the prompt: nothing of the base."""
        prompt = {"text": self.prompt.text, **self.prompt.tensors}
        return {
            "lora": lora_state(self.backbone), "optimizer": self._optimizer.state_dict(), "prompt": prompt,
        }  # fmt: skip

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from such a state."""
        load_lora_state(self.backbone, state["lora"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._prompt = PromptEmbedding(self.backbone.name, **state["prompt"])

    def training_step(self, step: int) -> dict[str, float]:
        """One step of AdamW on one batch; the loss, and each panel's part of it.

        Raises:
            ModelError: the loss is not a number; the last checkpoint is still good.
            DeviceError: out of memory (says what to lower).
            RecipeError, PhotoError: a sample is missing, damaged, or smaller than a panel.
        """
        self._optimizer.zero_grad()
        with within_memory(_LOWER):
            parts = self._learn(step)
        distributed.all_reduce_sum(
            [parameter.grad for parameter in self._parameters if parameter.grad is not None]
        )
        distributed.all_reduce_sum(list(parts.values()))
        loss = finite(torch.stack(list(parts.values())).sum(), step)
        finite(nn.utils.clip_grad_norm_(self._parameters, _MAX_GRADIENT_NORM), step, "gradient")
        for group in self._optimizer.param_groups:
            group["lr"] = self.recipe.learning_rate * min(1.0, (step + 1) / self.recipe.warmup_steps)
        self._optimizer.step()
        return {"loss": loss.item(), **{name: part.item() for name, part in parts.items()}}

    @torch.no_grad()
    def validate(self) -> tuple[dict[str, float], Tensor]:
        """Mean PSNR gain in dB of the generated T over the photo, per folder; and rows of truths and panels."""
        gains, rows = {}, []
        for name, samples in self._shown.items():
            answers = [self._answer(layers) for layers in samples]
            gains[f"gain_db_{name}"] = sum(gain for gain, _ in answers) / len(answers)
            rows += [row for _, row in answers]
        return gains, torch.cat(rows, dim=1).clamp(0, 1).permute(1, 2, 0)

    def export(self, folder: Path) -> Path:
        """Writes a folder that stock diffusers loads: the LoRA, the prompt, the recipe, and the model card, README.md.

        Raises:
            TargetError: it cannot be written.
        """
        place = folder / FOLDER
        base, quantise = self.recipe.backbone, self.recipe.quantise
        if Path(base).is_dir():
            base = str(Path(base).resolve())
        save_lora(place, self.backbone, self.prompt, self.recipe.task, base=base, quantise=quantise)
        text = json.dumps(self.recipe.model_dump(mode="json"), indent=2)
        write_atomically(place / RECIPE, f"{text}\n".encode(), overwrite=True)
        write_card(place, self.recipe, last_numbers(folder), type(self.backbone))
        return place

    def separate(self, photo: Tensor, *, steps: int = STEPS, seed: int = 0) -> Mapping[str, Tensor]:
        """The panels that it makes of a photo in a panel, (1, 3, h, w) in [-1, 1]; one_step takes one step.

        Raises:
            DeviceError: out of memory (says what to lower).
        """
        return DecompositionPipeline(self.backbone, self.prompt, self.recipe.task)(
            photo, steps=steps, seeds=[seed]
        )

    def _learn(self, step: int) -> dict[str, Tensor]:
        """The gradients, and the parts of the loss, of this process's slots of the batch."""
        totals: dict[str, Tensor] = {}
        for slot in range(distributed.rank(), self.recipe.batch, distributed.world_size()):
            parts = self._losses(SampleRng(self.recipe.seed, step, slot))
            share = {name: part / self.recipe.batch for name, part in parts.items()}
            torch.stack(list(share.values())).sum().backward()  # type: ignore[no-untyped-call]
            totals = {name: totals.get(name, 0) + part.detach() for name, part in share.items()}
        return totals

    def _losses(self, rng: SampleRng) -> dict[str, Tensor]:
        """The mean squared error of the velocity, start - picture, in each panel, weighted; they add up to the loss."""
        encoded, device = self._data(rng), self.backbone.device
        start, sigma = self._begun(rng, encoded)
        moved = (1 - sigma) * encoded.composite + sigma * start
        velocity = self.backbone.predict(
            moved.to(device),
            encoded.condition.to(device),
            sigma.to(device),
            self.prompt,
            self.recipe.guidance,
        )
        errors = (velocity - (start - encoded.composite).to(device)).square()
        weights = self._weights()
        trust = {"R": encoded.trust}
        return {
            f"panel_{name}": weights[name] * trust.get(name, 1.0) * panel.mean()
            for name, panel in split(errors, self.recipe.layout).items()
        }

    def _begun(self, rng: SampleRng, encoded: EncodedSample) -> tuple[Tensor, Tensor]:
        """Where this sample starts, and at which time from 0 to 1 it is looked at."""
        if encoded.start is not None:
            return encoded.start, torch.ones(1)
        recipe, grid = self.recipe, encoded.composite
        normal = recipe.logit_mean + recipe.logit_deviation * rng.normal(1)
        sigma = self.backbone.shifted(normal.sigmoid(), grid.shape[2] * grid.shape[3])
        return rng.normal(*grid.shape), sigma

    def _weights(self) -> dict[str, float]:
        """How much each panel counts; 1 in all."""
        named = {panel: self.recipe.panel_weights.get(panel, 1.0) for panel in self.recipe.panels}
        return {panel: weight / sum(named.values()) for panel, weight in named.items()}

    def _panels(self, layers: Tensor) -> tuple[dict[str, Tensor], PanelFit]:
        """Of a picture that is only looked at: one that is smaller than a panel gets smaller panels."""
        height, width, _ = layers.shape
        fit = self.recipe.task.fit((width, height), self.backbone.multiple)
        return panels_in(layers, fit), fit

    def _answer(self, layers: Tensor) -> tuple[float, Tensor]:
        """The gain on a sample, and its row: photo and truths, then the panels."""
        truths, fit = self._panels(layers)
        made = self.separate(truths["I"])
        photo, truth, answer = ((fit.cut(panel) + 1) / 2 for panel in (truths["I"], truths["T"], made["T"]))
        panels = [
            functional.interpolate((panel + 1) / 2, _ROW_PX) for panel in (*truths.values(), *made.values())
        ]
        return gain_db(answer, photo, truth), torch.cat(panels, dim=3)[0]


def _refuse_idle(recipe: LoraRecipe) -> None:
    if recipe.batch % distributed.world_size():
        raise RecipeError(
            f"batch = {recipe.batch} is to be divided among {distributed.world_size()} processes",
            "an equal part for each",
            "raise batch to a multiple, or start fewer processes",
        )


def _find_prompt(recipe: LoraRecipe, backbone: Backbone) -> PromptEmbedding:
    if recipe.prompt.endswith(ENCODED_SUFFIX):
        return load_prompt(Path(recipe.prompt), backbone.name)
    return encode_prompt(recipe.backbone, PROMPTS[recipe.prompt])


def _adamw(parameters: Sequence[nn.Parameter], recipe: LoraRecipe) -> torch.optim.Optimizer:
    """AdamW, its moments in 8 bits where there is CUDA and bitsandbytes."""
    options: dict[str, Any] = {"lr": recipe.learning_rate, "weight_decay": recipe.weight_decay}
    if parameters[0].is_cuda and importlib.util.find_spec("bitsandbytes"):
        small = importlib.import_module("bitsandbytes.optim").AdamW8bit(parameters, **options)
        assert isinstance(small, torch.optim.Optimizer)
        return small
    return torch.optim.AdamW(parameters, **options)


def _shown(recipe: LoraRecipe, samples: SampleSequence) -> dict[str, list[Tensor]]:
    """A few validation pairs of each folder, (H, W, 9), or of the samples that it learns from."""
    folders = validation_pairs(recipe.data)
    if folders:
        return {name: [with_difference(*pair) for pair in pairs[:_SHOWN]] for name, pairs in folders.items()}
    return {"training": [samples[number].layers for number in range(min(_SHOWN, len(samples)))]}
