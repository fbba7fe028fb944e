"""Two layers and their motions, whose sum explains every frame of a burst.

    frame_k(x) = gain_k * (T(motion_T,k(x)) + R(motion_R,k(x)))

T and R are explicit images in linear light on canvases that are larger than the frames, because the
camera moves. They are stored as square roots, so that they are never negative. A motion maps
coordinates of frame k to the reference frame: a homography plus a spline for parallax; that of the
reference frame is the identity. Coordinates are normalised: -1 and 1 are the edges of a frame.

Several candidates for the motion are optimised at once (optimiser.py). In the spirit of neural
spline fields (Chugunov et al. 2024), with images instead of networks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.kernels import CLIPPED, MARGIN, MIN_DENOMINATOR, OFFSET, sampling
from brewster.film.motion.threads import POOL

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_BICUBIC: Final = -0.75
"""The parameter of bicubic interpolation that OpenCV has, too."""
_START_SHARES: Final = 0.9, 0.3
"""The first images of T and of R, as shares of the dark light: glass transmits more than it
reflects.
"""
_MIN_START_LIGHT: Final = 1e-4, 4e-3
"""The least light of the first images of T and of R. Layers are optimised as square roots, and the
gradient of the light with respect to its root is 0 at black places: there, nothing would appear.
"""
_MIN_START_OPACITY: Final = 0.02
"""See `with_opacity`: the optimisation does not change an opacity of 0."""
_MIN_COUNT: Final = 1e-3
"""Added to the number of errors at a place, which is 0 where no frame shows it."""


@final
@dataclass(frozen=True)
class JointModel:
    """C candidates for the L layers of K frames."""

    layers: Floats
    """(C, L, H, W, 4): square roots of linear light. Of three layers, the second one has opaque
    objects in front of the first, and in its last channel the root of the opacity. The reflection
    is last.
    """
    homographies: Doubles
    """(C, L, K, 8), frame to reference."""
    splines: Doubles
    """(C, L, K, 2, rows, columns), the offsets that are added to the homographies."""
    exposures: Doubles
    """(K, 3): the gains of the frames before the optimisation."""
    log_gains: Doubles
    """(C, K, 3): the logarithms of the factors by which the gains differ from them."""
    is_locked: NDArray[np.bool_]
    """(C,): whether R moves with T, so that both are one layer."""
    reference: int
    losses: Doubles
    """(C,): the loss at the end of the last optimisation."""
    data_losses: Doubles
    """(C,): the part of `losses` that compares the frames with their prediction."""

    @property
    def nbytes(self) -> int:
        """The memory of its arrays."""
        return sum(part.nbytes for part in vars(self).values() if isinstance(part, np.ndarray))

    @classmethod
    def start(
        cls,
        frames: Floats,
        motions: Doubles,
        is_locked: NDArray[np.bool_],
        reference: int,
        density: float,
        *,
        exposures: Doubles | None = None,
    ) -> JointModel:
        """Returns a model with first images: T is nearly the mean of the two darkest of the frames
        aligned with its motion, R a part of the darkest.

        A reflection only adds light: where it moves away, the darkest frame shows T alone. The mean
        of two has less noise.

        Args:
            frames: (K, h, w, 4) linear light.
            motions: (C, L, K, 3, 3), frame to reference, of T and R.
            is_locked: (C,): whether R moves with T.
            reference: the index of the reference frame.
            density: the number of pixels of the canvases per pixel of the frames, along each axis.
            exposures: (K, 3), those of the frames relative to the reference frame; by default, 1.
        """
        count, layer_count, frame_count = motions.shape[:3]
        exposures = np.ones((frame_count, 3)) if exposures is None else exposures
        factors = np.pad(exposures, ((0, 0), (0, 1)), constant_values=1).astype(np.float32)
        exposed = frames / factors[:, None, None]
        canvas = pixel_grid(*canvas_size(frames.shape[1:3], density)) * (1 + 2 * MARGIN)
        layers = np.empty((count, layer_count, *canvas.shape[1:], 4), np.float32)
        dark: dict[bytes, tuple[Floats, Floats]] = {}  # candidates share motions
        for candidate in range(count):
            for layer in range(layer_count):
                motion = motions[candidate, layer]
                key = motion.tobytes()
                if key not in dark:
                    dark[key] = _darkest(exposed, motion, canvas, reference)
                which = min(layer, 1)
                light = np.maximum(dark[key][which] * _START_SHARES[which], _MIN_START_LIGHT[which])
                layers[candidate, layer] = np.sqrt(light)
        layers[..., 3] = 0
        losses = np.full(count, np.inf)
        return cls(
            layers=layers,
            homographies=motions.reshape(*motions.shape[:3], 9)[..., :8] / motions[..., 2, 2, None],
            splines=np.zeros((count, layer_count, frame_count, 2, 2, 2)),
            exposures=exposures,
            log_gains=np.zeros((count, frame_count, 3)),
            is_locked=is_locked,
            reference=reference,
            losses=losses,
            data_losses=losses,
        )

    def selected(self, candidates: Sequence[int]) -> JointModel:
        """Returns a model with these candidates only."""
        chosen = list(candidates)
        return JointModel(
            layers=self.layers[chosen],
            homographies=self.homographies[chosen],
            splines=self.splines[chosen],
            exposures=self.exposures,
            log_gains=self.log_gains[chosen],
            is_locked=self.is_locked[chosen],
            reference=self.reference,
            losses=self.losses[chosen],
            data_losses=self.data_losses[chosen],
        )

    @classmethod
    def stacked(cls, models: Sequence[JointModel]) -> JointModel:
        """Returns a model with the candidates of all models, which have layers and splines of one
        size.
        """

        def together(name: str) -> Any:  # noqa: ANN401
            return np.concatenate([getattr(model, name) for model in models])

        return cls(
            layers=together("layers"),
            homographies=together("homographies"),
            splines=together("splines"),
            exposures=models[0].exposures,
            log_gains=together("log_gains"),
            is_locked=together("is_locked"),
            reference=models[0].reference,
            losses=together("losses"),
            data_losses=together("data_losses"),
        )

    def exchanged(self) -> JointModel:
        """Returns a model with its two layers exchanged."""
        layers = self.layers[:, ::-1].copy()
        homographies = self.homographies[:, ::-1].copy()
        splines = self.splines[:, ::-1].copy()
        return replace(self, layers=layers, homographies=homographies, splines=splines)

    def with_opacity(self, opacity: Floats, elsewhere: float = _MIN_START_OPACITY) -> JointModel:
        """Returns a model whose second layers have an opacity.

        The optimisation does not change an opacity of 0, nor one above 1, which counts as 1.

        Args:
            opacity: (h, w), in the reference frame.
            elsewhere: the least opacity.
        """
        layers = self.layers.copy()
        layers[:, 1, ..., 3] = np.sqrt(np.maximum(self.on_canvas(opacity), elsewhere))
        return replace(self, layers=layers)

    def on_canvas(self, image: Floats) -> Floats:
        """Returns an image of the reference frame, (h, w, ...), on the canvases, (H, W, ...). It
        continues beyond the frame as at its borders.
        """
        height, width = self.layers.shape[2:4]
        x, y = to_pixels(pixel_grid(height, width) * (1 + 2 * MARGIN), image.shape)
        moved: Floats = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return moved

    def with_light_moved(self, moved: Floats) -> JointModel:
        """Returns a model of one candidate with two layers after light moved from T to R, as far as
        no layer becomes negative.

        Args:
            moved: the light (H, W, 3), on the canvas.
        """
        light = np.square(self.layers)
        change = np.clip(moved, -light[0, 1, ..., :3], light[0, 0, ..., :3])
        light[0, 0, ..., :3] -= change
        light[0, 1, ..., :3] += change
        return replace(self, layers=np.sqrt(np.maximum(light, 0)))

    def resized(
        self, frames: Floats, density: float, spline_size: tuple[int, int] | None
    ) -> JointModel:
        """Returns the model for larger frames, with finer splines.

        Args:
            frames: (K, h, w, 4).
            density: the number of pixels of the canvases per pixel of the frames, along each axis.
            spline_size: rows and columns of knots; None keeps the splines.
        """
        height, width = canvas_size(frames.shape[1:3], density)
        layers = np.stack(
            [[cv2.resize(layer, (width, height), interpolation=cv2.INTER_CUBIC) for layer in pair]
             for pair in self.layers]
        )  # fmt: skip
        splines = self.splines
        if spline_size:
            rows, columns = (
                bicubic_weights(*sizes)
                for sizes in zip(spline_size, splines.shape[-2:], strict=True)
            )
            splines = rows @ splines @ columns.T
        return replace(self, layers=layers, splines=splines)

    def fixed_motion(self) -> tuple[Doubles, Doubles, Doubles]:
        """Returns the homographies (C, L, K, 8), splines (C, L, K, 2, rows, columns) and gains (C,
        K, 3) that hold: R of locked candidates moves with T, and the reference frame not at all.
        """
        identity = np.eye(3).ravel()[:8]
        homographies = self.homographies.copy()
        splines = self.splines.copy()
        log_gains = self.log_gains.copy()
        for motion in (homographies, splines):
            motion[self.is_locked, -1] = motion[self.is_locked, 0]
        homographies[:, :, self.reference] = identity
        splines[:, :, self.reference] = 0
        log_gains[:, self.reference] = 0
        return homographies, splines, self.exposures * np.exp(log_gains)

    def positions(self, candidate: int, layer: int, frame: int, height: int, width: int) -> Doubles:
        """Returns the coordinates (x, y) in the reference frame of each pixel of a frame: (2, h,
        w), normalised.

        Args:
            candidate: the index of the candidate.
            layer: the index of the layer.
            frame: the index of the frame.
            height: h.
            width: w.
        """
        homographies, splines, _ = self.fixed_motion()
        rows, columns = (
            bicubic_weights(*sizes)
            for sizes in zip((height, width), splines.shape[-2:], strict=True)
        )
        offsets = rows @ splines[candidate, layer, frame] @ columns.T
        moved: Doubles = (
            project(homographies[candidate, layer, frame], pixel_grid(height, width)) + offsets
        )
        return moved

    def frame_layers(self, frame: int, height: int, width: int) -> Floats:
        """Returns T and R of the first candidate as a frame shows them, without its gain: (2, h, w,
        3) linear light.

        Args:
            frame: the index of the frame.
            height: h.
            width: w.
        """
        return compose(self._samples(frame, height, width))

    def reference_layers(self, height: int, width: int) -> Floats:
        """Returns T and R of the reference frame for the first candidate: (2, h, w, 3) linear
        light.
        """
        return self.frame_layers(self.reference, height, width)

    def reference_opacity(self, height: int, width: int) -> Floats:
        """Returns the opacity of the second layer of the first candidate in the reference frame,
        (h, w) in 0..1.
        """
        return np.minimum(self._samples(self.reference, height, width)[1, ..., 3], 1)

    def _samples(self, frame: int, height: int, width: int) -> Floats:
        """Returns the layers of the first candidate at the places that a frame shows, (L, h, w,
        4).
        """
        samples = np.empty((self.layers.shape[1], height, width, 4), np.float32)
        for layer, canvas in enumerate(np.square(self.layers[0])):
            positions = self.positions(0, layer, frame, height, width) / (1 + 2 * MARGIN)
            sampling.sample(canvas, *to_pixels(positions, canvas.shape), samples[layer])
        return samples

    def relative_motion(self, height: int, width: int) -> Doubles:
        """Returns the largest mean motion of R relative to T between two frames, as a share of the
        width, (C,).
        """
        scale = np.array([0.5, 0.5 * height / width])
        largest = []
        for candidate in range(len(self.layers)):
            transmission, reflection = (
                np.stack([self.positions(candidate, layer, k, height, width).mean((1, 2))
                          for k in range(len(self.log_gains[0]))])
                for layer in (0, -1)
            )  # fmt: skip
            offsets = (reflection - transmission) * scale
            largest.append(np.linalg.norm(offsets[:, None] - offsets, axis=-1).max())
        return np.array(largest)

    def collected_errors(self, frames: Floats, layer: int) -> Floats:
        """Returns the mean absolute errors of the frames for the first candidate, moved to the
        reference frame: (h, w), as differences of square roots of light.

        Args:
            frames: (K, h, w, 4) linear light.
            layer: the index of the layer whose motion moves the errors.
        """
        _, height, width, _ = frames.shape
        collected = np.zeros((height, width, 2), np.float32)
        gains = self.fixed_motion()[2][0]

        def moved_errors(k: int) -> tuple[Floats, Floats, Floats]:
            total = self.frame_layers(k, height, width).sum(0)
            errors: Floats = np.abs(
                data_errors(total * gains[k].astype(np.float32), frames[k, ..., :3])
            ).mean(-1)
            return errors, *to_pixels(self.positions(0, layer, k, height, width), (height, width))

        for errors, x, y in POOL.map(moved_errors, range(len(frames))):
            sampling.collect(errors, x, y, collected)
        mean_errors: Floats = collected[..., 0] / (collected[..., 1] + _MIN_COUNT)
        return mean_errors


def _darkest(
    frames: Floats, motion: Doubles, canvas: Doubles, reference: int
) -> tuple[Floats, Floats]:
    """Returns the mean of the two darkest frames on the canvas of a layer, and the darkest one, (H,
    W, 4) each. Where one frame shows a place, both are that one; where none does, the border of the
    reference frame.

    Args:
        frames: (K, h, w, 4).
        motion: (K, 3, 3), frame to reference.
        canvas: (2, H, W), the normalised coordinates of the pixels of the canvas in the reference
            frame.
        reference: the index of the reference frame.
    """
    size = frames.shape[1:3]
    first, second = (np.full((*canvas.shape[1:], 4), np.inf, np.float32) for _ in range(2))
    for frame, matrix in zip(frames, np.linalg.inv(motion), strict=True):
        positions = transformed(matrix, canvas)
        sampling.darken(frame, *to_pixels(positions, size), first, second)
    is_unseen = np.isinf(first[..., 0])
    if is_unseen.any():
        own = np.empty_like(first)
        matrix = np.linalg.inv(motion[reference])
        positions = transformed(matrix, canvas)
        sampling.sample(frames[reference], *to_pixels(positions, size), own)
        first[is_unseen] = own[is_unseen]
    mean = (first + second) / 2
    return np.where(np.isinf(second), first, mean), first


def compose(samples: Floats) -> Floats:
    """Returns T and R (2, h, w, 3) from samples of the layers at one place, (L, h, w, 4). Objects
    belong to T.
    """
    visible = 1 - np.minimum(samples[1, ..., 3:], 1)
    transmission = samples[0, ..., :3] * visible + samples[1:-1, ..., :3].sum(0)
    return np.stack([transmission, samples[-1, ..., :3]])


def data_errors(predicted: Floats, frames: Floats) -> Floats:
    """Returns the differences of square roots of light, (..., 3). Where a frame is clipped, a
    brighter prediction is no error.

    Args:
        predicted: (..., 3) linear light.
        frames: (..., 3) linear light.
    """
    errors: Floats = np.sqrt(predicted + OFFSET) - np.sqrt(frames + OFFSET)
    errors[(frames > CLIPPED) & (errors > 0)] = 0
    return errors


def with_fourth_channel(images: Floats) -> Floats:
    """Returns images (..., 3) with a fourth channel of 0, see kernels/."""
    padded = np.zeros((*images.shape[:-1], 4), np.float32)
    padded[..., :3] = images
    return padded


def pixel_grid(height: int, width: int) -> Doubles:
    """Returns the normalised coordinates (x, y) of the pixel centres, (2, h, w)."""
    y, x = ((np.arange(length) + 0.5) * 2 / length - 1 for length in (height, width))
    return np.stack(np.meshgrid(x, y))


def bicubic_pieces(length: int, knots: int) -> tuple[Doubles, NDArray[np.int64]]:
    """Returns the weights of bicubic interpolation between knots (Keys 1981), of which the first
    and the last are at the edges.

    Args:
        length: the number of pixels.
        knots: the number of knots.

    Returns:
        The weights (4, length), and the pieces (knots + 1,): from `pieces[j]` to `pieces[j + 1]`,
        the weights are those of the knots j - 1 to j + 2, of which those beyond the edges are the
        outer ones.
    """
    places = np.arange(length) * (knots - 1) / (length - 1)
    first = np.minimum(np.floor(places), knots - 1).astype(int)
    distance = np.abs(places - first - np.arange(-1, 3)[:, None])
    near = ((_BICUBIC + 2) * distance - (_BICUBIC + 3)) * distance**2 + 1
    far = ((_BICUBIC * distance - 5 * _BICUBIC) * distance + 8 * _BICUBIC) * distance - 4 * _BICUBIC
    return np.where(distance <= 1, near, far), np.searchsorted(first, np.arange(knots + 1))


def bicubic_weights(length: int, knots: int) -> Doubles:
    """Returns the matrix (length, knots) of `bicubic_pieces`."""
    pieces, starts = bicubic_pieces(length, knots)
    weights = np.zeros((length, knots))
    first = np.repeat(np.arange(knots), np.diff(starts))
    for shift, weight in zip(range(-1, 3), pieces, strict=True):
        np.add.at(weights, (np.arange(length), np.clip(first + shift, 0, knots - 1)), weight)
    return weights


def transformed(homography: Doubles, positions: Doubles) -> Doubles:
    """Returns where a homography (3, 3) moves positions (2, ...), in normalised coordinates."""
    return project((homography / homography[2, 2]).ravel()[:8], positions)


def project(homography: Doubles, grid: Doubles) -> Doubles:
    """Applies a homography (8,) to a grid (2, h, w) of normalised coordinates."""
    matrix = np.append(homography, 1).reshape(3, 3)
    x, y, denominator = np.tensordot(matrix[:, :2], grid, 1) + matrix[:, 2, None, None]
    projected: Doubles = np.stack([x, y]) / np.maximum(denominator, MIN_DENOMINATOR)
    return projected


def to_pixels(positions: Doubles, size: Sequence[int]) -> Any:  # noqa: ANN401
    """Returns x and y (h, w) float32 in pixels of an image of this size (h, w, ...), in which 0 is
    the centre of the first one.
    """
    height, width = size[:2]
    return tuple(
        ((axis + 1) * (length / 2) - 0.5).astype(np.float32)
        for axis, length in zip(positions, (width, height), strict=True)
    )


def canvas_size(size: Sequence[int], density: float = 1.0) -> tuple[int, int]:
    """Returns height and width of the canvases of frames of this size (h, w), with `density` pixels
    per pixel of a frame.
    """
    height, width = (round(length * (1 + 2 * MARGIN) * density) for length in size)
    return height, width
