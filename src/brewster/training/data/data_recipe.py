"""The table [data] of a training recipe: photos, real pairs and rendered samples."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from brewster.scene.values import FrozenModel, PositiveInt, Seed, Share
from brewster.training.data.mixtures import Target
from brewster.training.data.online import BlendSpace


class RenderedRecipe(FrozenModel):
    """Rendered samples: either from `datasets` of `brewster render`, or rendered during training from a scene `recipe`."""

    datasets: tuple[Path, ...] = ()
    """Folders of rendered datasets, relative to BREWSTER_DATA."""
    recipe: str | None = None
    """The name of a packaged scene recipe, or the path of a TOML file, relative to this recipe."""
    count: Annotated[int, Field(ge=0)] | None = None
    """Number of different samples. Not set: all samples of `datasets`, or no limit for `recipe`. 0: no rendered samples."""
    share: Share = 1.0
    """Share of rendered samples among the samples of a batch that are not real pairs. The rest are mixtures of photos."""
    blend_space: BlendSpace = "linear"
    """How the photo is composed. linear: rendered in linear light. srgb: a blend of 8-bit sRGB images, for comparison."""
    target: Target = "background"
    """What the network predicts: the background B without glass, or the transmission T, which is B through the glass."""
    orders: Literal["all", "truncated"] | None = None
    """Replaces the value of `orders` in the scene recipe. Not set: the value in the scene recipe."""
    seed: Seed | None = None
    """Seed of the scenes. Not set: the seed of this recipe."""
    maps: tuple[Path, ...] = ()
    """Folders of environment maps for `recipe`, relative to BREWSTER_DATA. Empty: built-in environments."""
    photos: tuple[Path, ...] = ()
    """Folders of photos for `recipe`, relative to BREWSTER_DATA. Empty: built-in paintings."""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if bool(self.datasets) == bool(self.recipe):
            raise ValueError(
                "expected either datasets (rendered before) or recipe (rendered during training): exactly one of the two"
            )
        unused = [
            name for name in ("orders", "seed", "maps", "photos") if getattr(self, name) not in (None, ())
        ]
        if self.datasets and unused:
            raise ValueError(
                f"expected no {', '.join(unused)}: datasets are already rendered, so that these keys have no effect"
            )
        return self


class DataRecipe(FrozenModel):
    """Training data. Folders are relative to BREWSTER_DATA. A source with a share of 0 is not read.

    For the compact network, a batch of n samples has n * pairs_share real pairs. Of the other samples, the share
    `rendered.share` is rendered, and the rest are mixtures of photos and maps. For a LoRA, `pairs_share` is the probability that
    a sample is a real pair, and all other samples are rendered.
    """

    photos: tuple[Path, ...] = ()
    """Folders of photos for mixtures."""
    maps: tuple[Path, ...] = ()
    """Folders of environment maps for mixtures."""
    pairs: tuple[Path, ...] = ()
    """Folders of real pairs: a photo through glass and the same view without glass."""
    pairs_share: Share = 0.0
    """Share of real pairs in each batch. Must be set explicitly if `pairs` is set."""
    rendered: RenderedRecipe | None = None
    exclude: tuple[str, ...] = ()
    """File names of photos and maps to exclude. * and ? are wildcards as in a shell."""
    held_out: tuple[str, ...] = ()
    """File names to exclude from training, in addition to `exclude`. A compact network is validated on mixtures of these files."""
    validate_on: tuple[Path, ...] = ()
    """Folders of real pairs to validate on."""
    max_validation_pairs: PositiveInt = 40
    """Maximum number of pairs from each folder in `validate_on`. The pairs are evenly spaced in the order of their names."""

    @property
    def excluded_files(self) -> tuple[str, ...]:
        """File names and patterns that are excluded from training."""
        return self.exclude + self.held_out

    @property
    def rendered_share(self) -> float:
        """Share of rendered samples among the samples that are not real pairs; 0 if nothing is rendered."""
        return self.rendered.share if self.rendered and self.rendered.count != 0 else 0.0

    @property
    def is_empty(self) -> bool:
        """Whether there is no source with a share and a count above 0."""
        return not (self.photos or self.pairs_share or self.rendered_share)

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        if not (self.photos or self.pairs or self.rendered):
            raise ValueError("expected at least one of photos, pairs and rendered")
        if self.pairs_share and not self.pairs:
            raise ValueError(f"expected pairs, because pairs_share is {self.pairs_share:g}")
        if self.pairs and "pairs_share" not in self.model_fields_set:
            raise ValueError(
                "expected pairs_share, the share of the pairs in each batch, because pairs is set; 0 is allowed"
            )
        if self.photos and self.rendered and "share" not in self.rendered.model_fields_set:
            raise ValueError(
                "expected rendered.share, the share of rendered samples, because photos and rendered are set;"
                " 0 and 1 are allowed"
            )
        if not (self.photos or self.is_empty or self.pairs_share == 1 or self.rendered_share == 1):
            raise ValueError(
                "expected photos for the rest of each batch: pairs and rendered samples are only a part of it"
            )
        return self
