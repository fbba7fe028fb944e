"""A training recipe: TOML in, frozen values out, unknown or impossible ones refused by name.

Paths in a recipe are relative to the folder that `BREWSTER_DATA` names.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, ValidationError, model_validator

from brewster.errors import RecipeError
from brewster.models.diffusion.panels import Direction, Panel, PanelLayout
from brewster.models.diffusion.prompt import PROMPTS
from brewster.models.diffusion.sampling import GUIDANCE
from brewster.models.diffusion.task import PAPER_PX, DecompositionTask, Objective
from brewster.models.networks import DEFAULT_NETWORK, LARGEST_STRIDE, NETWORKS
from brewster.models.zoo import TINY
from brewster.options import Quantisation
from brewster.scene.values import (
    FrozenModel,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Seed,
    Share,
    read_toml,
    validation_error,
)
from brewster.training.data.mixtures import MixRecipe, Target
from brewster.training.data.online import Mixing

_COMPARE = "the recipes in recipes/train/"

ENCODED_SUFFIX: Final = ".safetensors"
"""The ending of an encoded prompt's file."""


def _ascending_from_0(sizes: list[tuple[float, int]]) -> list[tuple[float, int]]:
    starts, sides = zip(*sizes, strict=True)
    if starts[0] != 0 or list(starts) != sorted(set(starts)) or list(sides) != sorted(sides):
        raise ValueError("the shares start at 0 and rise, and so do the sides")
    return sizes


Side = Annotated[int, Field(gt=0, multiple_of=LARGEST_STRIDE)]


def _known_network(name: str) -> str:
    if name not in NETWORKS:
        raise ValueError(f"there is no network {name!r}: one of {', '.join(NETWORKS)}")
    return name


Sizes = Annotated[list[tuple[Share, Side]], Field(min_length=1), AfterValidator(_ascending_from_0)]


class RenderedRecipe(FrozenModel):
    """Rendered samples: `sets` that `brewster render` made, or a scene `recipe` to render while the network learns."""

    sets: tuple[Path, ...] = ()
    recipe: str | None = None
    """A packaged scene recipe by its name, or a TOML file, relative to this recipe."""
    count: Annotated[int, Field(ge=0)] | None = None
    """How many different samples; by default all of the sets, and of live ones no end. 0: none at all."""
    share: Share = 1.0
    """Of what pairs leave of each batch; mixtures of photos are the rest."""
    mixing: Mixing = "light"
    target: Target = "background"
    orders: Literal["all", "paper"] | None = None
    """Instead of the scene recipe's own."""
    seed: Seed | None = None
    """Of the scenes; by default this recipe's."""
    maps: tuple[Path, ...] = ()
    photos: tuple[Path, ...] = ()
    """Worlds of live scenes; the builtin ones where there is no folder."""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if bool(self.sets) == bool(self.recipe):
            raise ValueError(
                "rendered samples come either from sets, on disk, or from a recipe, live: name one of the two"
            )
        useless = [
            name for name in ("orders", "seed", "maps", "photos") if getattr(self, name) not in (None, ())
        ]
        if self.sets and useless:
            raise ValueError(
                f"sets are rendered already, so that {', '.join(useless)} can change nothing in them"
            )
        return self


class DataRecipe(FrozenModel):
    """What a network learns from: folders relative to BREWSTER_DATA, and file names in them to leave out.

    Of each batch `pairs_share` are real pairs, `rendered.share` of the others are rendered, and the rest are
    mixtures of photos and maps. What has a share of 0 is listed but neither read nor used.
    """

    photos: tuple[Path, ...] = ()
    maps: tuple[Path, ...] = ()
    pairs: tuple[Path, ...] = ()
    pairs_share: Share = 0.0
    rendered: RenderedRecipe | None = None
    exclude: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    """Photos and maps that are not learnt from either: the compact model is validated on mixtures of them."""
    validate_on: tuple[Path, ...] = ()
    validate_at_most: PositiveInt = 40
    """Pairs of each folder in `validate_on`, evenly spaced in order of name."""

    @property
    def excluded_files(self) -> tuple[str, ...]:
        """File names that training leaves out."""
        return self.exclude + self.held_out

    @property
    def rendered_share(self) -> float:
        """How much of what pairs leave is rendered: 0 if there is no sample."""
        return self.rendered.share if self.rendered and self.rendered.count != 0 else 0.0

    @property
    def is_empty(self) -> bool:
        """Whether everything that is listed has a share, or a count, of 0."""
        return not (self.photos or self.pairs_share or self.rendered_share)

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        if not (self.photos or self.pairs or self.rendered):
            raise ValueError("a network learns from photos, pairs or rendered, and here is none of them")
        if self.pairs_share and not self.pairs:
            raise ValueError(f"pairs_share is {self.pairs_share:g}, and there are no pairs")
        if self.pairs and "pairs_share" not in self.model_fields_set:
            raise ValueError("with pairs, pairs_share says how much of each batch they are; it may be 0")
        if self.photos and self.rendered and "share" not in self.rendered.model_fields_set:
            raise ValueError("with photos, rendered.share says how much is rendered; it may be 0 or 1")
        if not (self.photos or self.is_empty or self.pairs_share == 1 or self.rendered_share == 1):
            raise ValueError(
                "pairs and rendered samples leave a part of each batch, and there are no photos for it"
            )
        return self


class TrainingRecipe(FrozenModel):
    """One run, whatever learns in it."""

    seed: Seed
    steps: PositiveInt
    batch: PositiveInt
    learning_rate: PositiveFloat
    warmup_steps: PositiveInt
    weight_decay: NonNegativeFloat
    report_every: PositiveInt
    checkpoint_every: PositiveInt
    data: DataRecipe


class CompactRecipe(TrainingRecipe):
    """A run of a compact network. `sizes` lists (share of the run, side in px): small pictures first."""

    network: Annotated[str, AfterValidator(_known_network)] = DEFAULT_NETWORK
    """A name in the table of `brewster.models.networks`."""
    sizes: Sizes
    encoder_learning_rate: PositiveFloat
    average_decay: Share
    decay_share: Share = 1.0
    """The last share of the run, over which the learning rate falls to zero along a cosine; constant before."""
    precision: Literal["float32", "auto"] = "float32"
    """auto: bfloat16 where the processor computes it natively. Depthwise convolutions and the head stay float32."""
    start_from: tuple[Path, ...] = ()
    """Checkpoints, relative to the recipe: this run starts from the mean of their averaged weights."""
    mix: MixRecipe = MixRecipe()

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        real = _share_of(self.batch, "pairs_share", self.data.pairs_share)
        _share_of(self.batch - real, "rendered.share", self.data.rendered_share)
        return self

    def size_at(self, step: int) -> int:
        """Side of the training pictures in px at this step, a multiple of 32."""
        return [size for start, size in self.sizes if step >= start * self.steps][-1]


class LoraRecipe(TrainingRecipe):
    """A run of a LoRA on a large backbone; the defaults are the paper's, or the usual ones where it is silent.

    Each sample of a batch is a real pair with the chance `data.pairs_share`, else a rendered one, whole and in its
    own aspect ratio: neither mixtures nor live scenes, which are square.
    """

    backbone: str
    """A name in the table, a hub id, a folder, or "tiny:" and a name: that backbone's toy twin, random weights."""
    rank: PositiveInt = 16
    alpha: PositiveInt = 16
    quantise: Quantisation | None = None
    panels: tuple[Panel, ...] = ("I", "T", "R")
    direction: Direction = "side by side"
    budget_px: PositiveInt = PAPER_PX
    """The most pixels that all panels have together."""
    panel_weights: dict[Panel, NonNegativeFloat] = Field(default_factory=dict)
    """How much each panel counts in the loss, 1 if not named."""
    objective: Objective = "flow"
    """From noise to panels in many steps, or from the photo, in every panel, to what it lacks in one."""
    guidance: NonNegativeFloat = 1.0
    """While learning; 1 is none where it takes a second prediction."""
    logit_mean: float = 0.0
    logit_deviation: PositiveFloat = 1.0
    """Of the times that it learns at, logit-normal (Esser et al. 2024), before the shift for the resolution."""
    flip: bool = True
    """Whether every sample is also seen mirrored."""
    crops: Annotated[int, Field(ge=0)] = 0
    """How many different crops of each sample are learnt beside the whole."""
    reflections: Literal["given", "difference"] = "given"
    """Pairs without a reflection are refused where R is a panel, or R is what photo - transmission leaves in light."""
    prompt: str = "paper"
    """A prompt by name, which the backbone's own text encoder encodes, or an encoded one: a .safetensors file,
    relative to the recipe."""

    @property
    def layout(self) -> PanelLayout:
        """How the panels stand."""
        return PanelLayout(self.panels, self.direction)

    @property
    def task(self) -> DecompositionTask:
        """What is learnt, as those need it who use it: they are guided as in the paper, or as it was learnt in one step."""
        guidance = GUIDANCE if self.objective == "flow" else self.guidance
        return DecompositionTask(self.layout, self.budget_px, self.objective, guidance)

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        rendered = self.data.rendered
        if self.data.photos or self.data.maps or (rendered and rendered.recipe):
            raise ValueError(
                "a large backbone learns from rendered sets and pairs; photos, maps and live scenes give squares"
            )
        if "T" not in self.panels or len(set(self.panels)) < len(self.panels):
            raise ValueError(f"the panels are {list(self.panels)}: each once, and T among them")
        if self.quantise and self.backbone.startswith(TINY):
            raise ValueError("a toy twin is never quantised")
        if self.prompt not in PROMPTS and not self.prompt.endswith(ENCODED_SUFFIX):
            raise ValueError(
                f"prompt is {self.prompt!r}: one of {', '.join(PROMPTS)}, or a {ENCODED_SUFFIX} file"
            )
        if not any(self.panel_weights.get(panel, 1) for panel in self.panels):
            raise ValueError("panel_weights leaves nothing to learn: every panel counts 0")
        return self


AnyRecipe = TypeVar("AnyRecipe", bound=TrainingRecipe)


def _share_of(samples: int, name: str, share: float) -> int:
    """The share's number of samples; a share between 0 and 1 must leave some on both sides."""
    part = round(samples * share)
    if samples and 0 < share < 1 and part in (0, samples):
        raise ValueError(f"{name} = {share:g} gives {part} of {samples} samples, not some of them")
    return part


def read_recipe(path: Path) -> CompactRecipe | LoraRecipe:
    """Reads and checks a recipe; one that names a backbone is a large one's.

    Raises:
        RecipeError: missing, not TOML, or with values that are missing, unknown or impossible.
    """
    recipe = read_toml(_recipe_class(path), path, compare=_COMPARE)
    changes: dict[str, Any] = {}
    if isinstance(recipe, CompactRecipe):
        changes["start_from"] = tuple(path.parent / start for start in recipe.start_from)
    if isinstance(recipe, LoraRecipe) and recipe.prompt.endswith(ENCODED_SUFFIX):
        changes["prompt"] = str(path.parent / recipe.prompt)
    rendered = recipe.data.rendered
    if rendered and rendered.recipe and rendered.recipe.endswith(".toml"):
        found = rendered.model_copy(update={"recipe": str(path.parent.resolve() / rendered.recipe)})
        changes["data"] = recipe.data.model_copy(update={"rendered": found})
    return recipe.model_copy(update=changes)


def _recipe_class(path: Path) -> type[CompactRecipe] | type[LoraRecipe]:
    with suppress(OSError, ValueError):  # which read_toml tells
        if "backbone" in tomllib.loads(path.read_text("utf-8")):
            return LoraRecipe
    return CompactRecipe


def with_value(recipe: AnyRecipe, key_path: str, value: object) -> AnyRecipe:
    """The recipe with one value changed, named as in `data.rendered.mixing`, and checked again as a whole.

    Raises:
        RecipeError: the recipe has no place of this name, or the value is impossible there.
    """
    known = list(_key_paths(recipe))
    if key_path not in known:
        close = get_close_matches(key_path, known, n=1)
        raise RecipeError(
            f"the recipe has no {key_path}",
            "the name of a value, with the names of its tables and dots before it, such as data.pairs_share",
            f"did you mean {close[0]}?" if close else "look for it in the recipe",
        )
    table = target = recipe.model_dump(exclude_unset=True)
    *tables, last = key_path.split(".")
    for name in tables:
        target = target.setdefault(name, {})
    target[last] = value
    try:
        return type(recipe).model_validate(table)
    except ValidationError as error:
        raise validation_error(f"the recipe with {key_path} = {value!r}", error, _COMPARE) from error


def _key_paths(values: FrozenModel, before: str = "") -> Iterator[str]:
    for name in type(values).model_fields:
        yield before + name
        inside = getattr(values, name)
        if isinstance(inside, FrozenModel):
            yield from _key_paths(inside, f"{before}{name}.")


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
