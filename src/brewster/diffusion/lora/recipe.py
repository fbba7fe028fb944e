"""The training recipe of a LoRA: the settings of one run, read from TOML into a frozen model. It
imports no torch.
"""

from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, Self

from pydantic import Field, WithJsonSchema, model_validator

from brewster.base.settings import NonNegativeFloat, PositiveInt, Share
from brewster.diffusion.model_table import TINY_PREFIX
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
from brewster.options import Quantization
from brewster.training.recipe import TrainingRecipe

ENCODED_SUFFIX: Final = ".safetensors"
"""The file name suffix of an encoded prompt."""


class LoraRecipe(TrainingRecipe):
    """A training run of a LoRA on a diffusion backbone. The defaults are values of the paper, or
    common values where the paper states none.

    Each sample of a batch is a real pair with the probability `data.pairs_share`, and otherwise a
    sample of a rendered dataset. Samples are not cropped. Mixtures are not supported.
    """

    trainer: ClassVar[str] = "brewster.diffusion.lora.trainer:LoraTrainer"
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

    def resolved(self, folder: Path) -> Self:
        """See `TrainingRecipe.resolved`: the path of the prompt, unless it is the name of one."""
        if not self.prompt.endswith(ENCODED_SUFFIX):
            return self
        return self.model_copy(update={"prompt": str(folder / self.prompt)})

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
