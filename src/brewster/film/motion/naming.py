"""Tells which of two measured layers is the transmission, and whether they are two scenes.

All images are those of the reference frame, in linear light, at the size of a level (levels.py).
"""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import Floats
from brewster.film.motion.model.kernels import OFFSET

_DETAIL_PX: Final = 9
"""The side of the box whose mean is subtracted to get the detail of an image."""
_MAX_DETAIL: Final = 0.5
_BRIGHTNESS: Final = 0.25
_MAX_BRIGHTNESS: Final = 2.0
"""The limits of the cues that tell T from R."""
_RIDGE: Final = 1e-6
"""Added to the diagonal of the least squares, which have no solution if a layer has no detail."""
_MIN_LIGHT: Final = 1e-4
"""Added to the brightness of the layers, so that a black layer has a finite ratio."""
_MIN_SUM: Final = 1e-3
"""Added to the light of both layers, so that dark places have no reflection."""
_HINTED_SHARE: Final = 0.3
_HINTED_AREA: Final = 0.2
"""Where the measured reflection has more of the light, the model gets a hint, but in no larger
area: its hints were trained on a tenth.
"""


def brightness_cue(layers: Floats) -> float:
    """Returns how much brighter the first of both layers (2, h, w, 3) is: glass reflects 4 to
    15 %.
    """
    brightness = np.log((layers[0].mean() + _MIN_LIGHT) / (layers[1].mean() + _MIN_LIGHT))
    return float(_BRIGHTNESS * np.clip(brightness, -_MAX_BRIGHTNESS, _MAX_BRIGHTNESS))


def detail_cue(layers: Floats, frame: Floats, prior: Floats) -> float:
    """Returns the share of the first layer's detail that the prior keeps, minus that of the second
    layer's.

    Args:
        layers: (2, h, w, 3).
        frame: (h, w, 4), the reference frame.
        prior: (h, w, 4), T of the reference frame from a single photo.
    """
    images = [*layers, prior[..., :3]]
    noise = np.sqrt(frame[..., :3] + OFFSET)  # that of light is proportional to its square root
    details = np.stack([((image - _blurred(image)) / noise).ravel() for image in images])
    details = details.astype(np.float64)
    gram = details @ details.T
    # The prior's detail as a sum of shares of the details of both layers
    transmission, reflection = np.linalg.lstsq(gram[:2, :2] + _RIDGE * np.eye(2), gram[:2, 2])[0]
    return float(np.clip(transmission - reflection, -_MAX_DETAIL, _MAX_DETAIL))


def _blurred(image: Floats) -> Floats:
    """Returns the mean of the image in boxes, at the borders that of the part inside."""
    total = _box_filter(image, normalize=False)
    count = _box_filter(np.ones_like(image), normalize=False)
    blurred: Floats = total / count
    return blurred


def _box_filter(image: Floats, *, normalize: bool) -> Floats:
    """Returns the sum, or the mean, of the image in boxes, with 0 outside of the image."""
    filtered: Floats = cv2.boxFilter(
        image,
        -1,
        (_DETAIL_PX, _DETAIL_PX),
        normalize=normalize,
        borderType=cv2.BORDER_CONSTANT,
    )
    return filtered


def edge_correlation(layers: Floats) -> float:
    """Returns the correlation of the strengths of the edges of two layers (2, h, w, 3), -1..1."""
    grey = np.sqrt(layers.mean(-1) + OFFSET)
    strengths = np.hypot(*np.gradient(grey, axis=(1, 2))).reshape(2, -1)
    if not strengths.std(1).all():  # a layer without edges correlates with nothing
        return 0.0
    return float(np.nan_to_num(np.corrcoef(strengths)[0, 1]))


def hinted_region(share: Floats) -> NDArray[np.bool_]:
    """Returns where the model gets a hint, of the same shape: where the share of R in the light is
    large.

    Args:
        share: the share of R, in 0..1.
    """
    least = max(_HINTED_SHARE, float(np.quantile(share, 1 - _HINTED_AREA)))
    region: NDArray[np.bool_] = share > least
    return region


def reflection_share(layers: Floats) -> Floats:
    """Returns the share of R in the light of both layers (2, h, w, 3), without noise: (h, w, 1) in
    0..1.
    """
    transmission, reflection = (_box_filter(layer.mean(-1), normalize=True) for layer in layers)
    share: Floats = (reflection / (transmission + reflection + _MIN_SUM))[..., None]
    return share
