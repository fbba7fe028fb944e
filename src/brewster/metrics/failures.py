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
    LightOfPixels = Float[NDArray[np.float64], " pixels"]
else:
    Light = LightOfPixels = NDArray

NEGLIGIBLE_SHARE: Final = 0.02
"""Of I: a reflection below this share is none."""

NOTICEABLE_SHARE: Final = 0.1
"""Of I: a reflection from this share on is one."""

WHITE_MIN: Final = 0.75
WHITE_MAX_DIFFERENCE: Final = 0.12
"""White is where all encoded channels are above the one and no two are further apart than the other."""

BLACK_LUMINANCE: Final = 0.01
"""Luminance below which an 8-bit value is too coarse to be divided by."""

CLIPPED_MIN: Final = 254
"""From this 8-bit value on, a channel may have been brighter than it says."""

MIN_PIXELS: Final = 64

_LINEAR: Final = to_linear(np.arange(256) / 255)


def removed_content(prediction: Picture, background: Picture, photo: Picture, reflection: Picture) -> float:
    """The share of the background's light that the answer lacks where nothing is mirrored, 0..1, lower is better.

    sum max(B - g answer, 0) / sum B, over the pixels with R < 2 % of I; I and B not black everywhere there.

    Raises:
        ValueError: the pictures are not uint8 (H, W, 3) or differ in shape, or less than 64 pixels are such as the
            score is over, or such that the gain could be known.
    """
    luminance = _Luminances.of(prediction, background, photo, reflection)
    return luminance.removed_share(luminance.unreflected, f"R < {NEGLIGIBLE_SHARE:.0%} of I")


def removed_white(prediction: Picture, background: Picture, photo: Picture, reflection: Picture) -> float:
    """The share of light that the answer lacks in white areas behind the glass, 0..1, lower is better.

    As `removed_content`, over those of its pixels that are white in B: every encoded channel above 0.75, and the
    largest less than 0.12 above the smallest. High where white things were taken for highlights.

    Raises:
        ValueError: as `removed_content`.
    """
    luminance = _Luminances.of(prediction, background, photo, reflection)
    return luminance.removed_share(
        luminance.unreflected & _is_white(background), f"R < {NEGLIGIBLE_SHARE:.0%} of I and white in B"
    )


def kept_reflection(prediction: Picture, background: Picture, photo: Picture, reflection: Picture) -> float:
    """The share of the reflection's light that the answer still has, 0..1, lower is better.

    sum min(max(g answer - B, 0), R) / sum R, over the pixels with R >= 10 % of I where I is not clipped.

    Raises:
        ValueError: as `removed_content`.
    """
    luminance = _Luminances.of(prediction, background, photo, reflection)
    reflective = (
        (luminance.reflection >= NOTICEABLE_SHARE * luminance.photo)
        & (luminance.reflection > 0)
        & ~_is_clipped(photo)
    )
    remaining = np.clip(luminance.prediction - luminance.background, 0, luminance.reflection)
    return _share(
        remaining, luminance.reflection, reflective, f"R >= {NOTICEABLE_SHARE:.0%} of I and I not clipped"
    )


@final
@dataclass(frozen=True, eq=False)
class _Luminances:
    """The luminances of four pictures, (H, W); the answer's after its gain."""

    prediction: Light
    background: Light
    photo: Light
    reflection: Light
    unreflected: Region
    """Where nothing is mirrored."""

    @classmethod
    def of(cls, prediction: Picture, background: Picture, photo: Picture, reflection: Picture) -> _Luminances:
        check_pictures(prediction, background, photo, reflection)
        t, b, i, r = map(_luminance, (prediction, background, photo, reflection))
        unreflected = r < NEGLIGIBLE_SHARE * i
        comparable_background = unreflected & (b >= BLACK_LUMINANCE) & ~_is_clipped(background)
        _require_pixels(
            comparable_background, f"R < {NEGLIGIBLE_SHARE:.0%} of I and B neither black nor clipped"
        )
        comparable = comparable_background & (t >= BLACK_LUMINANCE) & ~_is_clipped(prediction)
        return cls(t * _gain(t[comparable], b[comparable]), b, i, r, unreflected)

    def removed_share(self, mask: Region, condition: str) -> float:
        missing = np.maximum(self.background - self.prediction, 0)
        return _share(missing, self.background, mask & (self.background > 0), condition)


def _gain(prediction: LightOfPixels, background: LightOfPixels) -> float:
    return float(np.median(background / prediction)) if prediction.size >= MIN_PIXELS else 1.0


def _share(part: Light, whole: Light, mask: Region, condition: str) -> float:
    _require_pixels(mask, condition)
    return float(part[mask].sum() / whole[mask].sum())


def _require_pixels(mask: Region, condition: str) -> None:
    if (count := np.count_nonzero(mask)) < MIN_PIXELS:
        raise ValueError(f"{count} pixels have {condition}; a score needs {MIN_PIXELS}")


def _luminance(picture: Picture) -> Light:
    luminance: Light = _LINEAR[picture] @ np.array(REC709_LUMINANCE)
    return luminance


def _is_clipped(picture: Picture) -> Region:
    clipped: Region = picture.max(axis=2) >= CLIPPED_MIN
    return clipped


def _is_white(picture: Picture) -> Region:
    darkest, brightest = picture.min(axis=2), picture.max(axis=2)
    bright: Region = darkest > WHITE_MIN * 255
    grey: Region = brightest - darkest < WHITE_MAX_DIFFERENCE * 255
    return bright & grey
