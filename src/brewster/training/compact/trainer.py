"""The compact network as a trainer: its losses, optimiser and running average, on the GPU where there is one.

network = train(read_recipe(Path("recipes/train/compact.toml")), Path("out/compact"), report)
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.errors import ModelError
from brewster.models.networks import DEFAULT_NETWORK, NETWORKS
from brewster.training.checkpoint import Checkpoint, fitting
from brewster.training.compact.export import export_onnx
from brewster.training.data.mixtures import Stream, TrainingBatch
from brewster.training.distributed import best_device
from brewster.training.loop import Report, run
from brewster.training.losses import finite, gain_db, separation_loss, tone
from brewster.training.recipe import CompactRecipe
from brewster.training.streams import held_out_mixtures, open_stream, validation_pairs
from brewster.worker_setup import single_torch_thread

Pairs = Mapping[str, list[tuple[Tensor, Tensor]]]
"""Encoded (photo, truth), float (1, 3, h, w) each, by the name of their folder."""

MODEL: Final = "model.onnx"
_VALIDATION_SIDE_PX: Final = 384
_HELD_OUT_MIXTURES: Final = 128
_HELD_OUT_SIDE_PX: Final = 192
_VISIBLE: Final = 1e-4
"""Mean squared difference, encoded: a photo at more than 40 dB from its transmission has no visible reflection."""
_MAX_GRADIENT_NORM: Final = 1.0
_TRAIN_IT_FIRST: Final = "train the recipe that makes it first, or mend start_from in this one"


def train(recipe: CompactRecipe, out: Path, report: Report) -> nn.Module:
    """Runs or resumes the recipe in folder `out`, as `loop.run` does; the network that users get.

    Raises:
        RecipeError: data missing, or `out` holds a run of another recipe.
        PhotoError: a picture cannot be read.
        ModelError, TargetError: as `loop.run`.
    """
    trainer = CompactTrainer(recipe)
    with single_torch_thread():  # of the caller; the trainer's own threads have one each
        run(trainer, out, report)
    return trainer.averaged_network()


class CompactTrainer:
    """A `Learner`: the network, the running average of its weights, and AdamW.

    `stream` stands in for the recipe's data.

    Raises:
        RecipeError, PhotoError: the data are missing or damaged.
    """

    def __init__(self, recipe: CompactRecipe, stream: Stream | None = None) -> None:
        self.recipe, self.device = recipe, best_device()
        self._entry = NETWORKS[recipe.network]
        self.stream = stream or open_stream(recipe, self.device)
        self._reduced = recipe.precision == "auto" and _has_bfloat16(self.device)
        self._pairs: Pairs = _fitted(validation_pairs(recipe.data), self._entry.stride) | _held_out(recipe)
        self._workers = 1 if self.device.type == "cpu" else os.cpu_count() or 1
        self._cores = torch.get_num_threads() if self.device.type == "cpu" else 1
        self._core_pool = _one_thread_each(self._cores)
        self._pool = _one_thread_each(self._workers)
        self._ahead: dict[int, Future[TrainingBatch]] = {}
        torch.manual_seed(recipe.seed)
        network = self._entry.pretrained()
        self.network = network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._begin_average()
        encoder = list(self.network.get_submodule("encoder").parameters())
        known = set(map(id, encoder))
        rest = [parameter for parameter in self.network.parameters() if id(parameter) not in known]
        self.optimizer = torch.optim.AdamW(
            [
                {"params": encoder, "peak": recipe.encoder_learning_rate},
                {"params": rest, "peak": recipe.learning_rate},
            ],
            weight_decay=recipe.weight_decay,
            fused=True,
        )

    @torch.no_grad()
    def initialize(self) -> None:
        """Begins with the averaged weights of other runs, if the recipe names any; of several, with their mean.

        The mean of runs that began alike is often better than each (Wortsman et al. 2022, model soups).

        Raises:
            ModelError: a checkpoint is missing, damaged or of another network.
        """
        for count, path in enumerate(self.recipe.start_from, start=1):
            other, checkpoint = self._entry.build(), Checkpoint.read(path, _TRAIN_IT_FIRST)
            with fitting(path, _TRAIN_IT_FIRST):
                _refuse_another_network(path, checkpoint, self.recipe.network)
                other.load_state_dict(checkpoint.state.get("average", {}))
            for mine, theirs in zip(self.network.parameters(), other.parameters(), strict=True):
                mine.lerp_(theirs.to(self.device), 1 / count)
        self._begin_average()

    def state_dict(self) -> dict[str, Any]:
        """Weights, their average, and the optimiser's moments."""
        return {
            "network": self.network.state_dict(),
            "average": self.average,
            "optimizer": self.optimizer.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from such a state."""
        self.network.load_state_dict(state["network"])
        self.average = {name: value.to(self.device) for name, value in state["average"].items()}
        self.optimizer.load_state_dict(state["optimizer"])

    def training_step(self, step: int) -> dict[str, float]:
        """One step of AdamW on one batch; returns the parts of the loss.

        Raises:
            ModelError: the loss is not a number; the last checkpoint is still good.
        """
        parts = self._set_gradients(self._batch(step).to(self.device))
        loss = finite(torch.stack(list(parts.values())).sum(), step)
        self._set_learning_rates(step)
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT_NORM)
        if norm.isfinite():  # else this batch is skipped: one infinite gradient would end a run of hours
            self.optimizer.step()
            self._update_average(step + 1)
        return {"loss": loss.item(), **{name: part.item() for name, part in parts.items()}}

    def _set_gradients(self, batch: TrainingBatch) -> dict[str, Tensor]:
        """Sets each parameter's gradient of the loss, a mean over the batch; returns the parts of the loss.

        On a CPU each core computes a share of the batch by itself: measured 1.2-1.3 times faster than all cores on
        one operation after the other (16 x 128 px, two cores).
        """
        count = len(batch.photo_encoded)
        shares = list(self._core_pool.map(self._share_of_gradients, batch.split(-(-count // self._cores))))
        for parameter in self.network.parameters():
            parameter.grad = torch.zeros_like(
                parameter
            )  # the fused optimiser needs the parameter's memory layout
        for n, _, gradients in shares:
            for parameter, gradient in zip(self.network.parameters(), gradients, strict=True):
                assert parameter.grad is not None
                parameter.grad.add_(gradient, alpha=n / count)
        names = shares[0][1]
        return {name: torch.stack([part[name] * n / count for n, part, _ in shares]).sum() for name in names}

    def _share_of_gradients(self, batch: TrainingBatch) -> tuple[int, dict[str, Tensor], tuple[Tensor, ...]]:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._reduced, cache_enabled=False):
            layers = self.network(_channels_last(batch.photo_encoded))
        parts = separation_loss(layers, batch)
        total = torch.stack(list(parts.values())).sum()
        gradients = torch.autograd.grad(total, tuple(self.network.parameters()))
        return len(batch.photo_encoded), {name: part.detach() for name, part in parts.items()}, gradients

    def validate(self) -> tuple[dict[str, float], Tensor]:
        """What the averaged network gains on the recipe's pairs, and what it makes of four of each folder."""
        network = self.averaged_network()
        numbers = validate(network, self._pairs, self._core_pool.map)
        return numbers, _sheet(network, self._pairs or self._some())

    def export(self, folder: Path) -> Path:
        """Writes model.onnx, which needs no torch.

        Raises:
            TargetError: it cannot be written.
        """
        export_onnx(self.averaged_network(), folder / MODEL, self._entry.stride)
        return folder / MODEL

    def averaged_network(self) -> nn.Module:
        """The network with the running average of its weights, ready to be used."""
        network = self._entry.build().eval()
        network.load_state_dict(self.average)
        return network

    def _begin_average(self) -> None:
        self.average = {name: value.clone() for name, value in self.network.state_dict().items()}

    def _batch(self, wanted: int) -> TrainingBatch:
        """The batch of this step; those of the next steps are made in the background meanwhile."""
        for step in range(wanted, wanted + 1 + self._workers):
            if step not in self._ahead:
                size = self.recipe.size_at(step)
                self._ahead[step] = self._pool.submit(self.stream, step, self.recipe.batch, size)
        return self._ahead.pop(wanted).result()

    def _set_learning_rates(self, step: int) -> None:
        warm = min(1.0, (step + 1) / self.recipe.warmup_steps)
        left = (1 - step / self.recipe.steps) / max(self.recipe.decay_share, 1e-9)
        cosine = 0.5 - 0.5 * math.cos(math.pi * min(1.0, left))
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * warm * cosine

    @torch.no_grad()
    def _update_average(self, steps: int) -> None:
        decay = min(self.recipe.average_decay, (steps + 1) / (steps + 10))
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)

    def _some(self) -> Pairs:
        batch = self.stream(0, self.recipe.batch, self.recipe.size_at(0)).to(torch.device("cpu"))
        pairs = zip(batch.photo_encoded[:, None], batch.transmission_encoded[:, None], strict=True)
        return {"training": list(pairs)}


def validate(
    network: Callable[[Tensor], Tensor], pairs: Pairs, map_: Callable[..., Iterable[Any]] = map
) -> dict[str, float]:
    """By folder, at the (small) size of the given pairs: the mean gain in PSNR over the input, in dB; the share of pairs
    that are worse than the input; and the tone, the light of the answer over that of the input where nothing was added,
    which is 1 for a network that leaves the exposure alone. `map_` may be that of a pool of threads.
    """

    @torch.no_grad()
    def measure(pair: tuple[Tensor, Tensor]) -> tuple[float, float]:
        answer = network(pair[0])[:, :3].clamp(0, 1)
        return gain_db(answer, *pair), tone(answer, *pair)

    numbers = {}
    for name, folder in filter(itemgetter(1), pairs.items()):
        gains, tones = zip(*map_(measure, folder), strict=True)
        numbers[f"gain_db_{name}"] = sum(gains) / len(gains)
        numbers[f"worse_{name}"] = sum(gain < 0 for gain in gains) / len(gains)
        numbers[f"tone_{name}"] = sum(tones) / len(tones)
    return numbers


@torch.no_grad()
def _sheet(network: nn.Module, pairs: Pairs) -> Tensor:
    """Rows of photo, truth, transmission and reflection, four of each folder: (H, 960, 3)."""
    rows = []
    for photo, truth in (pair for folder in pairs.values() for pair in folder[:4]):
        layers = network(photo)
        row = torch.cat([photo, truth, layers[:, :3], layers[:, 3:]], dim=3)
        rows.append(functional.interpolate(row, (160, 960), mode="bilinear", antialias=True)[0])
    return torch.cat(rows, dim=1).permute(1, 2, 0)


def _fitted(folders: Pairs, stride: int) -> dict[str, list[tuple[Tensor, Tensor]]]:
    return {
        name: [(_fit(photo, stride), _fit(truth, stride)) for photo, truth in pairs]
        for name, pairs in folders.items()
    }


def _refuse_another_network(path: Path, checkpoint: Checkpoint, wanted: str) -> None:
    """Checkpoints of runs older than the recipe's `network` hold the default one."""
    found = json.loads(checkpoint.recipe).get("network", DEFAULT_NETWORK)
    if found != wanted:
        raise ModelError(
            f"{path} holds the network {found}",
            f"a checkpoint of {wanted}, the network that the recipe trains",
            _TRAIN_IT_FIRST,
        )


def _one_thread_each(count: int) -> ThreadPoolExecutor:
    """Threads that compute side by side, each operation in one of them: they never wait for each other."""
    return ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,))


def _has_bfloat16(device: torch.device) -> bool:
    """Whether the processor computes bfloat16 natively; elsewhere it is emulated, 20 to 50 times slower than float32."""
    if device.type != "cpu":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def _held_out(recipe: CompactRecipe) -> dict[str, list[tuple[Tensor, Tensor]]]:
    """Always the same mixtures of what the recipe holds out: those with a visible reflection, and those without."""
    stream = held_out_mixtures(recipe)
    if stream is None:
        return {}
    batch = stream(0, _HELD_OUT_MIXTURES, _HELD_OUT_SIDE_PX)
    pairs = list(zip(batch.photo_encoded[:, None], batch.transmission_encoded[:, None], strict=True))
    visible = [functional.mse_loss(*pair).item() > _VISIBLE for pair in pairs]
    return {
        name: [pair for pair, shown in zip(pairs, visible, strict=True) if shown is wanted]
        for name, wanted in (("mixtures", True), ("plain", False))
    }


def _fit(picture: Tensor, stride: int) -> Tensor:
    """uint8 (H, W, 3) to float (1, 3, h, w) that the network takes, longest side 384 px."""
    height, width, _ = picture.shape
    scale = _VALIDATION_SIDE_PX / max(height, width)
    size = [max(1, round(side * scale / stride)) * stride for side in (height, width)]
    planes = picture.permute(2, 0, 1)[None] / 255
    return functional.interpolate(planes, size, mode="bilinear", antialias=True)


def _channels_last(pictures: Tensor) -> Tensor:
    return pictures.contiguous(memory_format=torch.channels_last)
