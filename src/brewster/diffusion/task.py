"""The task of a diffusion backbone: the panels (I, T and R) of the image, their size, and the
sampling method.

Images are sRGB-encoded tensors (N, 3, H, W) in [-1, 1], the input range of the VAEs. The paper
SIRR-LMM (Guo et al., arXiv 2601.07209) describes two layouts: [I:T:R] from a condition with white
space (section "Text-to-image Model Fine-tuning"), and [T:R] with the photo alone as control image
("Experimental Setup"). So the panels are a setting.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Final, Literal, final, get_args

from pydantic import Field

from brewster.errors import PhotoError, RecipeError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

Panel = Literal["I", "T", "R"]
Direction = Literal["side by side", "stacked"]

WHITE: Final = 1.0
"""The value of white space in the conditioning image, before VAE encoding."""


@final
@dataclass(frozen=True)
class PanelLayout:
    """The panels of the composite in their order, and the direction in which they are concatenated.

    `white_space` is whether the conditioning image has the size of the composite, with white space
    for the panels that are to be generated. Otherwise it is the photo alone. Raises RecipeError for
    no, unknown or repeated panels.
    """

    panels: tuple[Panel, ...] = ("I", "T", "R")
    direction: Direction = "side by side"
    white_space: bool = True

    def __post_init__(self) -> None:
        known = set(get_args(Panel))
        if (
            not self.panels
            or len(set(self.panels)) < len(self.panels)
            or not set(self.panels) <= known
        ):
            raise RecipeError(
                f"the panels are {list(self.panels)}",
                "expected one or more of I, T and R, each once",
                'write panels = ["I", "T", "R"] or ["T", "R"]',
            )

    @property
    def has_white_space(self) -> bool:
        """Whether the conditioning image contains white space: it is requested, and I is among the
        generated panels.
        """
        return self.white_space and "I" in self.panels

    @property
    def axis(self) -> int:
        """The tensor axis along which the panels are concatenated."""
        return -1 if self.direction == "side by side" else -2

    def composite_size(self, panel: tuple[int, int]) -> tuple[int, int]:
        """The (width, height) of a composite of panels with this (width, height)."""
        width, height = panel
        count = len(self.panels)
        return (width * count, height) if self.axis == -1 else (width, height * count)


def compose(panels: Mapping[str, Tensor], layout: PanelLayout) -> Float[Tensor, "n 3 h w"]:
    """Concatenates the panels of the layout, which have equal shapes, into one image; other panels
    are ignored.
    """
    import torch  # noqa: PLC0415 - recipes are read without torch

    return torch.cat([panels[name] for name in layout.panels], dim=layout.axis)


def split(composite: Float[Tensor, "n c h w"], layout: PanelLayout) -> dict[str, Tensor]:
    """Splits a composite, or its latents, into its panels by name: the exact inverse of
    `compose`.
    """
    return dict(
        zip(layout.panels, composite.chunk(len(layout.panels), dim=layout.axis), strict=True)
    )


def conditioning_image(photo: Float[Tensor, "n 3 h w"], layout: PanelLayout) -> Tensor:
    """The conditioning image, (N, 3, H, W): the photo in panel I, and white space in the other
    panels.

    White space turns the task into inpainting, which "is not necessary, but it turns out easier to
    converge". Without it, the photo alone is the conditioning image, with 1/3 of the tokens of
    three panels.
    """
    if not layout.has_white_space:
        return photo
    white = photo.new_full(photo.shape, WHITE)
    return compose({name: photo if name == "I" else white for name in layout.panels}, layout)


@final
@dataclass(frozen=True)
class PanelFit:
    """The sizes for a photo in a panel, (width, height) in pixels: it is reduced to `content`, then
    padded to `panel`.

    The content has the photo's aspect ratio to the nearest pixel. The padding is on the right or at
    the bottom, and is at most half a `size_divisor` of `fit_panel`. It is a mirrored copy of the
    content, and is cropped later.
    """

    content: tuple[int, int]
    panel: tuple[int, int]

    def pad(self, content: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c H W"]:
        """Pads an image of the content's size to the panel's size with a mirrored copy of its
        border.
        """
        right, below = (
            panel - content for panel, content in zip(self.panel, self.content, strict=True)
        )
        if not right and not below:
            return content
        from torch.nn import functional  # noqa: PLC0415 - recipes are read without torch

        return functional.pad(content, (0, right, 0, below), mode="reflect")

    def crop(self, panel: Float[Tensor, "n c H W"]) -> Float[Tensor, "n c h w"]:
        """Crops a panel to its content: the exact inverse of `pad`."""
        width, height = self.content
        return panel[..., :height, :width]


def fit_panel(
    size: tuple[int, int], layout: PanelLayout, *, max_composite_pixels: int, size_divisor: int
) -> PanelFit:
    """The largest panel for a photo of this (width, height) whose composite has at most
    `max_composite_pixels` pixels.

    Sides are multiples of `size_divisor`: the short one is the largest that does not enlarge the
    photo, the long one the nearest to its aspect ratio. Raises PhotoError for a too small or too
    extreme photo.
    """
    area = max_composite_pixels // len(layout.panels)
    short, long = sorted(size)
    upper_bound = math.isqrt(area * short // long + 1) + size_divisor
    for short_side in range(upper_bound // size_divisor * size_divisor, 0, -size_divisor):
        long_side = max(
            size_divisor, round(short_side * long / short / size_divisor) * size_divisor
        )
        panel = (short_side, long_side) if size[0] <= size[1] else (long_side, short_side)
        scale = min(panel[0] / size[0], panel[1] / size[1])
        width, height = (
            min(side, round(scale * whole)) for whole, side in zip(size, panel, strict=True)
        )
        if short_side * long_side <= area and width <= size[0] and height <= size[1]:
            return PanelFit((width, height), panel)
    raise PhotoError(
        f"the photo has {size[0]} x {size[1]} pixels",
        f"expected at least {size_divisor} pixels a side, and a less extreme aspect ratio",
        "crop it, or use the compact model",
    )


Objective = Literal["flow", "one_step"]
"""The objectives that brewster trains."""

STEPS: Final = 20
GUIDANCE: Final = 4.0
PAPER_COMPOSITE_PIXELS: Final = 1536 * 512
"""The size of the paper's composite: three panels of 512 x 512 pixels."""


@final
@dataclass(frozen=True)
class DecompositionTask:
    """Which panels to generate, and how. All panels together have at most `max_composite_pixels`
    pixels.

    `objective` is "flow" (from noise, in many steps), "one_step" (from the photo, in one step) or
    "direct" (one prediction at time `time`, without noise and without a conditioning image:
    transmission = photo - prediction, both encoded; Zakarin et al. 2025). A direct task decodes
    each panel separately; its panel I is the encoded photo. `guidance` is used for separation;
    training may use another value. `short_side_px` is the short side of the input, for models that
    were trained with one size; smaller photos are enlarged. With `square_tiles` the input is
    divided into such squares.
    """

    layout: PanelLayout = field(default_factory=PanelLayout)
    max_composite_pixels: int = PAPER_COMPOSITE_PIXELS
    objective: Objective | Literal["direct"] = "flow"
    guidance: float = GUIDANCE
    steps: Annotated[int, Field(ge=1)] = STEPS
    time: Annotated[float, Field(gt=0, le=1)] = 1.0
    short_side_px: Annotated[int, Field(ge=16)] | None = None
    square_tiles: bool = False

    def __post_init__(self) -> None:
        """Raises RecipeError for a task without T, which every separation needs, or for a direct
        task with R.
        """
        if "T" not in self.layout.panels:
            raise RecipeError(
                f"the panels are {list(self.layout.panels)}",
                "expected a list with T",
                "add T to the panels",
            )
        if self.objective == "direct" and "R" in self.layout.panels:
            raise RecipeError(
                f"the panels of a direct task are {list(self.layout.panels)}",
                "expected T, or I and T, because it generates no reflection",
                "remove R from the panels",
            )

    def input_size(self, size: tuple[int, int], size_divisor: int) -> tuple[int, int]:
        """The (width, height) of the copy of a photo that is the input, never larger. Raises
        PhotoError.
        """
        if self.short_side_px is None:
            return self.fit(size, size_divisor).content
        scale = min(1.0, self.short_side_px / min(size))
        return round(scale * size[0]), round(scale * size[1])

    def fit(self, size: tuple[int, int], size_divisor: int) -> PanelFit:
        """The largest panel within the budget for a photo of this (width, height), see
        `fit_panel`.
        """
        budget = self.max_composite_pixels
        return fit_panel(size, self.layout, max_composite_pixels=budget, size_divisor=size_divisor)


def windowseat_task(side_px: int = 768) -> DecompositionTask:
    """The task of a WindowSeat with this processing resolution, as in its published inference code:
    time 0.499, latents minus prediction, square tiles, no guidance.
    """
    # Panel I is the encoded photo, decoded again. It separates the errors of the VAE from the
    # change by the model.
    return DecompositionTask(
        PanelLayout(("I", "T")),
        max_composite_pixels=2 * side_px**2,
        objective="direct",
        guidance=1.0,
        time=0.499,
        short_side_px=side_px,
        square_tiles=True,
    )


def named_task(model: str) -> DecompositionTask:
    """The task of a registered model: a published one, or a backbone, which generates panel T."""
    return windowseat_task() if model == "windowseat" else DecompositionTask(PanelLayout(("T",)))
