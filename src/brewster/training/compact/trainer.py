"""Trains the compact network with AdamW and an exponential moving average (EMA) of the weights."""

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.base.executors.local import single_torch_thread
from brewster.errors import ModelError
from brewster.separation.models.networks import MAX_STRIDE, NETWORKS
from brewster.separation.models.zoo import MODEL_FILE, model_file
from brewster.training.compact.export import export_onnx, read_weights
from brewster.training.data.hints import simulate_hints
from brewster.training.data.mixtures import Stream, TrainingBatch
from brewster.training.losses import (
    check_finite,
    exposure_ratio,
    psnr_gain_db,
    separation_loss,
    total,
)
from brewster.training.plots import sample_sheet
from brewster.training.recipe import CompactRecipe
from brewster.training.streams import held_out_mixtures, open_stream, validation_pairs

ValidationPairs = Mapping[str, list[tuple[Tensor, Tensor]]]
"""folder -> pairs of photo and ground truth, each float (1, 3, h, w), sRGB-encoded."""

_VALIDATION_SIDE_PX: Final = 384
_HELD_OUT_COUNT: Final = 320
"""Number of mixtures of held-out photos for validation."""
_HELD_OUT_SIDE_PX: Final = 192
_MIN_VISIBLE_MSE: Final = 1e-4
"""Smallest mean squared difference of encoded photo and transmission with a visible reflection: a
PSNR of 40 dB.
"""
_COLUMNS: Final = (
    "photo (input)",
    "ground truth of T",
    "predicted transmission T",
    "predicted reflection R",
)
_MAX_GRADIENT_NORM: Final = 1.0


class CompactTrainer:
    """The `Trainer` of a compact network. It contains the network, the EMA of its weights, and the
    optimiser AdamW.

    A `stream` replaces the training data of the recipe. `device` is "auto" for the GPU if there is
    one, or "cpu".
    """

    def __init__(
        self, recipe: CompactRecipe, stream: Stream | None = None, device: str = "auto"
    ) -> None:
        self.recipe = recipe
        self.device = torch.device(
            "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
        )
        self._entry = NETWORKS[recipe.network]
        self.stream = stream or open_stream(recipe)
        self._uses_bfloat16 = recipe.precision == "auto" and _has_bfloat16(self.device)
        self._validation_pairs: ValidationPairs = {
            name: [(_resize(photo), _resize(truth)) for photo, truth in pairs]
            for name, pairs in validation_pairs(recipe.data).items()
        } | _held_out_pairs(recipe)
        self._data_workers = 1 if self.device.type == "cpu" else os.cpu_count() or 1
        self._chunk_count = torch.get_num_threads() if self.device.type == "cpu" else 1
        self._chunk_pool = _single_thread_pool(self._chunk_count)
        self._data_pool = _single_thread_pool(self._data_workers)
        self._prefetched: dict[int, Future[TrainingBatch]] = {}
        torch.manual_seed(recipe.seed)
        network = self._entry.build() if recipe.init else self._entry.pretrained()
        self.network = network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._reset_ema()
        encoder = list[nn.Parameter]()
        others = list[nn.Parameter]()
        for name, parameter in self.network.named_parameters():
            parameter.requires_grad_(name.startswith(recipe.trained_part))
            (encoder if name.startswith("encoder.") else others).append(parameter)
        self._parameters = [
            parameter for parameter in self.network.parameters() if parameter.requires_grad
        ]
        groups = [
            {"params": encoder, "peak": recipe.encoder_learning_rate},
            {"params": others, "peak": recipe.learning_rate},
        ]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=recipe.weight_decay, fused=True)

    def initialize(self) -> None:
        """Loads the weights of `init`. Those of `trained_part`, and those that the model lacks,
        keep their initial values. Raises ModelError if the model is unknown or damaged, or contains
        another network.
        """
        if self.recipe.init is None:
            return
        weights = read_weights(model_file(self.recipe.init).path)
        new = self.recipe.trained_part
        expected = {name: value.shape for name, value in self.network.state_dict().items()}
        if not weights or any(value.shape != expected.get(name) for name, value in weights.items()):
            raise ModelError(
                f"{self.recipe.init} contains another network",
                f"expected the network {self.recipe.network}, or a part of it",
                "correct init in the recipe",
            )
        kept = {
            name: value for name, value in weights.items() if not (new and name.startswith(new))
        }
        self.network.load_state_dict(kept, strict=False)
        self._reset_ema()

    def state_dict(self) -> dict[str, Any]:
        """Returns the weights, their EMA, and the state of the optimiser."""
        return {
            "network": self.network.state_dict(),
            "average": self.ema_weights,
            "optimizer": self.optimizer.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state that `state_dict` returned."""
        self.network.load_state_dict(state["network"])
        self.ema_weights = {name: value.to(self.device) for name, value in state["average"].items()}
        self.optimizer.load_state_dict(state["optimizer"])

    def training_step(self, step: int) -> dict[str, float]:
        """Runs one step of AdamW. Returns `loss` and its terms. Raises ModelError if the loss is
        not finite.
        """
        batch = self._batch(step).to(self.device)
        # Two threads of the optimiser wait actively for each other: a quarter of the time on a busy
        # machine
        with single_torch_thread():
            parts = self._compute_gradients(batch)
            loss = check_finite(total(parts), step)
            for group in self.optimizer.param_groups:
                group["lr"] = group["peak"] * self.recipe.learning_rate_factor(step)
            norm = nn.utils.clip_grad_norm_(self._parameters, _MAX_GRADIENT_NORM)
            # Skip the batch if its gradient is infinite: one such step makes all weights invalid.
            if norm.isfinite():
                self.optimizer.step()
                self._update_ema(step + 1)
        return {
            "loss": loss.item(),
            **{f"loss_{name}": part.item() for name, part in parts.items()},
        }

    def _compute_gradients(self, batch: TrainingBatch) -> dict[str, Tensor]:
        """Computes the gradient of the batch's mean loss for each parameter. Returns the parts of
        the loss.

        On a CPU, one thread computes each chunk of the batch: 1.2-1.3 times as fast as splitting
        each operation.
        """
        count = len(batch.photo_encoded)
        chunks = batch.split(-(-count // self._chunk_count))
        results = list(self._chunk_pool.map(self._chunk_gradients, chunks))
        for parameter in self._parameters:
            # The fused optimiser ignores strides (dev/notes/compact-model.md)
            parameter.grad = torch.zeros_like(parameter)
        for n, _, gradients in results:
            for parameter, gradient in zip(self._parameters, gradients, strict=True):
                assert parameter.grad is not None
                parameter.grad.add_(gradient, alpha=n / count)
        names = results[0][1]
        return {
            name: torch.stack([part[name] * n / count for n, part, _ in results]).sum()
            for name in names
        }

    def _chunk_gradients(
        self, batch: TrainingBatch
    ) -> tuple[int, dict[str, Tensor], tuple[Tensor, ...]]:
        with torch.autocast(
            self.device.type, torch.bfloat16, enabled=self._uses_bfloat16, cache_enabled=False
        ):
            photo = batch.photo_encoded.contiguous(memory_format=torch.channels_last)
            layers = (
                self.network(photo) if batch.hints is None else self.network(photo, batch.hints)
            )
        recipe = self.recipe
        parts = separation_loss(
            layers, batch, recipe.edge_weight, recipe.edge_scales_px, recipe.clipped_weight
        )
        gradients = torch.autograd.grad(total(parts), self._parameters, materialize_grads=True)
        return (
            len(batch.photo_encoded),
            {name: part.detach() for name, part in parts.items()},
            gradients,
        )

    def validate(self) -> tuple[dict[str, float], Tensor]:
        """Returns the metrics of the EMA network, and an image of up to four predictions per
        folder.
        """
        network = self.ema_network()
        metrics = validate(network, self._validation_pairs, self._chunk_pool.map)
        pairs = self._validation_pairs
        if not pairs:
            batch = self.stream(0, self.recipe.batch_size, self.recipe.size_at(0)).to(
                torch.device("cpu")
            )
            images = zip(
                batch.photo_encoded[:, None], batch.transmission_encoded[:, None], strict=True
            )
            pairs = {"training": list(images)}
        return metrics, _draw_samples(network, pairs)

    def export(self, folder: Path) -> Path:
        """Writes the EMA network to model.onnx in `folder`. Returns the path of the file."""
        export_onnx(self.ema_network(), folder / MODEL_FILE, self._entry)
        return folder / MODEL_FILE

    def ema_network(self) -> nn.Module:
        """Returns a copy of the network with the EMA of the weights."""
        network = self._entry.build().eval()
        network.load_state_dict(self.ema_weights)
        return network

    def _reset_ema(self) -> None:
        self.ema_weights = {
            name: value.clone() for name, value in self.network.state_dict().items()
        }

    def _batch(self, step: int) -> TrainingBatch:
        """Returns the batch of this step, and starts to compute the next batches in background
        threads.
        """
        for ahead in range(step, step + 1 + self._data_workers):
            if ahead not in self._prefetched:
                self._prefetched[ahead] = self._data_pool.submit(self._read_batch, ahead)
        return self._prefetched.pop(step).result()

    def _read_batch(self, step: int) -> TrainingBatch:
        recipe = self.recipe
        batch = self.stream(step, recipe.batch_size, recipe.size_at(step))
        if not recipe.hint_probability:
            return batch
        hints = simulate_hints(
            batch, probability=recipe.hint_probability, seed=recipe.seed, step=step
        )
        return replace(batch, hints=hints)

    @torch.no_grad()
    def _update_ema(self, steps: int) -> None:
        decay = min(self.recipe.ema_decay, (steps + 1) / (steps + 10))
        for name, value in self.network.state_dict().items():
            self.ema_weights[name].lerp_(value, 1 - decay)


def validate(
    network: Callable[[Tensor], Tensor],
    pairs: ValidationPairs,
    map_: Callable[..., Iterable[Any]] = map,
) -> dict[str, float]:
    """Computes the metrics of a network on unresized pairs. `map_` may be the `map` of a thread
    pool.

    Returns for each folder: psnr_gain_db_NAME, the mean PSNR gain over the input in dB; worse_NAME,
    the fraction of pairs that become worse; exposure_NAME, the mean `exposure_ratio`.
    """

    @torch.no_grad()
    def measure(pair: tuple[Tensor, Tensor]) -> tuple[float, float]:
        prediction = network(pair[0])[:, :3].clamp(0, 1)
        return psnr_gain_db(prediction, *pair), exposure_ratio(prediction, *pair)

    metrics = {}
    for name, folder in filter(itemgetter(1), pairs.items()):
        gains, exposures = zip(*map_(measure, folder), strict=True)
        metrics[f"psnr_gain_db_{name}"] = sum(gains) / len(gains)
        metrics[f"worse_{name}"] = sum(gain < 0 for gain in gains) / len(gains)
        metrics[f"exposure_{name}"] = sum(exposures) / len(exposures)
    return metrics


@torch.no_grad()
def _draw_samples(network: nn.Module, pairs: ValidationPairs) -> Tensor:
    """Returns an image, (H, 960, 3), sRGB-encoded, with one row for each of the first four pairs of
    every folder.
    """
    rows = []
    for name, folder in pairs.items():
        for number, (photo, ground_truth) in enumerate(folder[:4], start=1):
            layers = network(photo)
            gain = psnr_gain_db(layers[:, :3].clamp(0, 1), photo, ground_truth)
            row = torch.cat([photo, ground_truth, layers[:, :3], layers[:, 3:]], dim=3)
            images = functional.interpolate(row, (160, 960), mode="bilinear", antialias=True)[0]
            rows.append((f"{name} {number}: PSNR gain {gain:+.2f} dB", images))
    return sample_sheet(_COLUMNS, rows)


def _single_thread_pool(count: int) -> ThreadPoolExecutor:
    """Returns a thread pool in which each torch operation uses one core, so that threads do not
    wait at barriers.
    """
    return ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,))


def _has_bfloat16(device: torch.device) -> bool:
    """Whether the device computes bfloat16 natively. Emulated bfloat16 is 20 to 50 times slower
    than float32.
    """
    if device.type != "cpu":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def _held_out_pairs(recipe: CompactRecipe) -> dict[str, list[tuple[Tensor, Tensor]]]:
    """Returns fixed mixtures of held-out photos: those in "mixtures" have a visible reflection,
    "plain" ones do not.
    """
    stream = held_out_mixtures(recipe)
    if stream is None:
        return {}
    batch = stream(0, _HELD_OUT_COUNT, _HELD_OUT_SIDE_PX)
    found: dict[str, list[tuple[Tensor, Tensor]]] = {"mixtures": [], "plain": []}
    for pair in zip(batch.photo_encoded[:, None], batch.transmission_encoded[:, None], strict=True):
        has_reflection = functional.mse_loss(*pair).item() > _MIN_VISIBLE_MSE
        found["mixtures" if has_reflection else "plain"].append(pair)
    return found


def _resize(image: Tensor) -> Tensor:
    """Resizes uint8 (H, W, 3) to float (1, 3, h, w) in 0..1. Sides are multiples of MAX_STRIDE, the
    larger near 384.
    """
    height, width, _ = image.shape
    scale = _VALIDATION_SIDE_PX / max(height, width)
    size = [max(1, round(side * scale / MAX_STRIDE)) * MAX_STRIDE for side in (height, width)]
    planes = image.permute(2, 0, 1)[None] / 255
    return functional.interpolate(planes, size, mode="bilinear", antialias=True)
