"""Training recipes: the settings of one training run, read from TOML into frozen models.

Data paths in a recipe are relative to the folder in the environment variable BREWSTER_DATA. This
module imports no torch, so that `brewster train --show-recipe` does not need it.
"""

import math
import os
import tomllib
from collections.abc import Set
from contextlib import suppress
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, ClassVar, Final, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from brewster.base.settings import (
    FrozenModel,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Seed,
    Share,
    packaged_file,
    read_toml,
    validated,
)
from brewster.errors import RecipeError
from brewster.separation.models.networks import DEFAULT_NETWORK, MAX_STRIDE, NETWORKS
from brewster.training.data.data_recipe import DataRecipe, MixRecipe

_REFERENCE: Final = "docs/recipes.md"

_TEMPLATE_FOLDER: Final = Path(__file__).parent / "recipes"
TEMPLATES: Final = tuple(sorted(path.stem for path in _TEMPLATE_FOLDER.glob("*.toml")))
"""The names of the packaged recipes, starting points for new recipes: one for the compact network,
one for a LoRA.
"""


def _ascending_from_0(sizes: list[tuple[float, int]]) -> list[tuple[float, int]]:
    starts, sides = zip(*sizes, strict=True)
    if starts[0] != 0 or list(starts) != sorted(set(starts)) or list(sides) != sorted(sides):
        raise ValueError(
            "expected shares that start at 0 and increase, and sides that do not decrease"
        )
    return sizes


def _known_network(name: str) -> str:
    if name not in NETWORKS:
        raise ValueError(f"expected one of the networks: {', '.join(NETWORKS)}")
    return name


Side = Annotated[int, Field(gt=0, multiple_of=MAX_STRIDE)]
ImageSizeSchedule = Annotated[
    list[tuple[Share, Side]],
    Field(min_length=1),
    AfterValidator(_ascending_from_0),
    WithJsonSchema(
        {
            "type": "list of [share, side]: shares increase from 0 and are at most 1; sides are "
            f"multiples of {MAX_STRIDE} px and do not decrease"
        }
    ),
]


RECIPE_KINDS: Final = {"backbone": "brewster.diffusion.lora.recipe:LoraRecipe"}
"""The key that only recipes of one kind have -> the class of this kind, which is imported when a
recipe has the key. A recipe without such a key is a `CompactRecipe`. Models of the layers above
training are added here; training imports none of them.
"""


class TrainingRecipe(FrozenModel):
    """The settings of every training run."""

    trainer: ClassVar[str]
    """The class of the trainer, "module:class", which imports torch."""

    seed: Seed
    """Seed of all random numbers. On the same machine, the same recipe and data give bit-identical
    weights on a CPU.
    """
    steps: PositiveInt
    """Number of training steps."""
    batch_size: PositiveInt
    """Number of samples per training step."""
    learning_rate: PositiveFloat
    """Peak learning rate of AdamW."""
    warmup_steps: PositiveInt
    """Number of steps in which the learning rate rises linearly from 0 to its peak."""
    learning_rate_decay_share: Share = 1.0
    """Share of the steps, at the end of the run, in which the learning rate falls to zero along a
    cosine. Between warm-up and decay, it is constant.
    """
    weight_decay: NonNegativeFloat
    """Weight decay of AdamW."""
    report_every: PositiveInt
    """Number of steps between two reports: log line, validation, example images."""
    checkpoint_every: PositiveInt
    """Number of steps between two checkpoints. A stopped run resumes from its last checkpoint."""
    data: DataRecipe

    def learning_rate_factor(self, step: int) -> float:
        """Returns the learning rate at this step (from 0) divided by its peak: linear rise,
        constant, cosine decay.
        """
        warm = min(1.0, (step + 1) / self.warmup_steps)
        remaining = (1 - step / self.steps) / max(self.learning_rate_decay_share, 1e-9)
        return warm * (0.5 - 0.5 * math.cos(math.pi * min(1.0, remaining)))

    def resolved(self, folder: Path) -> Self:
        """Returns a copy whose paths of files next to the recipe start at this folder.

        Args:
            folder: the folder of the recipe.
        """
        raise NotImplementedError


class CompactRecipe(TrainingRecipe):
    """A training run of a compact network."""

    trainer: ClassVar[str] = "brewster.training.compact.trainer:CompactTrainer"
    network: Annotated[
        str, AfterValidator(_known_network), WithJsonSchema({"enum": [*NETWORKS]})
    ] = DEFAULT_NETWORK
    """Name of the network in the table `NETWORKS` of `brewster.separation.models.networks`."""
    image_size_schedule: ImageSizeSchedule
    """Side of the training images. Each entry applies from the given share of the steps until the
    next entry: `[0.5, 160]` sets sides of 160 px after half of the steps. Smaller images at the
    beginning make training faster.
    """
    encoder_learning_rate: PositiveFloat
    """Peak learning rate of the pretrained encoder."""
    ema_decay: Share
    """Decay per step of the exponential moving average (EMA) of the weights, which is exported."""
    precision: Literal["float32", "auto"] = "float32"
    """float32: all layers. auto: bfloat16 if the device supports it, except for depthwise
    convolutions and the head.
    """
    edge_weight: NonNegativeFloat = 1.0
    """Weight of the error of the transmission's image gradients in the loss."""
    edge_scales_px: Annotated[
        tuple[Annotated[int, Field(ge=1, le=MAX_STRIDE // 2)], ...], Field(min_length=1)
    ] = (1,)
    """Sides of the averaging windows, in pixels, after which the image gradients are compared."""
    clipped_weight: NonNegativeFloat = 0.0
    """Weight of the error of values that are clipped in the photo and in the transmission, in the
    loss.
    """
    hint_probability: Share = 0.0
    """Probability of a sample with simulated hints of a person: where there is reflection, and
    where only the scene.
    """
    init: str | None = None
    """The model from which training starts: a name from `brewster models list`, or an .onnx file,
    relative to this recipe. It contains this network. Not set: ImageNet features.
    """
    trained_part: Literal["", "hints.", "tone."] = ""
    """The part of the network that is trained, from zero if `init` is set. hints.: only the weights
    of the hints, so that photos without hints give the same layers as before. tone.: only those
    that correct large areas of the transmission. Empty: all weights.
    """
    mix: MixRecipe = MixRecipe()

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        pair_count = _sample_count(self.batch_size, "pairs_share", self.data.pairs_share)
        _sample_count(self.batch_size - pair_count, "rendered.share", self.data.rendered_share)
        if self.hint_probability and not NETWORKS[self.network].takes_hints:
            raise ValueError(
                f"expected hint_probability 0, because the network {self.network} takes no hints"
            )
        return self

    def size_at(self, step: int) -> int:
        """Returns the side of the training images at this step in px, a multiple of 32."""
        return [size for start, size in self.image_size_schedule if step >= start * self.steps][-1]

    def resolved(self, folder: Path) -> Self:
        """See `TrainingRecipe.resolved`: the path of `init`, unless it is the name of a model."""
        if not (self.init and self.init.endswith(".onnx")):
            return self
        return self.model_copy(update={"init": str(folder / self.init)})


AnyRecipe = TypeVar("AnyRecipe", bound=TrainingRecipe)


def _sample_count(batch_size: int, name: str, share: float) -> int:
    """Returns the number of samples of a source in a batch. A share between 0 and 1 must give some,
    not all.
    """
    count = round(batch_size * share)
    if batch_size and 0 < share < 1 and count in (0, batch_size):
        raise ValueError(
            f"expected a sample of each source, but {name} = {share:g} gives {count} of "
            f"{batch_size} samples:"
            " raise batch_size, or change the share"
        )
    return count


def read_recipe(path: Path) -> TrainingRecipe:
    """Reads a recipe of a kind in `RECIPE_KINDS`, or a CompactRecipe; resolves paths relative to
    the file.

    Args:
        path: the TOML file.

    Raises:
        RecipeError: the file is missing or not TOML, a key is missing or unknown, or a value is not
            allowed.
    """
    return _read_unresolved(path).resolved(path.parent.resolve())


def read_template(name: str) -> TrainingRecipe:
    """Reads a packaged recipe (a name of TEMPLATES) or a file; relative paths are not resolved."""
    return _read_unresolved(packaged_file(name, _TEMPLATE_FOLDER))


def _read_unresolved(path: Path) -> TrainingRecipe:
    keys: Set[str] = set()
    with suppress(OSError, ValueError):  # read_toml raises an error for such a file
        keys = tomllib.loads(path.read_text("utf-8")).keys()
    names = [name for key, name in RECIPE_KINDS.items() if key in keys]
    recipe_class: type[TrainingRecipe] = resolve_name(names[0]) if names else CompactRecipe
    return read_toml(recipe_class, path, reference=_REFERENCE)


def with_value(recipe: AnyRecipe, key_path: str, value: object) -> AnyRecipe:
    """Returns a copy of the recipe with one changed value. All values of the copy are validated.

    `key_path` is the key with its tables, such as "data.rendered.blend_space". Raises RecipeError
    if the recipe has no such key, or the value is not allowed for it.
    """
    values = table = recipe.model_dump(exclude_unset=True)
    *tables, key = key_path.split(".")
    for name in tables:
        # A table that is not set, or a value that is no table: `validated` refuses what cannot be.
        if not isinstance(table.get(name), dict):
            table[name] = {}
        table = table[name]
    table[key] = value
    source = f"the recipe with {key_path} = {value!r}"
    return validated(type(recipe), values, source=source, reference=_REFERENCE)


def data_folder() -> Path:
    """Returns the folder in the environment variable BREWSTER_DATA. Raises RecipeError if there is
    none.
    """
    folder = os.environ.get("BREWSTER_DATA", "")
    if not Path(folder or "/nowhere").is_dir():
        raise RecipeError(
            f"BREWSTER_DATA is {folder!r}" if folder else "BREWSTER_DATA is not set",
            "expected an existing folder: the paths in a recipe are relative to it",
            "export BREWSTER_DATA=/path/to/data",
        )
    return Path(folder)
