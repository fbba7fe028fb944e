"""Decides whether changing light separates the layers of photos, and reports why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, final

import numpy as np

from brewster.film.light.changing_light import LightSolution, solve_light
from brewster.film.light.flash import solve_flash
from brewster.film.light.gains import Doubles, Floats
from brewster.film.light.registration import AlignedPhotos, align
from brewster.film.motion.registration.tracks import Track
from brewster.film.motion.resizing import resized
from brewster.film.motion.solution import Solution
from brewster.film.motion.threads import single_opencv_thread
from brewster.photo.camera_settings import CameraSettings
from brewster.separation.burst_report import EXCHANGE_STEP, BurstReport, LightKind, LightReport

_LONG_SIDE_PX: Final = 640
"""That of the measured layers."""
_MIN_CONTRAST: Final = 0.5
"""With a smaller contrast of R, the glass must be seen at a steeper angle."""
_MESSAGES: Final[dict[LightKind, str]] = {
    "nothing": (
        "The camera stood, and no light changed between the photos. Turn a polariser, hold a dark "
        "cloth behind the camera, or wait until the mirrored scene changes."
    ),
    "exposure": (
        "Only the exposure changes between the photos: they are a series for HDR, which does not "
        "tell a reflection from the scene."
    ),
    "one reflection": "One mirrored scene became brighter and darker, as with a polariser.",
    "changing reflection": "The mirrored scene changed.",
    "flash": "The flash lit the scene and not what the glass mirrors.",
}
_STEEPER: Final = (
    " It changed little: a polariser needs a steeper angle, best 55 degrees to the normal of the "
    "glass, and a cloth must cover more."
)
_MAX_UNSHARED: Final = 0.5
"""If light changed in a smaller share of the photo, the message says what that means."""
_MOVED: Final = (
    " The camera moved, too: what is near and far behind the glass looks like a changing "
    "reflection then."
)
_MOTION_STEP: Final = 'The method "motion" uses the motion of the layers.'
_RETAKE_STEP: Final = "Take the photos with one zoom and focus, without moving the camera."
_PEOPLE_STEP: Final = (
    "If something moved behind the glass, the darkest photo is shown there: then leave out the "
    'photos that show it, or use the method "single".'
)
_LIGHT_STEP: Final = (
    'If the mirrored scene changed between the photos, the method "light" uses that.'
)


@final
@dataclass(frozen=True)
class LightFit:
    """What changing light tells about the layers of the reference photo."""

    photos: AlignedPhotos
    light: LightSolution | None
    """None: no other photo shows the scene."""

    @property
    def has_layers(self) -> bool:
        """Whether light changed that tells the layers apart."""
        return self.light is not None and self.light.kind not in ("nothing", "exposure")

    @property
    def is_certain(self) -> bool:
        """Whether the motion of the layers need not be looked for: nothing moved."""
        if self.light is None or not self.photos.is_still:
            return False
        return self.is_one_change or not self.photos.has_other_motion

    @property
    def is_one_change(self) -> bool:
        """Whether one mirrored scene, or a flash, explains the photos, also of a camera that moved.
        Parallax looks like other changes of the light.
        """
        return self.light is not None and self.light.kind in ("one reflection", "flash")

    @property
    def solution(self) -> Solution | None:
        """The layers as those of a burst, or None without any."""
        if self.light is None or not self.has_layers:
            return None
        return Solution(
            measured=self.light.layers,
            predicted=self.light.layers,
            frame_errors=self.light.errors,
            relative_motion=0.0,
            naming=1.0,
            edge_correlation=0.0,
            one_layer_error=0.0,
            two_layer_error=0.0,
        )

    def report(self, reference: int) -> BurstReport:
        """Returns the report. `reference` is the index of the photo that was separated."""
        method, message = self._decision()
        return BurstReport(
            method=method,
            message=message + self._without(),
            frames=len(self.photos.frames),
            left_out=self.photos.left_out,
            reference=reference,
            relative_motion_px=0.0,
            explained=round(self.light.explained, 4) if self.light else 0.0,
            edge_correlation=0.0,
            next_step=self._next_step(),
            is_measured=self.has_layers,
            are_names_certain=self.light is None or self.light.are_names_certain,
            light=self._light_report(),
        )

    def with_hint(self, report: BurstReport) -> BurstReport:
        """Returns the report of a burst that the motion does not separate, with the hint that
        changing light may do so: what it needs is not always recognised.

        Args:
            report: that of the measured motion.
        """
        if report.method == "burst" or not self.has_layers:
            return report
        steps = [_LIGHT_STEP, report.next_step]
        return replace(report, next_step=" ".join(step for step in steps if step))

    def _decision(self) -> tuple[Literal["light", "single photo", "unchanged"], str]:
        if self.light is None:
            return "single photo", "No other photo shows the same scene, zoom and focus."
        if not self.has_layers:
            return "unchanged", _MESSAGES[self.light.kind]
        message = _MESSAGES[self.light.kind]
        if self.light.contrast < _MIN_CONTRAST:
            message += _STEEPER
        if self.light.kind == "changing reflection":
            if self.light.changed_area < _MAX_UNSHARED:
                unchanged = 1 - self.light.changed_area
                message += (
                    f" In {unchanged:.0%} of the photo, no light changed: what is mirrored there "
                    "is separated as in a single photo."
                )
            if not self.photos.is_still:
                message += _MOVED
        return "light", message

    def _next_step(self) -> str | None:
        if self.light is None:
            return f"{_RETAKE_STEP} {_MOTION_STEP}"
        if not self.has_layers:
            return 'The method "single" separates the reference photo alone.'
        if self.light.kind != "changing reflection":
            return None if self.light.are_names_certain else EXCHANGE_STEP
        return _PEOPLE_STEP if self.photos.is_still else _MOTION_STEP

    def _light_report(self) -> LightReport | None:
        if self.light is None:
            return None
        return LightReport(
            kind=self.light.kind,
            changed_area=round(self.light.changed_area, 4),
            contrast=round(self.light.contrast, 4),
        )

    def _without(self) -> str:
        if not self.photos.left_out:
            return ""
        names = ", ".join(str(k + 1) for k in self.photos.left_out)
        return f" Left out, because their scene, zoom or focus differs from the reference: {names}."


def aligned_photos(
    frames: Sequence[Floats], reference: int, tracks: Sequence[Track]
) -> AlignedPhotos:
    """Returns the photos at the size at which changing light is measured, aligned with the
    reference.

    Args:
        frames: (h, w, 3) linear light each, 0..1, of one size.
        reference: the index of the reference frame.
        tracks: the motions of the layers, from `layer_tracks`.
    """
    height, width = frames[reference].shape[:2]
    with single_opencv_thread():
        small = [resized(frame, min(_LONG_SIDE_PX, max(height, width))) for frame in frames]
        to = small[reference].shape[:2]
        return align(small, reference, [track.resized((height, width), to) for track in tracks])


def fit_light(
    photos: AlignedPhotos,
    refine: Callable[[Floats], Floats],
    *,
    single: Floats | None = None,
    settings: Sequence[CameraSettings] | None = None,
    is_forced: bool,
) -> LightFit:
    """Measures the layers of the reference photo from the change of the light.

    Photos of a camera that moved are measured without the model if this is not forced: then the
    motion of the layers is the better cue.

    Args:
        photos: see `aligned_photos`.
        refine: see `solve_light`.
        single: see `solve_light`; of any size.
        settings: those of the camera for each given photo; None: unknown.
        is_forced: whether the light is used in any case.
    """
    if len(photos.frames) < 2:
        return LightFit(photos=photos, light=None)
    is_refined = is_forced or photos.is_still
    used = [each for k, each in enumerate(settings or ()) if k not in photos.left_out]
    with single_opencv_thread():
        light = _by_flash(photos, used, refine) if is_refined else None
        light = light or solve_light(
            photos.frames,
            photos.reference,
            single=None if single is None else resized(single, max(photos.frames.shape[1:3])),
            exposures=_exposures(used),
            refine=refine if is_refined else lambda transmission: transmission,
        )
    return LightFit(photos=photos, light=light)


def _exposures(used: Sequence[CameraSettings]) -> Doubles | None:
    """Returns the exposures of the photos, (K,), or None if one is unknown."""
    exposures = [each.exposure for each in used if each.exposure is not None]
    return np.array(exposures) if used and len(exposures) == len(used) else None


def _by_flash(
    photos: AlignedPhotos,
    used: Sequence[CameraSettings],
    refine: Callable[[Floats], Floats],
) -> LightSolution | None:
    """Returns the layers from the reference and the nearest photo in which the flash did what it
    did not in the reference; None if there is none.

    Args:
        photos: see `aligned_photos`.
        used: the settings of the camera for each of them; empty: unknown.
        refine: see `solve_light`.
    """
    if not used:
        return None
    own = used[photos.reference]
    others = [
        k for k, other in enumerate(used) if {own.has_flash, other.has_flash} == {False, True}
    ]
    if not others:
        return None
    nearest = min(others, key=lambda k: abs(k - photos.reference))
    pair = [photos.reference, nearest]
    flash = int(not own.has_flash)
    ambient, lit = used[pair[1 - flash]], used[pair[flash]]
    exposure = None
    if ambient.exposure is not None and lit.exposure is not None:
        exposure = lit.exposure / ambient.exposure
    frames = photos.frames[pair]
    return solve_flash(frames, 0, flash, refine(frames[1 - flash]), exposure)
