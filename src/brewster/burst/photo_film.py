"""Separates a photo by the film that a phone recorded around it.

1. The frame of the film that shows the view of the still is found, and its homography
(still_registration.py). 2. The layers of this frame are measured from the motion in the film, as in
a burst (separate.py); the prior is that of the still, which is sharper than a frame. 3. The shares
of both layers in the light of the frame are carried to the still, and applied to it at full size,
as a prediction of a model is. The layers themselves would not fit: the still has another tone, and
is merged from several exposures.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.burst.film import Film, choose, measure_film
from brewster.burst.joint_model import Floats, pixel_grid, project, to_pixels
from brewster.burst.registration import Matrices
from brewster.burst.separate import FittedBurst, burst_report, measure_layers, prior_with_hints
from brewster.burst.solver import Solution
from brewster.burst.still_registration import StillMatch, match_still
from brewster.burst.tracking import linear_light
from brewster.burst.video import decoded, displayed
from brewster.errors import BrewsterError, PhotoError
from brewster.inference.assessment import Assessment
from brewster.inference.burst_report import BurstReport, PhotoFilmReport
from brewster.inference.predictor import ProgressCallback
from brewster.inference.separator import Separator, timed
from brewster.options import DEFAULT_FRAMES, Options
from brewster.photo import Photo, Source
from brewster.photo.file_info import with_notes
from brewster.photo.motion_photo import PhotoFilm

_WORKING_PX: Final = 1000
"""The long side of the still and of the frames from which the motion is estimated."""
_THUMBNAIL_PX: Final = 240
"""The width of the grey copies in which the path of the camera is measured."""
_MAX_FILM_S: Final = 10.0
"""Phones record up to 3 s around a still. A longer film next to a photo has another purpose."""
_MIN_LIGHT: Final = 2e-3
"""Where both measured layers together have less light, their shares are noise."""
_BORDER: Final = 0.02
"""Near the edges of the frame, as a share of its size, its shares fade to those of the still."""
_HINTED_SHARE: Final = 0.3
"""Where the measured reflection has a larger share of the light, the model gets a hint."""
_HINTED_AREA: Final = 0.2
"""The largest hinted share of the photo: the hints of the training covered a tenth."""


@final
@dataclass(frozen=True)
class FilmFrames:
    """The frames of the film of a photo, reduced."""

    pictures: Sequence[NDArray[np.uint8]]
    """The frames, (h, w, 3) sRGB, at most 1,000 px wide and high, in the order of time."""
    measured: Film
    seconds: float
    """The time from the first frame to the last one."""

def carried(solution: Solution, homography: Doubles, still: Floats, prior: Floats) -> Solution:
    """Returns the solution of a frame of the film for the still, which has the same shares of both
    layers in its light.

    Args:
        solution: the layers of the frame, (2, h, w, 3) linear light.
        homography: (3, 3), from the still to the frame, in normalised coordinates.
        still: (H, W, 3) linear light.
        prior: T of the still from the model alone, (H, W, 3).

    Returns:
        The layers at the size (h, w). What the frame does not show is that of the prior.
    """
    size = solution.measured.shape[1:3]
    still, prior = (cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA) for image in (still, prior))
    prior_share = np.clip(prior / np.maximum(still, _MIN_LIGHT), 0, 1)
    frame_share = moved(transmission_share(solution.measured), homography, size)
    known = coverage(homography, size) * moved(_is_lit(solution.measured), homography, size)
    share = prior_share + known * (frame_share - prior_share)
    errors = moved(solution.frame_errors[..., None], homography, size)[..., 0]
    return replace(
        solution,
        measured=np.stack([share * still, (1 - share) * still]),
        predicted=np.stack([prior_share * still, (1 - prior_share) * still]),
        frame_errors=errors,
        model=None,
    )


def transmission_share(layers: Floats) -> Floats:
    """Returns the share of T in the light of both layers (2, h, w, 3): (h, w, 3) in 0..1."""
    share: Floats = layers[0] / np.maximum(layers.sum(0), _MIN_LIGHT)
    return share


def moved(image: Floats, homography: Doubles, size: tuple[int, int]) -> Floats:
    """Returns an image (h, w, C) as another picture of this size shows it, from which the
    homography leads to the image. Outside, the nearest pixel counts.
    """
    x, y = to_pixels(project(homography.ravel()[:8], pixel_grid(*size)), image.shape)
    sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(*size, image.shape[2])


def coverage(homography: Doubles, size: tuple[int, int]) -> Floats:
    """Returns where the frame shows the still, (h, w, 1): 1, with a fade to 0 at its edges."""
    positions = project(homography.ravel()[:8], pixel_grid(*size))
    distance = (1 - np.abs(positions).max(0)) / (2 * _BORDER)
    covered: Floats = np.clip(distance, 0, 1).astype(np.float32)[..., None]
    return covered


def _is_lit(layers: Floats) -> Floats:
    lit: Floats = np.clip(layers.sum(0).mean(-1, keepdims=True) / _MIN_LIGHT, 0, 1)
    return lit
