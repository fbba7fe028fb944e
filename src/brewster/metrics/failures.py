"""Failure metrics for rendered samples: how much content a prediction removes, and how much
reflection remains in it.

They need a sample whose photo I, background B and reflection R have the same exposure and tone
curve. All values are luminance in linear light, with I = T + R, where the transmission T is the
part of B that passes through the glass.

Some methods restore the light that the glass absorbs, and others do not. To score both in the same
way, the prediction is first multiplied by one gain: the median of B / prediction over the pixels
without reflection that are neither black nor clipped in either image. If B has too few such pixels,
the scores are undefined (ValueError). If only the prediction has too few such pixels, the gain is
1.

Each score is a fraction of light in 0..1; lower is better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.metrics.windows import MIN_COUNT, Image, Region, check_count, check_images
from brewster.photo.srgb import REC709_LUMINANCE, to_linear

if TYPE_CHECKING:
    from jaxtyping import Float

    Light = Float[NDArray[np.float64], "h w"]
else:
    Light = NDArray

NEGLIGIBLE_FRACTION: Final = 0.02
"""A pixel with R below this fraction of I is a pixel without reflection."""

NOTICEABLE_FRACTION: Final = 0.1
"""A pixel with R of at least this fraction of I is a pixel with reflection."""

MIN_WHITE: Final = 0.75
MAX_WHITE_DIFFERENCE: Final = 0.12
"""A pixel is white if its encoded channels, in 0..1, are above MIN_WHITE and differ by less than
MAX_WHITE_DIFFERENCE."""

BLACK_LUMINANCE: Final = 0.01
"""Pixels below this luminance are excluded from the gain, because 8-bit steps are too coarse for a
ratio.
"""

MIN_CLIPPED: Final = 254
"""A channel with at least this 8-bit value may be clipped, so its true value is unknown."""

_LINEAR: Final = to_linear(np.arange(256) / 255)


def removed_content(prediction: Image, background: Image, photo: Image, reflection: Image) -> float:
    """Returns the fraction of the background's light that the prediction lacks where there is no
    reflection.

    The score is sum max(B - g prediction, 0) / sum B over the pixels with R < 2 % of I and B > 0.
    The module docstring defines the gain g.

    Args:
        prediction: the predicted transmission, uint8 sRGB (H, W, 3).
        background: the ground truth without glass (B), uint8 sRGB (H, W, 3).
        photo: the photo (I), uint8 sRGB (H, W, 3).
        reflection: the ground truth of the reflection (R), uint8 sRGB (H, W, 3).

    Raises:
        ValueError: the images are not uint8 (H, W, 3) or differ in shape, or the score or the gain
            has fewer than 64 valid pixels.
    """
    luminance = _Luminances.of(prediction, background, photo, reflection)
    return luminance.removed_fraction(luminance.unreflected, f"R < {NEGLIGIBLE_FRACTION:.0%} of I")


def removed_white(prediction: Image, background: Image, photo: Image, reflection: Image) -> float:
    """Returns the fraction of the background's light that the prediction lacks in white areas
    without reflection.

    The formula is that of `removed_content`, over the pixels that are also white in B: every
    encoded channel is above 0.75, and the largest is less than 0.12 above the smallest. The score
    is high if a method removes white objects because it mistakes them for reflections.

    Args:
        prediction: the predicted transmission, uint8 sRGB (H, W, 3).
        background: the ground truth without glass (B), uint8 sRGB (H, W, 3).
        photo: the photo (I), uint8 sRGB (H, W, 3).
        reflection: the ground truth of the reflection (R), uint8 sRGB (H, W, 3).

    Raises:
        ValueError: as `removed_content`.
    """
    luminance = _Luminances.of(prediction, background, photo, reflection)
    condition = f"R < {NEGLIGIBLE_FRACTION:.0%} of I and white in B"
    darkest = background.min(axis=2)
    brightest = background.max(axis=2)
    is_white = (darkest > MIN_WHITE * 255) & (brightest - darkest < MAX_WHITE_DIFFERENCE * 255)
    return luminance.removed_fraction(luminance.unreflected & is_white, condition)


def kept_reflection(prediction: Image, background: Image, photo: Image, reflection: Image) -> float:
    """Returns the fraction of the reflection's light that the prediction still contains.

    The score is sum min(max(g prediction - B, 0), R) / sum R over the pixels with R >= 10 % of I
    and I not clipped. The module docstring defines the gain g.

    Args:
        prediction: the predicted transmission, uint8 sRGB (H, W, 3).
        background: the ground truth without glass (B), uint8 sRGB (H, W, 3).
        photo: the photo (I), uint8 sRGB (H, W, 3).
        reflection: the ground truth of the reflection (R), uint8 sRGB (H, W, 3).

    Raises:
        ValueError: as `removed_content`.
    """
    light = _Luminances.of(prediction, background, photo, reflection)
    is_noticeable = light.reflection >= NOTICEABLE_FRACTION * light.photo
    reflective = is_noticeable & (light.reflection > 0) & ~_is_clipped(photo)
    remaining = np.clip(light.prediction - light.background, 0, light.reflection)
    condition = f"R >= {NOTICEABLE_FRACTION:.0%} of I and I not clipped"
    return _fraction(remaining, light.reflection, reflective, condition)


@final
@dataclass(frozen=True, eq=False)
class _Luminances:
    """The linear luminances of the four images, (H, W) each. That of the prediction is multiplied
    by the gain.
    """

    prediction: Light
    background: Light
    photo: Light
    reflection: Light
    unreflected: Region
    """Pixels without reflection."""

    @classmethod
    def of(
        cls, prediction: Image, background: Image, photo: Image, reflection: Image
    ) -> _Luminances:
        check_images(prediction, background, photo, reflection)
        luminance = np.array(REC709_LUMINANCE)
        p, b, i, r = (
            _LINEAR[image] @ luminance for image in (prediction, background, photo, reflection)
        )
        unreflected = r < NEGLIGIBLE_FRACTION * i
        comparable_background = unreflected & (b >= BLACK_LUMINANCE) & ~_is_clipped(background)
        condition = (
            f"pixels have R < {NEGLIGIBLE_FRACTION:.0%} of I and B neither black nor clipped"
        )
        check_count(int(comparable_background.sum()), condition)
        comparable = comparable_background & (p >= BLACK_LUMINANCE) & ~_is_clipped(prediction)
        # The median is used, because content that is missing in less than half of the pixels must
        # not change the gain.
        gain = np.median(b[comparable] / p[comparable]) if comparable.sum() >= MIN_COUNT else 1.0
        return cls(p * float(gain), b, i, r, unreflected)

    def removed_fraction(self, mask: Region, condition: str) -> float:
        missing = np.maximum(self.background - self.prediction, 0)
        return _fraction(missing, self.background, mask & (self.background > 0), condition)


def _fraction(part: Light, whole: Light, mask: Region, condition: str) -> float:
    check_count(int(mask.sum()), f"pixels have {condition}")
    return float(part[mask].sum() / whole[mask].sum())


def _is_clipped(image: Image) -> Region:
    clipped: Region = image.max(axis=2) >= MIN_CLIPPED
    return clipped
