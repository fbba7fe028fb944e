"""Several pictures in one: how panels are laid out, what the model is shown, and how photos of any shape fit.

Pictures are sRGB-encoded tensors (N, 3, H, W) in [-1, 1], as the VAEs want them. The paper contradicts itself:
"Text-to-image Model Fine-tuning" generates [I:T:R] from a condition with white space, "Experimental Setup"
concatenates T and R and takes I as the control image. So the list of panels is a value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, final, get_args

import torch
from torch import Tensor
from torch.nn import functional

from brewster.errors import PhotoError, RecipeError

if TYPE_CHECKING:
    from jaxtyping import Float

Panel = Literal["I", "T", "R"]
Direction = Literal["side by side", "stacked"]

WHITE: Final = 1.0
"""White space in the conditioning picture, before the VAE sees it."""


@final
@dataclass(frozen=True)
class PanelLayout:
    """Which panels stand in the composite, in which order and direction.

    Raises RecipeError for no panel, an unknown or repeated one, or an unknown direction.
    """

    panels: tuple[Panel, ...] = ("I", "T", "R")
    direction: Direction = "side by side"

    def __post_init__(self) -> None:
        known = set(get_args(Panel))
        if not self.panels or len(set(self.panels)) < len(self.panels) or not set(self.panels) <= known:
            raise RecipeError(
                f"the panels are {list(self.panels)}",
                "some of I, T and R, each once",
                'write panels = ["I", "T", "R"] or ["T", "R"]',
            )
        if self.direction not in get_args(Direction):
            raise RecipeError(
                f"the direction is {self.direction!r}",
                " or ".join(map(repr, get_args(Direction))),
                "choose one of them",
            )

    @property
    def axis(self) -> int:
        """The tensor axis along which the panels follow each other."""
        return -1 if self.direction == "side by side" else -2

    def composite_size(self, panel: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the composite whose panels have this (width, height)."""
        width, height = panel
        count = len(self.panels)
        return (width * count, height) if self.axis == -1 else (width, height * count)


def compose(panels: Mapping[str, Tensor], layout: PanelLayout) -> Float[Tensor, "n 3 h w"]:
    """The panels in one picture; what the layout does not name is left out.

    Raises:
        PhotoError: a panel is missing, or they differ in shape.
    """
    missing = [name for name in layout.panels if name not in panels]
    if missing:
        raise PhotoError(
            f"there is no panel {', '.join(missing)} among {', '.join(panels) or 'none'}",
            f"the layout shows {', '.join(layout.panels)}",
            "give them all or change the layout",
        )
    shapes = {name: tuple(panels[name].shape) for name in layout.panels}
    if len(set(shapes.values())) > 1:
        raise PhotoError(
            f"the panels have the shapes {shapes}", "they must be alike", "bring them to one size first"
        )
    return torch.cat([panels[name] for name in layout.panels], dim=layout.axis)


def split(composite: Float[Tensor, "n c h w"], layout: PanelLayout) -> dict[str, Tensor]:
    """The panels of a composite by name: exactly what `compose` put in, to the bit. Works on latents, too.

    Raises:
        PhotoError: the composite does not divide into that many panels.
    """
    length, count = composite.shape[layout.axis], len(layout.panels)
    if length % count:
        raise PhotoError(
            f"a composite of {length} pixels does not divide by {count}",
            f"{count} equal panels {layout.direction}",
            "give the picture that compose made",
        )
    return dict(zip(layout.panels, composite.chunk(count, dim=layout.axis), strict=True))


def conditioning_image(photo: Float[Tensor, "n 3 h w"], layout: PanelLayout) -> Tensor:
    """The picture that the model is shown: I, and white space where the others are to come.

    White space turns the task into inpainting, "which is not necessary, but it turns out easier to converge"
    (Text-to-image Model Fine-tuning). Where I is not generated there is nothing to align it with, and the
    photo is shown alone, as the control image (Experimental Setup): a third of the conditioning tokens.
    """
    if "I" not in layout.panels:
        return photo
    white = torch.full_like(photo, WHITE)
    return compose({name: photo if name == "I" else white for name in layout.panels}, layout)


@final
@dataclass(frozen=True)
class PanelFit:
    """How a photo stands in a panel: shrunk to `content`, padded to `panel`; all are (width, height) in pixels.

    The content keeps the photo's aspect ratio to the nearest pixel. The rest, at most half a multiple on the
    right or below, is the content's own reflection, and is cut away afterwards.
    """

    content: tuple[int, int]
    panel: tuple[int, int]

    def pad(self, content: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c H W"]:
        """A picture of the content's size, padded to the panel's by reflection.

        Raises:
            PhotoError: the picture has another size.
        """
        _check_size(content, self.content)
        right, below = (panel - used for panel, used in zip(self.panel, self.content, strict=True))
        if not right and not below:
            return content
        return functional.pad(content, (0, right, 0, below), mode="reflect")

    def crop(self, panel: Float[Tensor, "n c H W"]) -> Float[Tensor, "n c h w"]:
        """The content of a panel: exactly undoes `pad`.

        Raises:
            PhotoError: the panel has another size.
        """
        _check_size(panel, self.panel)
        width, height = self.content
        return panel[..., :height, :width]


def fit_panel(size: tuple[int, int], layout: PanelLayout, *, budget_px: int, multiple: int) -> PanelFit:
    """The largest panel for a photo of this (width, height) whose composite has at most `budget_px` pixels.

    Both sides are multiples of `multiple`: the short one is tried from above, and the long one is the nearest
    that keeps the photo's aspect ratio, so the two disagree by half a multiple at most and nothing is stretched.

    Raises:
        PhotoError: the photo is smaller than its panel and would have to be enlarged, or so long and thin that
            no panel fits the budget.
    """
    short, long = min(size), max(size)
    if short < 1:
        raise PhotoError(f"the photo has {size[0]} x {size[1]} pixels", "at least one", "check the file")
    area = budget_px // len(layout.panels)
    upper_bound = math.isqrt(area * short // long + 1) + multiple
    for short_side in range(upper_bound // multiple * multiple, 0, -multiple):
        long_side = max(multiple, round(short_side * long / short / multiple) * multiple)
        if short_side * long_side <= area:
            fit = _fit(size, (short_side, long_side) if size[0] <= size[1] else (long_side, short_side))
            _refuse_enlarging(size, fit, layout, multiple)
            return fit
    raise PhotoError(
        f"no panel with the shape of {size[0]} x {size[1]} pixels fits into {area} pixels",
        f"a side of at least {multiple} pixels",
        "crop the photo or raise budget_px",
    )


def _fit(size: tuple[int, int], panel: tuple[int, int]) -> PanelFit:
    """The photo, shrunk as little as lets it stand inside the panel."""
    scale = min(panel[0] / size[0], panel[1] / size[1])
    width, height = (min(side, round(scale * own)) for own, side in zip(size, panel, strict=True))
    return PanelFit((width, height), panel)


def _refuse_enlarging(size: tuple[int, int], fit: PanelFit, layout: PanelLayout, multiple: int) -> None:
    if fit.content[0] <= size[0] and fit.content[1] <= size[1]:
        return
    small = math.prod(side // multiple * multiple for side in size) * len(layout.panels)
    raise PhotoError(
        f"the photo has {size[0]} x {size[1]} pixels",
        f"at least the panel's {fit.content[0]} x {fit.content[1]}",
        f"lower budget_px to {small}" if small else f"use a photo of at least {multiple} pixels a side",
    )


def _check_size(picture: Tensor, size: tuple[int, int]) -> None:
    height, width = picture.shape[-2:]
    if (width, height) != size:
        raise PhotoError(
            f"the picture has {width} x {height} pixels", f"{size[0]} x {size[1]}", "resize it first"
        )
