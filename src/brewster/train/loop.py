"""The training loop, the only one: `train(recipe, out, report)` runs or resumes, bit for bit.

It runs on the GPU where torch sees one, else on the CPU. Every step depends on the checkpoint and on
(seed, step) alone: no hidden state, so on the CPU a killed run that resumes ends with the same weights, to the
last bit, as one that never stopped (same machine, same number of threads).
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import torch
from pydantic import ValidationError
from torch import Tensor, nn
from torch.nn import functional

from brewster.dataset.mix import Batch, Stream
from brewster.dataset.sources import read_pairs
from brewster.errors import ModelError, RecipeError
from brewster.files import write_atomically
from brewster.light import to_linear
from brewster.models.compact import STRIDE, CompactNetwork, with_imagenet_features
from brewster.photo import Photo
from brewster.train.checkpoint import AFRESH, Checkpoint
from brewster.train.data import open_stream
from brewster.train.losses import separation_loss
from brewster.train.recipe import TrainRecipe, data_folder

Report = Callable[[int, int, Mapping[str, float], bool], None]
"""Called with (step, steps, numbers, logged) after every step; `logged` says that the numbers went into the log."""

_VALIDATION_SIDE_PX: Final = 384
_ROUNDING: Final = 1 / (12 * 255**2)
"""The mean squared error of rounding to 8 bits; pictures that differ by less are the same, at 58.9 dB."""
_MAX_GRADIENT_NORM: Final = 1.0
_TRAIN_IT_FIRST: Final = "train the recipe that makes it first, or mend start_from in this one"


def best_device() -> torch.device:
    """The GPU where torch sees one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


class Trainer:
    """A run in memory: network, running average, optimiser, and the step they stand at."""

    def __init__(self, recipe: TrainRecipe, stream: Stream) -> None:
        torch.manual_seed(recipe.seed)
        self.recipe, self.stream, self.step = recipe, stream, 0
        self.device = best_device()
        self._workers = 1 if self.device.type == "cpu" else os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self._workers)
        self._ahead: dict[int, Future[Batch]] = {}
        network = with_imagenet_features()
        self.network = network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._begin_average()
        encoder = list(self.network.encoder.parameters())
        known = set(map(id, encoder))
        rest = [parameter for parameter in self.network.parameters() if id(parameter) not in known]
        self.optimizer = torch.optim.AdamW(
            [
                {"params": encoder, "peak": recipe.encoder_learning_rate},
                {"params": rest, "peak": recipe.learning_rate},
            ],
            weight_decay=recipe.weight_decay,
        )

    def start_from(self, checkpoint: Checkpoint) -> None:
        """Begins with the averaged weights of another run."""
        self.network.load_state_dict(checkpoint.average)
        self._begin_average()

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continues where the checkpoint was written."""
        self.network.load_state_dict(checkpoint.network)
        self.average = {name: value.to(self.device) for name, value in checkpoint.average.items()}
        self.optimizer.load_state_dict(checkpoint.optimizer)
        self.step = checkpoint.step

    def checkpoint(self) -> Checkpoint:
        """The state after the last whole step."""
        return Checkpoint(
            step=self.step,
            network=self.network.state_dict(),
            average=self.average,
            optimizer=self.optimizer.state_dict(),
            recipe=self.recipe.model_dump_json(),
        )

    def advance(self) -> dict[str, float]:
        """One step of AdamW on one batch; returns the parts of the loss.

        Raises:
            ModelError: the loss is not a number; the last checkpoint is still good.
        """
        batch = self._next_batch().to(self.device)
        parts = separation_loss(self.network(_channels_last(batch.photo_encoded)), batch)
        loss = torch.stack(list(parts.values())).sum()
        if not loss.isfinite():
            raise ModelError(
                f"the loss is {loss.item()} at step {self.step}",
                "a finite loss",
                "resume from the last checkpoint with a lower learning rate",
            )
        self._set_learning_rates()
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT_NORM)
        self.optimizer.step()
        self.step += 1
        self._update_average()
        return {"loss": loss.item(), **{name: part.item() for name, part in parts.items()}}

    def averaged_network(self) -> CompactNetwork:
        """The network with the running average of its weights, ready to be used."""
        network = CompactNetwork().eval()
        network.load_state_dict(self.average)
        return network

    def _begin_average(self) -> None:
        self.average = {name: value.clone() for name, value in self.network.state_dict().items()}

    def _next_batch(self) -> Batch:
        """The batch of this step; those of the next steps are made in the background meanwhile."""
        for step in range(self.step, self.step + 1 + self._workers):
            if step not in self._ahead:
                size = self.recipe.size_at(step)
                self._ahead[step] = self._pool.submit(self.stream, step, self.recipe.batch, size)
        return self._ahead.pop(self.step).result()

    def _set_learning_rates(self) -> None:
        warm = min(1.0, (self.step + 1) / self.recipe.warmup_steps)
        cosine = 0.5 + 0.5 * math.cos(math.pi * self.step / self.recipe.steps)
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * warm * cosine

    @torch.no_grad()
    def _update_average(self) -> None:
        decay = min(self.recipe.average_decay, (self.step + 1) / (self.step + 10))
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)


def train(recipe: TrainRecipe, out: Path, report: Report) -> CompactNetwork:
    """Runs the recipe to its end in folder `out`, from its checkpoint if there is one.

    A recipe whose data are none (a count of 0) takes no step: the network is returned as it starts.

    `out` receives `checkpoint.pt`, `log.jsonl` and, at every report, `samples.png` (photo, transmission,
    reflection of the first validation pairs or training samples).

    Raises:
        RecipeError: data missing, or `out` holds a run of another recipe.
        PhotoError: a picture cannot be read.
        ModelError: a checkpoint is missing, damaged or of another network, or the loss is not a number.
        TargetError: `out` cannot be written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(recipe, open_stream(recipe, best_device()))
    saved, log = out / "checkpoint.pt", out / "log.jsonl"
    _take_up(trainer, saved)
    _forget_after(trainer.step, log)
    pairs = _validation_pairs(recipe)
    started = time.monotonic()
    while trainer.step < recipe.steps and not recipe.data.is_none:
        numbers = trainer.advance()
        logged = trainer.step % recipe.report_every == 0 or trainer.step == recipe.steps
        if logged:
            network = trainer.averaged_network()
            numbers |= validate(network, pairs) | {"seconds": time.monotonic() - started}
            _log(log, {"step": trainer.step, **numbers})
            _write_samples(out / "samples.png", network, pairs or _some(trainer))
        if trainer.step % recipe.checkpoint_every == 0 or trainer.step == recipe.steps:
            trainer.checkpoint().write(saved)
        report(trainer.step, recipe.steps, numbers, logged)
    return trainer.averaged_network()


@torch.no_grad()
def validate(network: CompactNetwork, pairs: Mapping[str, list[tuple[Tensor, Tensor]]]) -> dict[str, float]:
    """Mean PSNR gain in dB over doing nothing, per folder, at the (small) size of the given pairs."""
    gains = {}
    for name, folder in pairs.items():
        scores = []
        for photo, truth in folder:
            answer = network(photo)[:, :3].clamp(0, 1)
            errors = [functional.mse_loss(picture, truth) for picture in (photo, answer)]
            before, after = (max(error.item(), _ROUNDING) for error in errors)
            scores.append(10 * math.log10(before / after))
        gains[f"gain_db_{name}"] = sum(scores) / len(scores)
    return gains


def _take_up(trainer: Trainer, saved: Path) -> None:
    """Goes on with the run if it has begun, else begins it where its recipe says."""
    recipe = trainer.recipe
    if saved.exists():
        checkpoint = _of_this_recipe(Checkpoint.read(saved), recipe, saved)
        with _fitting(saved, AFRESH):
            trainer.restore(checkpoint)
    elif recipe.start_from:
        checkpoint = Checkpoint.read(recipe.start_from, _TRAIN_IT_FIRST)
        with _fitting(recipe.start_from, _TRAIN_IT_FIRST):
            trainer.start_from(checkpoint)


@contextmanager
def _fitting(path: Path, cure: str) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError, KeyError) as error:
        raise ModelError(
            f"{path} holds another network", "a checkpoint of the compact network", cure
        ) from error


def _of_this_recipe(checkpoint: Checkpoint, recipe: TrainRecipe, path: Path) -> Checkpoint:
    if _identity(checkpoint.recipe) == _identity(recipe.model_dump_json()):
        return checkpoint
    raise RecipeError(
        f"{path} belongs to another recipe",
        "a run resumes only with the recipe that it began with",
        "choose another folder with -o",
    )


def _identity(recipe: str) -> dict[str, object]:
    """What a run must keep to be resumed: all but the place of the file that it started from.

    What a recipe does not name, such as a value that is newer than the run, counts as its default.
    """
    try:
        return TrainRecipe.model_validate_json(recipe).model_dump(exclude={"start_from"})
    except ValidationError:
        return {}


def _validation_pairs(recipe: TrainRecipe) -> dict[str, list[tuple[Tensor, Tensor]]]:
    folders = tuple(dict.fromkeys(recipe.data.validate_on))
    root = data_folder() if folders else Path()
    return {
        name: [(_fit(photo), _fit(truth)) for photo, truth in read_pairs([root / folder])]
        for name, folder in zip(_short(folders), folders, strict=True)
    }


def _short(folders: Sequence[Path]) -> list[str]:
    """Names for different folders: as much of the end of their paths as tells them apart."""
    for length in range(1, max((len(folder.parts) for folder in folders), default=0)):
        names = ["/".join(folder.parts[-length:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return list(map(str, folders))


def _fit(picture: Tensor) -> Tensor:
    """uint8 (H, W, 3) to float (1, 3, h, w) that the network takes, longest side 384 px."""
    height, width, _ = picture.shape
    scale = _VALIDATION_SIDE_PX / max(height, width)
    size = [max(1, round(side * scale / STRIDE)) * STRIDE for side in (height, width)]
    planes = picture.permute(2, 0, 1)[None] / 255
    return functional.interpolate(planes, size, mode="bilinear", antialias=True)


def _some(trainer: Trainer) -> dict[str, list[tuple[Tensor, Tensor]]]:
    batch = trainer.stream(0, trainer.recipe.batch, trainer.recipe.size_at(0)).to(torch.device("cpu"))
    pairs = zip(batch.photo_encoded[:, None], batch.transmission_encoded[:, None], strict=True)
    return {"training": list(pairs)}


def _log(path: Path, numbers: Mapping[str, float]) -> None:
    with path.open("a") as stream:
        stream.write(json.dumps({name: round(value, 5) for name, value in numbers.items()}) + "\n")


def _forget_after(step: int, log: Path) -> None:
    """Drops the lines that a killed run wrote after its last checkpoint, the last of them perhaps half."""
    lines = log.read_text().splitlines() if log.exists() else []
    kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
    if kept != lines:
        write_atomically(log, "".join(f"{line}\n" for line in kept).encode(), overwrite=True)


@torch.no_grad()
def _write_samples(
    path: Path, network: CompactNetwork, pairs: Mapping[str, list[tuple[Tensor, Tensor]]]
) -> None:
    """Rows of photo, truth, transmission and reflection, four of each folder."""
    rows = []
    for photo, truth in (pair for folder in pairs.values() for pair in folder[:4]):
        layers = network(photo)
        row = torch.cat([photo, truth, layers[:, :3], layers[:, 3:]], dim=3)
        rows.append(functional.interpolate(row, (160, 960), mode="bilinear", antialias=True)[0])
    sheet = torch.cat(rows, dim=1).clamp(0, 1).permute(1, 2, 0)
    Photo.from_array(to_linear(sheet).numpy(), encoding="linear").save(path, depth=8, overwrite=True)


def _channels_last(pictures: Tensor) -> Tensor:
    return pictures.contiguous(memory_format=torch.channels_last)


__all__ = ["Batch", "Trainer", "train", "validate"]
