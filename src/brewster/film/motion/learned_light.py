"""Moves smooth light between both layers by what a network sees in them.

The motion shows the brightness of large areas weakly (smooth_light.py). Both measured layers,
however, have their own detail, and a network that knows photos sees which of them has too much or
too little light for it: `brewster.separation.models.film_light`.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np

from brewster.film.motion.model.joint_model import Floats, JointModel
from brewster.separation.models.zoo import FILM_LIGHT

if TYPE_CHECKING:
    from brewster.separation.onnx_backend import OnnxFunction

LIGHT_PX: Final = 160
"""The long side of the layers that the network was trained on."""
_STRIDE_PX: Final = 32
_SHARE: Final = 0.6
"""The share of the predicted light that moves: more gains more in the median, and makes more films
worse (dev/notes/burst.md).
"""
_SMOOTHING_PX: Final = 3
_FLIPS: Final = (np.s_[:, :], np.s_[:, ::-1], np.s_[::-1, :])


def find_light(layers: Floats, frame: Floats, prior: Floats) -> Floats:
    """Returns the smooth light that the network moves from R to T, (h, w, 3). Raises ModelError if
    the shipped network is damaged.

    Args:
        layers: measured T and R of the reference frame, (2, h, w, 3) linear light, of LIGHT_PX.
        frame: the reference frame, (h, w, 3).
        prior: its T by the single photo, (h, w, 3).
    """
    function = _network()
    height, width = frame.shape[:2]
    margins = [(-side % _STRIDE_PX // 2, -(-(-side % _STRIDE_PX) // 2)) for side in (height, width)]
    images = [
        np.pad(image.clip(0, 1), [*margins, (0, 0)], mode="edge")
        for image in (*layers, frame, prior)
    ]
    total = np.zeros((1, 1, 3), np.float32)
    for flip in _FLIPS:
        transmission, reflection, photo, predicted = (image[flip] for image in images)
        cells = function(
            transmission=transmission, reflection=reflection, photo=photo, prior=predicted
        )
        total = total + cells[flip]
    moved = cv2.resize(
        total * (_SHARE / len(_FLIPS)), images[0].shape[1::-1], interpolation=cv2.INTER_LINEAR
    )
    (top, _), (left, _) = margins
    inner = moved[top : top + height, left : left + width]
    smooth: Floats = cv2.GaussianBlur(inner, (0, 0), _SMOOTHING_PX)
    return smooth


def with_light(model: JointModel, moved: Floats) -> JointModel:
    """Returns a model of two layers with light moved from R to T, as far as no layer becomes
    negative.

    Args:
        model: one candidate with two layers.
        moved: the light (h, w, 3), in the reference frame, of any size.
    """
    return model.with_light_moved(-model.on_canvas(moved))


@functools.cache
def _network() -> OnnxFunction:
    from brewster.separation.onnx_backend import OnnxFunction  # noqa: PLC0415  (ONNX Runtime)

    FILM_LIGHT.verify()
    return OnnxFunction(FILM_LIGHT.path)
