"""A training recipe: TOML in, frozen values out, unknown or impossible ones refused by name.

Paths in a recipe are relative to the folder that `BREWSTER_DATA` names.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from brewster.dataset.mix import Blend, MixRecipe, Mixtures, Pairs, Stream
from brewster.dataset.sources import read_maps, read_pairs, read_photos
from brewster.errors import RecipeError
from brewster.models.compact import STRIDE
from brewster.scene.values import Above0, Positive, Seed, Share, Values, read_toml

Side = Annotated[int, Field(gt=0, multiple_of=STRIDE)]


def _rising_from_0(sizes: list[tuple[float, int]]) -> list[tuple[float, int]]:
    starts, sides = zip(*sizes, strict=True)
    if starts[0] != 0 or list(starts) != sorted(set(starts)) or list(sides) != sorted(sides):
        raise ValueError("the shares start at 0 and rise, and so do the sides")
    return sizes


Sizes = Annotated[list[tuple[Share, Side]], Field(min_length=1), AfterValidator(_rising_from_0)]


class DataRecipe(Values):
    """Which folders, relative to BREWSTER_DATA, and which file names in them to leave out."""

    photos: Annotated[list[Path], Field(min_length=1)]
    maps: tuple[Path, ...] = ()
    pairs: tuple[Path, ...] = ()
    pairs_share: Share = 0.0
    exclude: tuple[str, ...] = ()
    validate_on: tuple[Path, ...] = ()


class TrainRecipe(Values):
    """One run. `sizes` lists (share of the run, side in px): small pictures first, large ones last."""

    seed: Seed
    steps: Positive
    batch: Positive
    sizes: Sizes
    learning_rate: Above0
    encoder_learning_rate: Above0
    warmup_steps: Positive
    weight_decay: Annotated[float, Field(ge=0)]
    average_decay: Share
    start_from: Path | None = None
    """A checkpoint whose averaged weights this run starts from, relative to the recipe."""
    report_every: Positive
    checkpoint_every: Positive
    data: DataRecipe
    mix: MixRecipe = MixRecipe()

    @model_validator(mode="after")
    def _blends(self) -> Self:
        real = round(self.batch * self.data.pairs_share)
        if real == self.batch or bool(real) != bool(self.data.pairs):
            raise ValueError(
                f"pairs_share gives {real} of {self.batch} samples, where pairs need some but not all, and no pairs 0"
            )
        return self

    def size_at(self, step: int) -> int:
        """Side of the training pictures in px at this step, a multiple of 32."""
        return [size for start, size in self.sizes if step >= start * self.steps][-1]


def read_recipe(path: Path) -> TrainRecipe:
    """Reads and checks a recipe.

    Raises:
        RecipeError: missing, not TOML, or with values that are missing, unknown or impossible.
    """
    recipe = read_toml(TrainRecipe, path, compare="the recipes in recipes/train/")
    if recipe.start_from:
        return recipe.model_copy(update={"start_from": path.parent / recipe.start_from})
    return recipe


def data_folder() -> Path:
    """Where recipes find their data: `BREWSTER_DATA`.

    Raises:
        RecipeError: the variable is unset or names no folder.
    """
    folder = os.environ.get("BREWSTER_DATA", "")
    if not Path(folder or "/nowhere").is_dir():
        raise RecipeError(
            f"BREWSTER_DATA is {folder!r}",
            "the folder that a recipe's paths start from",
            "export BREWSTER_DATA=/path/to/data",
        )
    return Path(folder)


def open_stream(recipe: TrainRecipe) -> Stream:
    """The recipe's training data, read into memory: mixtures, joined by real pairs where it asks for them.

    Raises:
        RecipeError: a folder is missing or empty, or pairs do not fit together.
        PhotoError: a picture cannot be read.
    """
    root, data = data_folder(), recipe.data
    photos = read_photos([root / folder for folder in data.photos], data.exclude)
    maps = read_maps([root / folder for folder in data.maps], data.exclude)
    mixtures = Mixtures(photos, maps, recipe.mix, seed=recipe.seed)
    if not data.pairs:
        return mixtures
    pairs = Pairs(read_pairs([root / folder for folder in data.pairs]), recipe.mix.crop, seed=recipe.seed + 1)
    return Blend(pairs, mixtures, data.pairs_share)
