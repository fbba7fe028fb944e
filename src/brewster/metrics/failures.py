"""How badly an answer fails where the truth is known exactly: content that it took away, reflections that it left.

For rendered samples, whose photo I, background B and reflection R share one exposure and tone curve. All is luminance
in linear light, with R in the photo's light: I = T + R, and T is B as far as the glass lets it through. Methods differ
on whether they restore what the glass absorbs, so an answer is first multiplied by the one gain that makes it match B
where nothing is mirrored: the median of B over answer, among pixels that are neither black nor clipped in either.
Where B has too few such pixels, no score has a meaning; an answer that is black or clipped in nearly all of them is
taken as it is.

Each score is a share of light, in 0..1, lower is better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.metrics.windows import Picture, Region, check_pictures
from brewster.srgb import REC709_LUMINANCE, to_linear

if TYPE_CHECKING:
    from jaxtyping import Float

    Light = Float[NDArray[np.float64], "h w"]
else:
    Light = NDArray

NEGLIGIBLE: Final = 0.02
"""Of I: a reflection below this share is none."""

NOTICEABLE: Final = 0.1
"""Of I: a reflection from this share on is one."""

WHITE: Final = 0.75
COLOURLESS: Final = 0.12
"""White is where all encoded channels are above the one and no two are further apart than the other."""

BLACK: Final = 0.01
"""Luminance below which an 8-bit value is too coarse to be divided by."""

CLIPPED: Final = 254
"""From this 8-bit value on, a channel may have been brighter than it says."""

LEAST_PIXELS: Final = 64

_LINEAR: Final = to_linear(np.arange(256) / 255)


def removed_content(answer: Picture, background: Picture, photo: Picture, reflection: Picture) -> float:
    """The share of the background's light that the answer lacks where nothing is mirrored, 0..1, lower is better.

    sum max(B - g answer, 0) / sum B, over the pixels with R < 2 % of I; I and B not black everywhere there.

    Raises:
        ValueError: the pictures are not uint8 (H, W, 3) or differ in shape, or less than 64 pixels are such as the
            score is over, or such that the gain could be known.
    """
    case = _Case.of(answer, background, photo, reflection)
    return case.removed(case.calm, f"R < {NEGLIGIBLE:.0%} of I")


def removed_white(answer: Picture, background: Picture, photo: Picture, reflection: Picture) -> float:
    """The share of light that the answer lacks in white areas behind the glass, 0..1, lower is better.

    As `removed_content`, over those of its pixels that are white in B: every encoded channel above 0.75, and the
    largest less than 0.12 above the smallest. High where white things were taken for highlights.

    Raises:
        ValueError: as `removed_content`.
    """
    case = _Case.of(answer, background, photo, reflection)
    return case.removed(case.calm & _is_white(background), f"R < {NEGLIGIBLE:.0%} of I and white in B")


def kept_reflection(answer: Picture, background: Picture, photo: Picture, reflection: Picture) -> float:
    """The share of the reflection's light that the answer still has, 0..1, lower is better.

    sum min(max(g answer - B, 0), R) / sum R, over the pixels with R >= 10 % of I where I is not clipped.

    Raises:
        ValueError: as `removed_content`.
    """
    case = _Case.of(answer, background, photo, reflection)
    mirrored = (case.reflection >= NOTICEABLE * case.photo) & (case.reflection > 0) & ~_is_clipped(photo)
    kept = np.clip(case.answer - case.background, 0, case.reflection)
    return _share(kept, case.reflection, mirrored, f"R >= {NOTICEABLE:.0%} of I and I not clipped")


@final
@dataclass(frozen=True, eq=False)
class _Case:
    """The luminances of four pictures, (H, W); the answer's after its gain."""

    answer: Light
    background: Light
    photo: Light
    reflection: Light
    calm: Region
    """Where nothing is mirrored."""

    @classmethod
    def of(cls, answer: Picture, background: Picture, photo: Picture, reflection: Picture) -> _Case:
        check_pictures(answer, background, photo, reflection)
        given, behind, whole, mirrored = map(_luminance, (answer, background, photo, reflection))
        calm = mirrored < NEGLIGIBLE * whole
        told = calm & (behind >= BLACK) & ~_is_clipped(background)
        _refuse_few(told, f"R < {NEGLIGIBLE:.0%} of I and B neither black nor clipped")
        comparable = told & (given >= BLACK) & ~_is_clipped(answer)
        return cls(given * _gain(given[comparable], behind[comparable]), behind, whole, mirrored, calm)

    def removed(self, where: Region, condition: str) -> float:
        missing = np.maximum(self.background - self.answer, 0)
        return _share(missing, self.background, where & (self.background > 0), condition)


def _gain(answer: Light, background: Light) -> float:
    return float(np.median(background / answer)) if answer.size >= LEAST_PIXELS else 1.0


def _share(part: Light, whole: Light, where: Region, condition: str) -> float:
    _refuse_few(where, condition)
    return float(part[where].sum() / whole[where].sum())


def _refuse_few(where: Region, condition: str) -> None:
    if (count := np.count_nonzero(where)) < LEAST_PIXELS:
        raise ValueError(f"{count} pixels have {condition}; a score needs {LEAST_PIXELS}")


def _luminance(picture: Picture) -> Light:
    luminance: Light = _LINEAR[picture] @ np.array(REC709_LUMINANCE)
    return luminance


def _is_clipped(picture: Picture) -> Region:
    clipped: Region = picture.max(axis=2) >= CLIPPED
    return clipped


def _is_white(picture: Picture) -> Region:
    least, most = picture.min(axis=2), picture.max(axis=2)
    bright: Region = least > WHITE * 255
    grey: Region = most - least < COLOURLESS * 255
    return bright & grey
