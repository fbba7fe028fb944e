"""Harm to bright light of photos with a ground truth:
lamps and skies turn grey, whites turn dark or coloured.

The pixels are those that are bright in the photo *and* in the ground truth, so a removed reflection
costs nothing.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from brewster.metrics.windows import Image, check_count, check_images

MIN_CLIPPED: Final = 250
MAX_LOST: Final = 240
"""An 8-bit value of a channel is clipped from MIN_CLIPPED, and lost if the prediction is below
MAX_LOST.
"""
MIN_NEAR_WHITE: Final = 200
"""A pixel is near white if all its 8-bit channels are above this value."""


def lost_clipped(prediction: Image, truth: Image, photo: Image) -> float:
    """Returns the share of channel values >= 250 in photo and truth that are below 240 in the
    prediction, 0..1.

    The channels of a pixel are counted apart, because a coloured lamp clips in one or two of them.
    Lower is better.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        photo: the unprocessed photo, of the same shape.

    Raises:
        ValueError: the images are not uint8 (H, W, 3) or differ in shape, or fewer than 64 values
            are clipped.
    """
    check_images(prediction, truth, photo)
    is_clipped = np.minimum(photo, truth) >= MIN_CLIPPED
    check_count(
        int(is_clipped.sum()), f"channel values of photo and truth are at least {MIN_CLIPPED}"
    )
    return float((prediction[is_clipped] < MAX_LOST).mean())


def lost_near_white(prediction: Image, truth: Image, photo: Image) -> float:
    """Returns the mean of truth - prediction over the channels of the near-white pixels, in 8-bit
    levels.

    0 is best, and a negative value is a brighter prediction.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        photo: the unprocessed photo, of the same shape.

    Raises:
        ValueError: the images are not uint8 (H, W, 3) or differ in shape, or fewer than 64 pixels
            are near white.
    """
    return float(_near_white_losses(prediction, truth, photo).mean())


def near_white_cast(prediction: Image, truth: Image, photo: Image) -> float:
    """Returns the colour cast of the near-white pixels, in 8-bit levels: largest - smallest channel
    of the mean loss.

    0 is best.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        photo: the unprocessed photo, of the same shape.

    Raises:
        ValueError: as `lost_near_white`.
    """
    return float(np.ptp(_near_white_losses(prediction, truth, photo)))


def _near_white_losses(prediction: Image, truth: Image, photo: Image) -> NDArray[np.float64]:
    check_images(prediction, truth, photo)
    is_near_white = (np.minimum(photo, truth) > MIN_NEAR_WHITE).all(axis=2)
    check_count(
        int(is_near_white.sum()), f"pixels of both are above {MIN_NEAR_WHITE} in all channels"
    )
    losses: NDArray[np.float64] = np.mean(
        truth[is_near_white].astype(np.int16) - prediction[is_near_white], axis=0
    )
    return losses
