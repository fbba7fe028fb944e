"""The measured layers of a burst: which method is used, and how they are applied at full size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.errors import PhotoError
from brewster.film.motion.model.joint_model import Floats, JointModel
from brewster.film.motion.solution import Solution
from brewster.options import BurstMethod, Quality
from brewster.photo import Photo, Source
from brewster.separation.assessment import Assessment, Verdict
from brewster.separation.burst_report import BurstReport
from brewster.separation.guided_upsampling import RADIUS, GeneratedOverride
from brewster.separation.predictor import Prediction, Predictor, ProgressCallback
from brewster.separation.separation import Separation
from brewster.separation.separator import Separator

_DETAIL_LIMITS: Final = (0.5, 2.0)
"""The detail of the reference photo changes the sum of the layers by no more than these factors."""


@final
@dataclass(frozen=True)
class FittedBurst:
    """The reference photo of a burst, and its measured layers."""

    photo: Photo
    report: BurstReport
    seconds: dict[str, float]
    """The time of each step."""
    _solution: Solution | None
    _single: Separator
    """Of the single photo."""
    _hints: Source | None
    _requested: BurstMethod = "auto"
    film_hints: NDArray[np.uint8] | None = None
    """Hints for the model where the film of the photo shows a reflection, (H, W, 3), or None."""

    def chosen(self, method: BurstMethod, *, swap: bool) -> FittedBurst:
        """Returns the burst with another method, or with exchanged layers.

        Args:
            method: see `separate_burst`.
            swap: see `separate_burst`.

        Raises:
            PhotoError: the method is "motion", and there are no measured layers; or it is "light",
                and the motion of a photo's film was measured.
        """
        report = self.report
        if method == "light" and report.film:
            raise PhotoError(
                "the light of a photo and its film cannot be used: both are taken at one time",
                "expected two or more photos between which the light changed",
                "use the method auto",
            )
        if method == "single":
            message = "The reference photo was separated alone, as requested."
            report = replace(report, method="single photo", message=message, next_step=None)
        elif method == "motion" and report.method != "burst":
            if not report.is_measured or self.is_by_light:
                raise PhotoError(
                    f"no layers were measured: {report.message}",
                    "expected photos that show the motion",
                    "use the method auto or single",
                )
            message = f"The measured layers are used, as requested. {report.message}"
            report = replace(report, method="burst", message=message, next_step=None)
        fitted = replace(self, report=report, _requested=method)
        return fitted._exchanged() if swap and report.method in ("burst", "light") else fitted

    @property
    def is_by_light(self) -> bool:
        """Whether the change of the light was measured, and not the motion."""
        return self.report.light is not None

    @property
    def hints(self) -> Source | None:
        """The hints of the person, or those of the film, if the separator is that of the single
        photo.
        """
        if self.report.method == "hints":
            return self.film_hints
        return self._hints if self.report.method == "single photo" else None

    @property
    def separator(self) -> Separator:
        """The separator that separates the photo by the method of the report."""
        separator = self._single
        method = self.report.method
        if method not in ("single photo", "hints"):
            is_measured = method in ("burst", "light")
            predictor = (
                _FixedPredictor(self._layers())
                if is_measured
                else lambda tile: (tile, np.zeros_like(tile))
            )
            separator = Separator(
                predictor,
                name=separator.name,
                method=method,
                sha256=separator.sha256,
                device=separator.device,
            )
        return separator.for_burst(
            self.report.frames + len(self.report.left_out),
            hints="yes" if self._hints is not None else "no",
            requested=self._requested,
            swapped="yes" if self.report.is_swapped else "no",
            **({"verdict": self._verdict} if self._verdict else {}),
            **({"film": self.report.film.sha256[:12]} if self.report.film else {}),
        )

    @property
    def _verdict(self) -> Verdict | None:
        """The verdict of measured layers, or of a photo that stays as it is; None: the model alone
        separates the photo, and its assessment has the verdict.
        """
        if self.report.method == "unchanged":
            return "doubtful" if self.report.is_side_by_side else "little found"
        return self.report.measured_verdict if self.report.method == "burst" else None

    def assessed(self, assessment: Assessment) -> Assessment:
        """Returns an assessment of the separator with the verdict of the measurement, which knows
        more than the assessment of a single photo. If the strength is 0, little is found.
        """
        is_written = assessment.removed_light > 0 or self.report.method == "unchanged"
        verdict = self._verdict if is_written else None
        return replace(assessment, verdict=verdict) if verdict else assessment

    @property
    def model(self) -> JointModel:
        """The measured layers and motions. Raises ValueError if there are none."""
        model = self._measured.model
        if model is None:
            raise ValueError("the film of a photo has no layers of its own; expected a burst")
        return model

    @property
    def kept(self) -> Floats:
        """Where the frames of a film stay as they are, (h, w, 1) in 0..1 of the reference frame:
        neither layer explains the frames, or there is no glass. Raises ValueError if there are no
        layers.
        """
        layers = self._layers()
        if layers.without_glass is None:
            return layers.unexplained
        return np.maximum(layers.unexplained, layers.without_glass)

    def without_model(self) -> FittedBurst:
        """Returns the same without the motions and canvases, half of its memory, which only
        `separate_video` needs.
        """
        if self._solution is None:
            return self
        return replace(self, _solution=replace(self._solution, model=None))

    @property
    def _measured(self) -> Solution:
        if self._solution is None:
            raise ValueError(
                "no layers were measured; expected a report with is_measured; check it first"
            )
        return self._solution

    @property
    def nbytes(self) -> int:
        """The memory of the photo, of the measured layers and of the hints. That of the separator
        is not counted, because other bursts share it.
        """
        parts = self.photo.pixels, self._solution, self.film_hints
        files = len(self._hints) if isinstance(self._hints, bytes) else 0
        return files + sum(part.nbytes for part in parts if part is not None)

    def _layers(self) -> Solution:
        return self._measured.swapped() if self.report.is_swapped else self._measured

    def separate(self, on_progress: ProgressCallback, **options: Any) -> Separation:  # noqa: ANN401
        """Computes the layers at full size.

        Args:
            on_progress: called with the completed fraction, 0 to 1.
            options: those of the call of a `Separator`. Other hints than those of the measurement
                are ignored.
        """
        options["hints"] = self.hints
        separation = self.separator(self.photo, on_progress=on_progress, **options)
        seconds = {
            name: self.seconds.get(name, 0.0) + spent for name, spent in separation.seconds.items()
        }
        exchange = None
        if self.report.method in ("burst", "light"):
            exchange = partial(self._exchanged().separate, lambda _fraction: None, **options)
        return replace(
            separation,
            assessment=self.assessed(separation.assessment),
            burst=self.report,
            next_step=self.report.next_step,
            seconds=self.seconds | seconds,
            _exchange=exchange,
        )

    def _exchanged(self) -> FittedBurst:
        is_swapped = not self.report.is_swapped
        report = replace(self.report, is_swapped=is_swapped, are_names_certain=True, next_step=None)
        return replace(self, report=report)


@final
class _FixedPredictor(Predictor):
    """Returns the solution of a burst as the prediction for its reference photo."""

    is_measured = True

    def __init__(self, solution: Solution) -> None:
        self._solution = solution

    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:  # noqa: ARG002
        """Returns the size of the solution."""
        height, width = self._solution.measured.shape[1:3]
        return [(width, height)]

    def __call__(
        self,
        inputs: Sequence[Floats],
        quality: Quality,  # noqa: ARG002
        on_progress: ProgressCallback,  # noqa: ARG002
    ) -> Prediction:
        """Returns the layers, with the detail of the reference photo."""
        (photo,) = inputs
        solution = self._solution
        change, reflection, override = measured_change(photo, *solution.layers)
        return Prediction(
            change=change,
            reflection=reflection,
            confidence_map=solution.confidence,
            override=override,
        )


def window_means(map_: Floats) -> Floats:
    """Returns what `box_mean` does, up to rounding, in a tenth of its time."""
    side = 2 * RADIUS + 1
    means: Floats = cv2.blur(map_, (side, side), borderType=cv2.BORDER_REPLICATE)
    return means.reshape(map_.shape)  # OpenCV drops a single channel


def measured_change(
    photo: Floats, transmission: Floats, reflection: Floats
) -> tuple[Floats, Floats, GeneratedOverride]:
    """Returns measured layers as `GuidedUpsampler.fit` takes them, with the detail of the photo:
    the change of the photo to T, R, and where T takes no detail of the photo.

    Args:
        photo: (h, w, 3) linear light.
        transmission: (h, w, 3), with the exposure of the photo.
        reflection: (h, w, 3), the same.
    """
    total = np.maximum(transmission + reflection, np.float32(1e-4))
    detail = np.clip(photo / total, *_DETAIL_LIMITS)
    # At full size, edges of a strong reflection would remain in the transmission: there it takes no
    # detail of the photo
    override = GeneratedOverride.weighted_by_detail(transmission, reflection, window_means)
    return transmission * detail - photo, np.minimum(reflection * detail, photo), override
