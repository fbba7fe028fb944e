"""Photos of a camera that seems to stand: a quick look, after which the kernels of the motion are
not compiled for them.

The details of T are at the same places in all photos, whatever the glass mirrors. If the camera
moved after all, or the mirrored scene alone did, the features show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from brewster.film.motion.model.joint_model import Floats
from brewster.film.motion.registration.high_pass import root_high_pass
from brewster.film.motion.resizing import resized
from brewster.film.video.choosing import shift_between

_LONG_SIDE_PX: Final = 500
_BLOCKS: Final = 4
"""Rows and columns of the parts of a frame."""
_DETAIL_PX: Final = 2.0
_STILL_PX: Final = 1.0
"""A part of a frame that moved by less is at its place."""
_MIN_STILL: Final = 0.5
"""The least share of the parts that must be."""


def seem_to_stand(frames: Sequence[Floats], reference: int) -> bool:
    """Returns whether most parts of all frames are where they are in the reference frame, by the
    correlation of their phases (Kuglin and Hines 1975).

    Args:
        frames: (h, w, 3) linear light each, 0..1, of one size.
        reference: the index of the reference frame.
    """
    side = min(_LONG_SIDE_PX, max(frames[reference].shape))
    details = [root_high_pass(resized(frame, side), _DETAIL_PX) for frame in frames]
    others = (k for k in range(len(frames)) if k != reference)
    return all(_still_share(details[reference], details[k]) >= _MIN_STILL for k in others)


def _still_share(first: Floats, second: Floats) -> float:
    """Returns the share of the parts of a frame that are at the same place in another one."""
    height, width = (side // _BLOCKS for side in first.shape)
    shifts = []
    for row in range(_BLOCKS):
        for column in range(_BLOCKS):
            part = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
            shifts.append(shift_between(first[part], second[part])[0])
    return float((np.linalg.norm(shifts, axis=1) < _STILL_PX).mean())
