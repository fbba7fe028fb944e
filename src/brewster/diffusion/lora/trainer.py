"""The trainer of a LoRA on a diffusion backbone: flow matching on panels (the paper's
"Text-to-image Model Fine-tuning").

The gradients of a batch are accumulated one sample at a time, so that each can have its own aspect
ratio. Sample, noise and time depend on (seed, step, slot) only.
"""

import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.base.files import write_atomically
from brewster.diffusion.adapter import lora
from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.backbones.loading import encode_prompt, load_backbone
from brewster.diffusion.backbones.registry import backbone_cost, find_backbone, local_folder
from brewster.diffusion.lora import latents
from brewster.diffusion.lora.model_card import write_card
from brewster.diffusion.lora.recipe import ENCODED_SUFFIX, LoraRecipe
from brewster.diffusion.memory import Placement, check_machine, torch_device
from brewster.diffusion.offloading import explain_out_of_memory
from brewster.diffusion.pipeline import DecompositionPipeline
from brewster.diffusion.prompt import PROMPTS, PromptEmbedding, load_prompt
from brewster.diffusion.task import split
from brewster.errors import DeviceError
from brewster.training.data.sample_rng import SampleRng
from brewster.training.losses import check_finite, psnr_gain_db, total
from brewster.training.plots import read_log, sample_sheet
from brewster.training.streams import validation_pairs

LORA_FOLDER: Final = "lora"
RECIPE_FILE: Final = "recipe.json"
_MAX_GRADIENT_NORM: Final = 1.0
_MAX_VALIDATION_SAMPLES: Final = 4
"""Validation samples per folder. Few, because generating one takes as long as several training
steps.
"""
_THUMBNAIL_SHAPE_PX: Final = (160, 240)  # height, width
_MEMORY_CURE: Final = (
    "lower max_composite_pixels or rank, quantize the backbone, or choose a "
    "smaller backbone (klein)"
)


class LoraTrainer:
    """The `Trainer` of a LoRA: a frozen backbone, a float32 LoRA on it, and AdamW.

    The constructor checks the data and the machine. The backbone is loaded later, at its first use,
    so that `initialize` can load and release the text encoders before. `device` is "auto" for the
    GPU, or "cpu".
    """

    def __init__(self, recipe: LoraRecipe, device: str = "auto") -> None:
        self.recipe = recipe
        self._device = torch_device(device)
        self._backbone_class, _ = find_backbone(recipe.backbone)
        samples = self._samples = latents.open_samples(recipe)
        samples.check_sizes(recipe, self._backbone_class.size_divisor)
        # Up to four validation pairs of each folder, (H, W, 9), or training samples if the recipe
        # names no such folder.
        self._validation_samples = {
            name: [latents.layers_from_pair(*pair) for pair in pairs[:_MAX_VALIDATION_SAMPLES]]
            for name, pairs in validation_pairs(recipe.data).items()
        } or {
            "training": [
                samples[index].layers for index in range(min(_MAX_VALIDATION_SAMPLES, len(samples)))
            ]
        }
        try:
            check_machine(
                recipe.backbone,
                backbone_cost(recipe.backbone, self._backbone_class),
                Placement(self._device, recipe.quantization),
                requested=device,
                with_text_encoders=not recipe.prompt.endswith(ENCODED_SUFFIX),
            )
        except DeviceError as error:
            if self._device != "cpu" or device == "cpu":
                raise
            raise DeviceError(
                error.happened,
                "expected an NVIDIA or AMD GPU, because training takes weeks on a CPU",
                "train on a machine with a GPU, or choose --device cpu explicitly",
            ) from error
        self._prompt: PromptEmbedding | None = None

    @cached_property
    def backbone(self) -> Backbone:
        """The frozen backbone with the LoRA. The first use loads it."""
        recipe = self.recipe
        backbone = load_backbone(
            recipe.backbone, device=self._device, quantization=recipe.quantization
        )
        names = ("rank", "alpha", "seed", "target_modules")
        lora.add_lora(backbone, **{name: getattr(recipe, name) for name in names})
        backbone.transformer.enable_gradient_checkpointing()
        return backbone

    @cached_property
    def _encoded_samples(self) -> latents.EncodedSampleLoader:
        return latents.EncodedSampleLoader(self._samples, self.backbone, self.recipe)

    @cached_property
    def _parameters(self) -> list[nn.Parameter]:
        return lora.lora_parameters(self.backbone)

    @cached_property
    def _optimizer(self) -> torch.optim.Optimizer:
        recipe = self.recipe
        return torch.optim.AdamW(
            self._parameters, lr=recipe.learning_rate, weight_decay=recipe.weight_decay
        )

    @property
    def prompt(self) -> PromptEmbedding:
        """The encoded prompt; available after `initialize` or `load_state_dict`."""
        assert self._prompt, "call initialize or load_state_dict first"
        return self._prompt

    def initialize(self) -> None:
        """Loads or encodes the prompt of the recipe, then loads the backbone. The text encoders are
        released before the backbone is loaded.
        """
        name = self.recipe.prompt
        backbone = self.recipe.backbone
        if name.endswith(ENCODED_SUFFIX):
            self._prompt = load_prompt(Path(name), self._backbone_class.name)
        else:
            self._prompt = encode_prompt(backbone, PROMPTS[name], device=self._device)
        _ = self.backbone

    def state_dict(self) -> dict[str, Any]:
        """Returns the LoRA, the state of the optimiser, and the prompt, but not the backbone."""
        prompt = {"text": self.prompt.text, **self.prompt.tensors}
        return {
            "lora": lora.lora_state_dict(self.backbone),
            "optimizer": self._optimizer.state_dict(),
            "prompt": prompt,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state that `state_dict` returned."""
        lora.load_lora_state(self.backbone, state["lora"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._prompt = PromptEmbedding(self._backbone_class.name, **state["prompt"])

    def training_step(self, step: int) -> dict[str, float]:
        """Runs one step of AdamW on one batch. Returns `loss` and the term of each panel,
        `loss_panel_NAME`. Raises ModelError if the loss is not finite, and DeviceError, with the
        values to lower, if the GPU is out of memory.
        """
        self._optimizer.zero_grad()
        parts: dict[str, Tensor] = {}
        with explain_out_of_memory(_MEMORY_CURE):
            for slot in range(self.recipe.batch_size):
                losses = self._losses(SampleRng(self.recipe.seed, step, slot))
                scaled = {name: loss / self.recipe.batch_size for name, loss in losses.items()}
                total(scaled).backward()  # type: ignore[no-untyped-call]
                parts = {name: parts.get(name, 0) + loss.detach() for name, loss in scaled.items()}
        loss = check_finite(total(parts), step)
        check_finite(
            nn.utils.clip_grad_norm_(self._parameters, _MAX_GRADIENT_NORM), step, "gradient"
        )
        for group in self._optimizer.param_groups:
            group["lr"] = self.recipe.learning_rate * self.recipe.learning_rate_factor(step)
        self._optimizer.step()
        return {
            "loss": loss.item(),
            **{f"loss_{name}": part.item() for name, part in parts.items()},
        }

    @torch.no_grad()
    def validate(self) -> tuple[dict[str, float], Tensor]:
        """Returns the mean PSNR gain of the generated T over the photo in dB for each folder, and
        an image of the panels.
        """
        columns = [f"ground truth {panel}" for panel in "ITR"]
        columns += [f"generated {panel}" for panel in self.recipe.panels]
        means = {}
        rows = []
        for name, folder in self._validation_samples.items():
            results = [self._validate_sample(layers) for layers in folder]
            means[f"psnr_gain_db_{name}"] = sum(gain for gain, _ in results) / len(results)
            for number, (gain, image) in enumerate(results, start=1):
                rows.append((f"{name} {number}: PSNR gain {gain:+.2f} dB", image.clamp(0, 1)))
        return means, sample_sheet(columns, rows)

    def export(self, folder: Path) -> Path:
        """Writes LoRA, prompt, recipe and model card to the folder `lora` in `folder`, and returns
        its path.
        """
        lora_folder = folder / LORA_FOLDER
        recipe = self.recipe
        lora.save_lora(
            lora_folder,
            self.backbone,
            self.prompt,
            recipe.task,
            base_model=str(local_folder(recipe.backbone) or recipe.backbone),
            quantization=recipe.quantization,
            target_modules=recipe.target_modules,
        )
        text = json.dumps(recipe.model_dump(mode="json"), indent=2)
        write_atomically(lora_folder / RECIPE_FILE, f"{text}\n".encode(), overwrite=True)
        scores = [{}, *read_log(folder)][-1]
        write_card(lora_folder, recipe, scores, type(self.backbone))
        return lora_folder

    def separate(self, photo: Tensor, *, seed: int = 0) -> Mapping[str, Tensor]:
        """Generates the panels of a photo of a panel's size, (1, 3, h, w) in [-1, 1], as at
        inference.
        """
        return DecompositionPipeline(self.backbone, self.prompt, self.recipe.task)(
            photo, seeds=[seed]
        )

    def _losses(self, rng: SampleRng) -> dict[str, Tensor]:
        """Returns the weighted mean squared error of the predicted velocity for each panel. The
        loss is the sum of these errors. The true velocity is start - composite.
        """
        encoded = self._encoded_samples(rng)
        device = self.backbone.device
        start, sigma = self._start_and_sigma(rng, encoded)
        noisy = (1 - sigma) * encoded.composite + sigma * start
        noisy, condition, sigma = (each.to(device) for each in (noisy, encoded.condition, sigma))
        velocity = self.backbone.predict(noisy, condition, sigma, self.prompt, self.recipe.guidance)
        errors = (velocity - (start - encoded.composite).to(device)).square()
        weights: dict[str, float] = {
            name: self.recipe.panel_weights.get(name, 1.0) for name in self.recipe.panels
        }
        whole = sum(weights.values())
        reliability = {"R": encoded.reflection_weight}
        return {
            f"panel_{name}": weights[name] / whole * reliability.get(name, 1.0) * panel.mean()
            for name, panel in split(errors, self.recipe.layout).items()
        }

    def _start_and_sigma(
        self, rng: SampleRng, encoded: latents.EncodedSample
    ) -> tuple[Tensor, Tensor]:
        """Returns the start of the path (noise, or the photo for one_step) and the time sigma: 1 at
        the start, 0 at the composite. Times are logit-normal (Esser et al. 2024), then shifted for
        the resolution.
        """
        if encoded.start is not None:
            return encoded.start, torch.ones(1)
        grid = encoded.composite
        sigma = self.backbone.shifted(rng.normal(1).sigmoid(), grid.shape[2] * grid.shape[3])
        return rng.normal(*grid.shape), sigma

    def _validate_sample(self, layers: Tensor) -> tuple[float, Tensor]:
        """Returns the PSNR gain on a sample in dB, and a row of photo, ground truth and generated
        panels.
        """
        fit = latents.fit_sample(layers, self.recipe, self.backbone.size_divisor)
        ground_truth = latents.make_panels(layers, fit)
        predicted = self.separate(ground_truth["I"])
        photo, transmission, prediction = (
            (fit.crop(panel) + 1) / 2
            for panel in (ground_truth["I"], ground_truth["T"], predicted["T"])
        )
        panels = [
            functional.interpolate((panel + 1) / 2, _THUMBNAIL_SHAPE_PX)
            for panel in (*ground_truth.values(), *predicted.values())
        ]
        return psnr_gain_db(prediction, photo, transmission), torch.cat(panels, dim=3)[0]
