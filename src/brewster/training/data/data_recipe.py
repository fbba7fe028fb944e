"""The part of a training recipe that selects the training data: photos, real pairs and rendered samples."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from brewster.scene.values import FrozenModel, PositiveInt, Seed, Share
from brewster.training.data.mixtures import Target
from brewster.training.data.online import Mixing


class RenderedRecipe(FrozenModel):
    """Rendered samples: either `sets` from `brewster render`, or a scene `recipe` to render during training."""

    sets: tuple[Path, ...] = ()
    """Folders of rendered sets, relative to BREWSTER_DATA."""
    recipe: str | None = None
    """A packaged scene recipe by its name, or a TOML file, relative to this recipe."""
    count: Annotated[int, Field(ge=0)] | None = None
    """Number of different samples. Not set: all samples of `sets`, or no limit with `recipe`. 0: no rendered samples."""
    share: Share = 1.0
    """Share of rendered samples among the samples of a batch that are not real pairs. The others are mixtures of photos."""
    mixing: Mixing = "light"
    """How the photo is composed. light: T + R in linear light. 8-bit: a blend of 8-bit images, for comparison."""
    target: Target = "background"
    """What the network predicts behind the glass: the background B without glass, or the transmission T."""
    orders: Literal["all", "paper"] | None = None
    """Replaces the key `orders` of the scene recipe."""
    seed: Seed | None = None
    """Seed of the scenes. Not set: the seed of this recipe."""
    maps: tuple[Path, ...] = ()
    """Folders of environment maps for `recipe`, relative to BREWSTER_DATA. Empty: built-in environments."""
    photos: tuple[Path, ...] = ()
    """Folders of photos for `recipe`, relative to BREWSTER_DATA. Empty: built-in paintings."""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if bool(self.sets) == bool(self.recipe):
            raise ValueError(
                "rendered samples come either from sets on disk or from a scene recipe: set one of the two"
            )
        unused = [
            name for name in ("orders", "seed", "maps", "photos") if getattr(self, name) not in (None, ())
        ]
        if self.sets and unused:
            raise ValueError(f"sets are rendered already, so that {', '.join(unused)} would have no effect")
        return self


class DataRecipe(FrozenModel):
    """Training data: folders relative to BREWSTER_DATA.

    In each batch, `pairs_share` is the share of real pairs. `rendered.share` is the share of rendered samples among the
    others. The remaining samples are mixtures of photos and maps. A source with a share of 0 is not read.
    """

    photos: tuple[Path, ...] = ()
    """Folders of photos for mixtures."""
    maps: tuple[Path, ...] = ()
    """Folders of environment maps for mixtures."""
    pairs: tuple[Path, ...] = ()
    """Folders of real pairs: a photo through glass and the same view without glass."""
    pairs_share: Share = 0.0
    """Share of real pairs in each batch. Required with `pairs`."""
    rendered: RenderedRecipe | None = None
    exclude: tuple[str, ...] = ()
    """File names of photos and maps that are not used; * and ? match as in a shell."""
    held_out: tuple[str, ...] = ()
    """File names of further photos and maps that are not used for training. The compact model is validated on mixtures of
    them."""
    validate_on: tuple[Path, ...] = ()
    """Folders of real pairs to validate on."""
    validate_at_most: PositiveInt = 40
    """Largest number of pairs from each folder in `validate_on`. They are evenly spaced in the order of their names."""

    @property
    def excluded_files(self) -> tuple[str, ...]:
        """File names and patterns of the photos and maps that are not used for training."""
        return self.exclude + self.held_out

    @property
    def rendered_share(self) -> float:
        """The share of rendered samples among the samples that are not real pairs; 0 without rendered samples."""
        return self.rendered.share if self.rendered and self.rendered.count != 0 else 0.0

    @property
    def is_empty(self) -> bool:
        """Whether there is no training data: every source has a share or a count of 0."""
        return not (self.photos or self.pairs_share or self.rendered_share)

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        if not (self.photos or self.pairs or self.rendered):
            raise ValueError("there is no training data: set at least one of photos, pairs and rendered")
        if self.pairs_share and not self.pairs:
            raise ValueError(f"pairs_share is {self.pairs_share:g}, and pairs is empty")
        if self.pairs and "pairs_share" not in self.model_fields_set:
            raise ValueError("pairs needs pairs_share, their share of each batch; it may be 0")
        if self.photos and self.rendered and "share" not in self.rendered.model_fields_set:
            raise ValueError(
                "photos and rendered together need rendered.share, the share of rendered samples; it may be 0 or 1"
            )
        if not (self.photos or self.is_empty or self.pairs_share == 1 or self.rendered_share == 1):
            raise ValueError(
                "pairs and rendered samples fill only a part of each batch, and there are no photos for the rest"
            )
        return self
