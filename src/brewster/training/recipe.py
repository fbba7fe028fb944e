"""Training recipes: the settings of one training run, read from TOML into frozen models.

Data paths in a recipe are relative to the folder in the environment variable BREWSTER_DATA. This
module imports no torch, so that `brewster train --show-recipe` does not need it.
"""

import math
import os
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeVar

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
from brewster.diffusion.prompt import PROMPTS
from brewster.diffusion.task import (
    GUIDANCE,
    PAPER_COMPOSITE_PIXELS,
    STEPS,
    DecompositionTask,
    Direction,
    Objective,
    Panel,
    PanelLayout,
)
from brewster.errors import RecipeError
from brewster.options import Quantization
from brewster.separation.models.networks import DEFAULT_NETWORK, MAX_STRIDE, NETWORKS
from brewster.separation.models.zoo import TINY_PREFIX
from brewster.training.data.data_recipe import DataRecipe, MixRecipe

_REFERENCE: Final = "docs/recipes.md"

_TEMPLATE_FOLDER: Final = Path(__file__).parent / "recipes"
TEMPLATES: Final = tuple(sorted(path.stem for path in _TEMPLATE_FOLDER.glob("*.toml")))
"""The names of the packaged recipes, starting points for new recipes: one for the compact network,
one for a LoRA.
"""

ENCODED_SUFFIX: Final = ".safetensors"
"""The file name suffix of an encoded prompt."""


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


class TrainingRecipe(FrozenModel):
    """The settings of every training run."""

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


class CompactRecipe(TrainingRecipe):
    """A training run of a compact network."""

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


class LoraRecipe(TrainingRecipe):
    """A training run of a LoRA on a diffusion backbone. The defaults are values of the paper, or
    common values where the paper states none.

    Each sample of a batch is a real pair with the probability `data.pairs_share`, and otherwise a
    sample of a rendered dataset. Samples are not cropped. Mixtures are not supported.
    """

    backbone: str
    """A name in the table of backbones, an id on the Hugging Face hub, a folder, or "tiny:NAME" for
    a tiny version with random weights.
    """
    rank: PositiveInt = 16
    """Rank of the LoRA matrices."""
    alpha: PositiveInt = 16
    """Scale of the LoRA: the product of its matrices is multiplied by alpha / rank."""
    target_modules: tuple[str, ...] = ()
    """Names of the linear layers that get LoRA matrices, such as "*.attn.*". * and ? are wildcards
    as in a shell. Empty: all linear layers of the blocks.
    """
    learning_rate_decay_share: Share = 0.0
    """Share of the steps, at the end of the run, in which the learning rate falls to zero along a
    cosine. Between warm-up and decay, it is constant.
    """
    quantization: Quantization | None = None
    """Quantization of the frozen backbone. Not set: no quantization."""
    panels: tuple[Panel, ...] = ("I", "T", "R")
    """The images that the model generates in one composite image: photo I, transmission T
    (required), reflection R.
    """
    direction: Direction = "side by side"
    """Arrangement of the panels in the composite image."""
    white_space: bool = True
    """Whether the conditioning image has white space for the panels T and R. false: the
    conditioning image is the photo alone, which has 1/3 of the tokens of a composite of three
    panels. According to SIRR-LMM (Guo et al., arXiv 2601.07209), white space is not necessary but
    makes training easier.
    """
    max_composite_pixels: PositiveInt = PAPER_COMPOSITE_PIXELS
    """Largest number of pixels of all panels together."""
    panel_weights: Annotated[
        dict[Panel, NonNegativeFloat],
        WithJsonSchema({"type": 'table of "I", "T" and "R" = weight of at least 0'}),
    ] = Field(default={})
    """Weight of each panel in the loss; 1 for panels that are not listed."""
    objective: Objective = "flow"
    """flow: flow matching, from noise to panels in many steps. one_step: from the photo to the
    panels in one step.
    """
    guidance: NonNegativeFloat = 1.0
    """Guidance scale during training. For backbones with classifier-free guidance, 1 means no
    guidance.
    """
    inference_guidance: NonNegativeFloat = GUIDANCE
    """Guidance scale of validation and separation, stored with the LoRA. It does not change
    one_step.
    """
    inference_steps: PositiveInt = STEPS
    """Number of sampling steps of validation and separation, stored with the LoRA. Objective
    one_step: 1 step.
    """
    flip: bool = True
    """Whether samples are mirrored (left and right exchanged) with a probability of 0.5."""
    reflections: Literal["given", "difference"] = "given"
    """R of real pairs. given: from the reflection image of the pair; every pair must have one if R
    is a panel. difference: pairs without one get R = I - T in linear light, and the panel R has a
    weight of 0.3 in their loss.
    """
    prompt: str = "paper"
    """The name of a prompt, which the text encoder of the backbone encodes, or a .safetensors file
    with an encoded prompt, relative to this recipe.
    """

    @property
    def layout(self) -> PanelLayout:
        """The arrangement of the panels."""
        return PanelLayout(self.panels, self.direction, self.white_space)

    @property
    def task(self) -> DecompositionTask:
        """The task of the trained LoRA. Its guidance is `inference_guidance`, or `guidance` for
        one_step.
        """
        guidance = self.inference_guidance if self.objective == "flow" else self.guidance
        return DecompositionTask(
            self.layout,
            self.max_composite_pixels,
            self.objective,
            guidance,
            steps=self.inference_steps,
        )

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        if self.data.photos or self.data.maps:
            raise ValueError(
                "expected only rendered datasets and pairs, because LoRA training supports no "
                "other data:"
                " remove photos and maps"
            )
        if "T" not in self.panels or len(set(self.panels)) < len(self.panels):
            raise ValueError(
                f"expected panels with T, each at most once, but panels is {list(self.panels)}"
            )
        if self.quantization and self.backbone.startswith(TINY_PREFIX):
            raise ValueError(
                "expected no quantization: a tiny backbone (tiny:) cannot be quantized"
            )
        if self.prompt not in PROMPTS and not self.prompt.endswith(ENCODED_SUFFIX):
            raise ValueError(
                f"expected one of the prompts {', '.join(PROMPTS)}, or a {ENCODED_SUFFIX} file,"
                f" but prompt is {self.prompt!r}"
            )
        if not any(self.panel_weights.get(panel, 1) for panel in self.panels):
            raise ValueError(
                "expected a weight above 0 for at least one panel, but all panel_weights are 0"
            )
        return self


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


def read_recipe(path: Path) -> CompactRecipe | LoraRecipe:
    """Reads a LoraRecipe, if the file has the key `backbone`, or a CompactRecipe; resolves paths
    relative to the file.

    Raises RecipeError if the file is missing or not TOML, a key is missing or unknown, or a value
    is not allowed.
    """
    recipe = _read_unresolved(path)
    changes: dict[str, Any] = {}
    if isinstance(recipe, CompactRecipe) and recipe.init and recipe.init.endswith(".onnx"):
        changes["init"] = str(path.parent.resolve() / recipe.init)
    if isinstance(recipe, LoraRecipe) and recipe.prompt.endswith(ENCODED_SUFFIX):
        changes["prompt"] = str(path.parent.resolve() / recipe.prompt)
    return recipe.model_copy(update=changes)


def read_template(name: str) -> CompactRecipe | LoraRecipe:
    """Reads a packaged recipe (a name of TEMPLATES) or a file; relative paths are not resolved."""
    return _read_unresolved(packaged_file(name, _TEMPLATE_FOLDER))


def _read_unresolved(path: Path) -> CompactRecipe | LoraRecipe:
    recipe_class: type[CompactRecipe] | type[LoraRecipe] = CompactRecipe
    with suppress(OSError, ValueError):  # read_toml raises an error for such a file
        if "backbone" in tomllib.loads(path.read_text("utf-8")):
            recipe_class = LoraRecipe
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
