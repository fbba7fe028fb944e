"""Composes I, T and R as panels of one image, makes the conditioning image, and fits photos into panels.

Images are sRGB-encoded tensors (N, 3, H, W) in [-1, 1], the input range of the VAEs. The paper SIRR-LMM (Guo et al.,
arXiv 2601.07209) describes two layouts. In its section "Text-to-image Model Fine-tuning", the model generates [I:T:R] from
a condition with white space. In its section "Experimental Setup", the model generates T and R, and I is the control image.
Therefore the list of panels is a setting.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, final, get_args

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

    `white_space` is whether the conditioning image has the size of the composite, with white space for the panels that are to
    be generated. Otherwise it is the photo alone. Raises RecipeError if there is no panel, or a panel is unknown or repeated.
    """

    panels: tuple[Panel, ...] = ("I", "T", "R")
    direction: Direction = "side by side"
    white_space: bool = True

    def __post_init__(self) -> None:
        known = set(get_args(Panel))
        if not self.panels or len(set(self.panels)) < len(self.panels) or not set(self.panels) <= known:
            raise RecipeError(
                f"the panels are {list(self.panels)}",
                "expected one or more of I, T and R, each once",
                'write panels = ["I", "T", "R"] or ["T", "R"]',
            )

    @property
    def has_white_space(self) -> bool:
        """Whether the conditioning image contains white space: it is requested, and I is among the generated panels."""
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
    """Concatenates the panels of the layout, which have equal shapes, into one image; other panels are ignored."""
    import torch  # noqa: PLC0415 - recipes are read without torch

    return torch.cat([panels[name] for name in layout.panels], dim=layout.axis)


def split(composite: Float[Tensor, "n c h w"], layout: PanelLayout) -> dict[str, Tensor]:
    """Splits a composite, or its latents, into its panels by name: the exact inverse of `compose`."""
    return dict(zip(layout.panels, composite.chunk(len(layout.panels), dim=layout.axis), strict=True))


def conditioning_image(photo: Float[Tensor, "n 3 h w"], layout: PanelLayout) -> Tensor:
    """The conditioning image, (N, 3, H, W): the photo in panel I, and white space in the other panels.

    White space turns the task into inpainting, which "is not necessary, but it turns out easier to converge"
    (Text-to-image Model Fine-tuning). Without it, the photo alone is the conditioning image (Experimental
    Setup: "control image"), with 1/3 of the tokens of three panels.
    """
    if not layout.has_white_space:
        return photo
    white = photo.new_full(photo.shape, WHITE)
    return compose({name: photo if name == "I" else white for name in layout.panels}, layout)


@final
@dataclass(frozen=True)
class PanelFit:
    """The sizes for a photo in a panel, (width, height) in pixels: it is reduced to `content`, then padded to `panel`.

    The content has the photo's aspect ratio to the nearest pixel. The padding is on the right or at the bottom, and is at
    most half a `size_divisor` of `fit_panel`. It is a mirrored copy of the content ("reflect" mode), and is cropped later.
    """

    content: tuple[int, int]
    panel: tuple[int, int]

    def pad(self, content: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c H W"]:
        """Pads an image of the content's size to the panel's size with a mirrored copy of its border."""
        right, below = (panel - content for panel, content in zip(self.panel, self.content, strict=True))
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
    """The largest panel for a photo of this (width, height) whose composite has at most `max_composite_pixels` pixels.

    Both sides are multiples of `size_divisor`: the short side is the largest that fits without enlarging the
    photo, the long side the nearest to the photo's aspect ratio, and padding fills the difference. Raises
    PhotoError if a side of the photo is below `size_divisor`, or its aspect ratio is too extreme.
    """
    area, (short, long) = max_composite_pixels // len(layout.panels), sorted(size)
    upper_bound = math.isqrt(area * short // long + 1) + size_divisor
    for short_side in range(upper_bound // size_divisor * size_divisor, 0, -size_divisor):
        long_side = max(size_divisor, round(short_side * long / short / size_divisor) * size_divisor)
        panel = (short_side, long_side) if size[0] <= size[1] else (long_side, short_side)
        scale = min(panel[0] / size[0], panel[1] / size[1])
        width, height = (min(side, round(scale * whole)) for whole, side in zip(size, panel, strict=True))
        if short_side * long_side <= area and width <= size[0] and height <= size[1]:
            return PanelFit((width, height), panel)
    raise PhotoError(
        f"the photo has {size[0]} x {size[1]} pixels",
        f"expected at least {size_divisor} pixels a side, and a less extreme aspect ratio",
        "crop it, or use the compact model",
    )
