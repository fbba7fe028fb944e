"""Finds both layers and their motions, from coarse to fine: many candidates on small frames, the
best one on larger frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, final

import cv2
import numpy as np

from brewster.burst.joint_model import (
    Doubles,
    Floats,
    JointModel,
    pixel_grid,
    project,
    with_fourth_channel,
)
from brewster.burst.kernels import OFFSET
from brewster.burst.objects import FINAL_STEPS, OPACITY_STEPS, SEARCH_STEPS, with_objects
from brewster.burst.optimiser import Rates, Weights, optimise
from brewster.burst.registration import MotionCandidate

_FOR_MOTION: Final = Weights(common_edges=0.01, prior=0.02)
"""Two layers with edges at the same places explain too much of any motion."""
_FOR_LAYERS: Final = Weights(common_edges=0.005, prior=0.01)
"""With the motion known, a larger penalty of common edges, or a stronger prior, would shift light
between the layers.
"""


@final
@dataclass(frozen=True)
class Level:
    """A step from coarse to fine."""

    long_side_px: int
    steps: int
    spline_size: tuple[int, int] | None
    """Rows and columns of the splines; None: the motion is a homography."""
    weights: Weights = _FOR_LAYERS
    density: float = 1.0
    """Pixels of the layers per pixel of a frame, along each axis."""
    kept: int = 1
    """How many candidates of each family are kept after this level of the search."""
    every: int = 1
    """See `optimise`."""

    @property
    def step_cost(self) -> int:
        """The time of a step relative to that of others, for the progress. Those of the search have
        several candidates.
        """
        return self.long_side_px * (3 if self.weights is _FOR_MOTION else 1)

    @property
    def rates(self) -> Rates:
        """The learning rates: the motion is slower in larger frames."""
        if not self.spline_size:
            return Rates(splines=0)
        return Rates().scaled(min(1.0, 80 / self.long_side_px))


_MAX_RELATIVE_MOTION: Final = 0.2
"""As a share of the width. With a larger motion, the reflection becomes an offset of each frame,
and explains all but edges.
"""
_MOTION_SAMPLES: Final = (9, 12)
_DETAIL_PX: Final = 9
_MAX_DETAIL: Final = 0.5
_BRIGHTNESS: Final = 0.25
_MAX_BRIGHTNESS: Final = 2.0
"""The cues that tell T from R, see `_naming`."""
_MAX_NAMING_LOSS: Final = 0.1
"""There are no objects if the layers are told apart less clearly with them by more than this: a
part of T became R.
"""
_MAX_ENLARGEMENT: Final = 1.3
"""Levels that would enlarge the frames by more than this factor are left out."""
_DENSITY: Final = 1.5
"""Of the levels that find the motion. With 1, interpolation blurs T differently in each frame, and
a copy of T that is moved by a pixel explains this better than the true reflection explains its
light.
"""
SEARCH: Final = (
    Level(80, 20, None, _FOR_MOTION, _DENSITY, kept=2),
    Level(80, 20, None, _FOR_MOTION, _DENSITY),
    Level(160, 45, (4, 6), _FOR_MOTION, _DENSITY),
)
"""The levels that find the motion, with many candidates."""
LEVELS: Final = (
    Level(160, 110, (4, 6), density=_DENSITY),  # enough steps for the brightness of large areas
    Level(320, 70, (6, 8), every=2),
    Level(640, 35, (8, 12), every=4),
)
"""The levels of the best candidate."""
_ERROR_AT_1_E: Final = 0.05
"""The error of the frames at which the confidence is 1/e."""
_MIN_UNEXPLAINED: Final = 0.02
_UNEXPLAINED_TIMES: Final = 5
"""The smallest error of the frames that neither layer explains: this, and this often the median of
the photo.
"""
_SMOOTHING: Final = 0.025
"""Of these errors, as a share of the long side."""
_MIN_DIFFERENCE: Final = 0.008
"""Two motions are different if they differ by this share of the frame's size."""
_MAX_MOTIONS: Final = 14
MIN_SIDE_PX: Final = math.ceil(LEVELS[0].long_side_px / _MAX_ENLARGEMENT)
"""The smallest long side of frames that have the levels at which candidates are compared and named:
without these, wrong motions win.
"""


@final
@dataclass(frozen=True)
class Solution:
    """Both layers of the reference frame, and how well they explain the burst."""

    measured: Floats
    """T and R by the motion, (2, h, w, 3) linear light."""
    predicted: Floats
    """T and R of the single photo, (2, h, w, 3)."""
    frame_errors: Floats
    """(h, w): the mean errors of the frames, as differences of square roots of light, at each pixel
    of T.
    """
    relative_motion: float
    """The largest motion of R relative to T between two frames, as a share of the width of a frame.
    """
    naming: float
    """How clearly T and R are told apart, at 160 pixels: about 0 if they may have each other's
    names.
    """
    edge_correlation: float
    """The correlation of the strengths of the edges of both layers, at 160 pixels: about 0 for two
    scenes, and more if a wrong motion makes the second layer a copy of the first.
    """
    one_layer_error: float
    """The mean error of the frames if both layers move together: the data term of the loss at 160
    pixels.
    """
    two_layer_error: float
    """The same for the best candidate."""
    model: JointModel | None = None
    """The layers on their canvases and the motions of the frames, in the order in which they were
    solved. Not exchanged by `swapped`.
    """

    @property
    def confidence(self) -> Floats:
        """(h, w, 1) in 0..1: how well the frames agree with their prediction at each pixel of the
        transmission.
        """
        confidence: Floats = np.exp(-self.frame_errors / _ERROR_AT_1_E)[..., None]
        return confidence

    @property
    def unexplained(self) -> Floats:
        """(h, w, 1) in 0..1: where neither layer explains the frames, as at a person who walks by.
        There, the errors of the frames are much larger than elsewhere.
        """
        smooth = cv2.GaussianBlur(
            self.frame_errors, (0, 0), _SMOOTHING * max(self.frame_errors.shape)
        )
        limit = max(_MIN_UNEXPLAINED, _UNEXPLAINED_TIMES * float(np.median(smooth)))
        unexplained: Floats = np.clip(2 * (smooth / limit - 1), 0, 1)[..., None]
        return unexplained

    @property
    def layers(self) -> Floats:
        """T and R, (2, h, w, 3): as measured, and those of the single photo where neither layer
        explains the frames.
        """
        layers: Floats = self.measured + self.unexplained * (self.predicted - self.measured)
        return layers

    def swapped(self) -> Solution:
        """Returns the solution with both measured layers exchanged."""
        return replace(self, measured=self.measured[::-1], naming=-self.naming)


def solve(  # noqa: PLR0915
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    candidates: Sequence[MotionCandidate],
    *,
    refine_prior: Callable[[Floats], Floats] | None = None,
    search: Sequence[Level] = SEARCH,
    levels: Sequence[Level] = LEVELS,
    on_progress: Callable[[float], None] = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> Solution:
    """Returns the layers of the reference frame for the best of the candidates.

    Args:
        frames: (h, w, 3) linear light, of one size.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3). candidates: guesses for the
            motions. One of them is locked. refine_prior: returns a better `prior`, given the
            measured share of R in the light of the reference frame, (h, w, 1). search: the levels
            that compare the candidates.
        levels: the levels of the best candidate.
        on_progress: called with the completed fraction.
        on_layers: called after each level but the last with T and R of the reference frame so far,
            (2, h, w, 3) linear light.
    """
    largest = _MAX_ENLARGEMENT * max(frames[0].shape)
    search, levels = (
        [level for level in some if level.long_side_px <= largest] or some[:1]
        for some in (search, levels)
    )
    total = (
        sum(level.steps * level.step_cost for level in (*search, *levels))
        + (OPACITY_STEPS + SEARCH_STEPS + FINAL_STEPS) * levels[0].step_cost
    )
    done = 0.0

    def optimised(model: JointModel, level: Level, frames: Floats, prior: Floats) -> JointModel:
        return optimise(
            model,
            frames,
            prior,
            level.steps,
            rates=level.rates,
            weights=level.weights,
            every=level.every,
            on_step=partial(on_step, level),
        )

    def on_step(level: Level) -> None:
        nonlocal done
        done += level.step_cost / total
        on_progress(min(done, 1.0))

    families = [candidate.family for candidate in candidates]
    motions = np.array([[candidate.transmission, candidate.reflection] for candidate in candidates])
    is_locked = np.array([candidate.is_locked for candidate in candidates])
    first = search[0]
    model = JointModel.start(
        _packed(frames, first.long_side_px), motions, is_locked, reference, first.density
    )
    for level in search:
        small = _packed(frames, level.long_side_px)
        small_prior = _packed([prior], level.long_side_px)[0]
        model = optimised(
            model.resized(small, level.density, level.spline_size), level, small, small_prior
        )
        kept = _best_of_families(model, families, level.kept)
        model = model.selected(kept)
        families = [families[candidate] for candidate in kept]
        on_layers(model.selected([_best(model)]).reference_layers(*small.shape[1:3]))
    one_layer = int(model.is_locked.argmax())
    best = _best(model)
    errors = float(model.data_losses[one_layer]), float(model.data_losses[best])
    other_motions = _other_motions(model, best, candidates)
    model = model.selected([best])
    refine = refine_prior or (lambda _share: prior)
    refined = refine(_reflection_share(model.reference_layers(*small.shape[1:3])))
    for level in levels:
        small, small_prior, small_refined = (
            _packed(images, level.long_side_px) for images in (frames, [prior], [refined])
        )
        model = optimised(
            model.resized(small, level.density, level.spline_size), level, small, small_refined[0]
        )
        if level is levels[0]:
            model, objects = with_objects(
                model,
                small,
                small_refined[0],
                other_motions,
                density=level.density,
                rates=level.rates,
                weights=level.weights,
                on_step=partial(on_step, level),
            )
            layers, naming = _named(model, small[reference], small_prior[0])
            if objects:
                with_them, without_reflection = objects
                layers_with_them, naming_with_them = _named(
                    with_them, small[reference], small_prior[0]
                )
                if naming_with_them > abs(naming) - _MAX_NAMING_LOSS:
                    model = with_them
                    layers = layers_with_them
                    naming = naming_with_them
                    errors = without_reflection, float(model.data_losses[0])
            if naming < 0 and len(model.layers[0]) == 2:  # what hides the wall is no reflection
                model = model.exchanged()
                layers = layers[::-1]
                naming = -naming
                refined = refine(
                    _reflection_share(layers)
                )  # the next levels correct the brightness of large areas
            edge_correlation = _edge_correlation(layers)
        if level is not levels[-1]:
            on_layers(model.reference_layers(*small.shape[1:3]))
    measured = model.reference_layers(*small.shape[1:3])
    predicted = np.stack(
        [small_prior[0, ..., :3], small[reference, ..., :3] - small_prior[0, ..., :3]]
    ).clip(0)
    frame_errors = model.collected_errors(small, layer=0)
    motion = float(model.relative_motion(*_MOTION_SAMPLES)[0])
    return Solution(
        measured, predicted, frame_errors, motion, naming, edge_correlation, *errors, model
    )


def _named(model: JointModel, frame: Floats, prior: Floats) -> tuple[Floats, float]:
    """Returns the layers of the reference frame, (2, h, w, 3), and their `_naming`."""
    layers = model.reference_layers(*frame.shape[:2])
    return layers, _naming(layers, frame, prior)


def _naming(layers: Floats, frame: Floats, prior: Floats) -> float:
    """Returns how much more clearly the first of both layers is T than the second: layers are (2,
    h, w, 3), frame and prior (h, w, 4).

    The sum of two cues: the share of the layer's detail that the prior keeps, and its brightness,
    because glass reflects 4 to 15 %.
    """
    images = [*layers, prior[..., :3]]
    noise = np.sqrt(frame[..., :3] + OFFSET)  # that of light is proportional to its square root
    details = np.stack([((image - _blurred(image)) / noise).ravel() for image in images]).astype(
        np.float64
    )
    gram = details @ details.T
    transmission, reflection = np.linalg.lstsq(gram[:2, :2] + 1e-6 * np.eye(2), gram[:2, 2])[0]
    brightness = np.log((layers[0].mean() + 1e-4) / (layers[1].mean() + 1e-4))
    return float(
        np.clip(transmission - reflection, -_MAX_DETAIL, _MAX_DETAIL)
        + _BRIGHTNESS * np.clip(brightness, -_MAX_BRIGHTNESS, _MAX_BRIGHTNESS)
    )


def _blurred(image: Floats) -> Floats:
    """Returns the mean of the image in boxes of 9 px, at the borders of the part inside."""
    size = _DETAIL_PX, _DETAIL_PX
    total = cv2.boxFilter(image, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    count = cv2.boxFilter(
        np.ones_like(image), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    blurred: Floats = total / count
    return blurred


def _edge_correlation(layers: Floats) -> float:
    """Returns the correlation of the strengths of the edges of two layers (2, h, w, 3)."""
    grey = np.sqrt(layers.mean(-1) + OFFSET)
    strengths = np.hypot(*np.gradient(grey, axis=(1, 2))).reshape(2, -1)
    return float(np.nan_to_num(np.corrcoef(strengths)[0, 1])) if strengths.std(1).all() else 0.0


def _reflection_share(layers: Floats) -> Floats:
    """Returns the share of R in the light of both layers (2, h, w, 3), without noise: (h, w, 1) in
    0..1.
    """
    transmission, reflection = (
        cv2.boxFilter(layer.mean(-1), -1, (_DETAIL_PX, _DETAIL_PX), borderType=cv2.BORDER_CONSTANT)
        for layer in layers
    )
    share: Floats = (reflection / (transmission + reflection + 1e-3))[..., None]
    return share


def _best_of_families(model: JointModel, families: Sequence[str], count: int) -> list[int]:
    """Returns the indices of the best candidates of each family.

    On very small frames, a wrong motion may be better than a true motion of a pixel. Therefore none
    of the families is left out.
    """
    losses = _selection_losses(model)
    order = sorted(range(len(families)), key=losses.__getitem__)
    return [
        i for n, i in enumerate(order) if sum(families[j] == families[i] for j in order[:n]) < count
    ]


def _best(model: JointModel) -> int:
    """Returns the index of the best candidate with two layers."""
    losses = _selection_losses(model)
    return int(np.where(model.is_locked, np.inf, losses).argmin())


def _selection_losses(model: JointModel) -> Doubles:
    """Returns the losses, larger by 1 for implausible motions."""
    return model.losses + (model.relative_motion(*_MOTION_SAMPLES) > _MAX_RELATIVE_MOTION)


def _other_motions(
    model: JointModel, best: int, candidates: Sequence[MotionCandidate]
) -> list[Doubles]:
    """Returns the motions (K, 3, 3) that differ from both motions of the best candidate, and from
    each other: those of features first.
    """
    grid = pixel_grid(3, 3)

    def moved(matrices: Doubles) -> Doubles:
        return np.stack([project(matrix.ravel()[:8], grid) for matrix in matrices])

    matrices = np.concatenate([model.homographies, np.ones_like(model.homographies[..., :1])], -1)
    fitted = matrices.reshape(*matrices.shape[:3], 3, 3)
    known = [moved(matrix) for matrix in fitted[best]]
    found: list[Doubles] = []
    measured = [
        candidate for candidate in candidates if candidate.family in ("features", "Fourier")
    ]
    lines = [candidate.reflection for candidate in candidates if candidate.family == "shift"]
    for matrix in [
        *(each.transmission for each in measured),
        *(each.reflection for each in measured),
        *fitted[:, -1],
        *lines,
    ]:
        places = moved(matrix)
        differences = [
            np.linalg.norm(places - other, axis=1).mean((1, 2)).max() / 2 for other in known
        ]
        if min(differences) > _MIN_DIFFERENCE and len(found) < _MAX_MOTIONS:
            known.append(places)
            found.append(matrix)
    return found


def resized(image: Floats, long_side_px: int) -> Floats:
    """Returns an image, resized so that its long side has this length. Smaller images are
    enlarged.
    """
    height, width = image.shape[:2]
    scale = long_side_px / max(height, width)
    size = max(8, round(width * scale)), max(8, round(height * scale))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small: Floats = cv2.resize(image, size, interpolation=interpolation)
    return small


def _packed(images: Sequence[Floats], long_side_px: int) -> Floats:
    """Returns resized images, (K, h, w, 4)."""
    return with_fourth_channel(np.stack([resized(image, long_side_px) for image in images]))
