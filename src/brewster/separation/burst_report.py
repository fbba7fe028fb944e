"""`BurstReport`: what a burst, several photos of one window, added to the separation of its
reference photo.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, final

from brewster.errors import PhotoError, counted
from brewster.options import MAX_BURST_PHOTOS, MAX_LIGHT_PHOTOS, BurstMethod
from brewster.separation.assessment import Verdict

LightKind = Literal["nothing", "exposure", "one reflection", "changing reflection", "flash"]
"""What changed between the photos.

- nothing: no more than noise.
- exposure: no more than the exposure, by at least a stop: photos for HDR.
- one reflection: the strength of one mirrored scene, as by a polariser.
- changing reflection: the mirrored scene, or a part of it.
- flash: the light of the scene, in a photo with flash.
"""


@final
@dataclass(frozen=True)
class PhotoFilmReport:
    """The film that a phone recorded around a photo."""

    layout: str
    """Where the film is, such as "Google Motion Photo" or "Apple Live Photo"; see
    `brewster.photo.phone_films.motion_photo`.
    """
    seconds: float
    """The time from its first frame to its last one."""
    frames: int
    """The number of its frames."""
    sha256: str
    """The digest of the film."""
    nearest_frame: int | None
    """The index of the frame that shows the view of the photo; None: no frame shows its scene."""


@final
@dataclass(frozen=True)
class LightReport:
    """How the light changed between photos of a camera that stood."""

    kind: LightKind
    """What changed."""
    changed_area: float
    """The share of the photo in which light changed, 0..1."""
    contrast: float
    """How much the strength of the mirrored scene changed, as a share of its largest one, 0..1; of
    a changing reflection, 0 if it changed little and 1 if it seems to vanish.
    """


EXCHANGE_STEP: Final = (
    "The layers may have each other's names: then exchange them with the option swap."
)
"""The next step where the names of the layers are not certain."""


@final
@dataclass(frozen=True)
class BurstReport:
    """How a burst was separated, and why."""

    method: Literal["burst", "light", "hints", "single photo", "unchanged"]
    """How the layers were separated.

    - burst: by the motion of the layers.
    - light: by the change of the light between photos of a camera that stood.
    - hints: by the model, with hints where the film of the photo shows a reflection.
    - single photo: by the model alone, as the motion does not help.
    - unchanged: not at all, as no reflection was found, two scenes lie side by side, or no light
        changed.
    """
    message: str
    """The reason for the method, and what to change in the next burst. See also `next_step`."""
    frames: int
    """The number of photos that were used."""
    left_out: tuple[int, ...]
    """The indices of photos that do not show the window of the reference photo."""
    reference: int
    """The index of the photo that was separated."""
    relative_motion_px: float
    """The largest motion of the reflection relative to the transmission between two photos, in
    1/1,000 of the width.
    """
    explained: float
    """The share of the errors of a model with one layer that the motion of a second layer explains,
    0..1.
    """
    edge_correlation: float
    """The correlation of the edges of both layers, -1..1: about 0 for two scenes."""
    second_motion: float = 0.0
    """The share of the change between the aligned photos that a motion of at most 1 % of the width
    explains, 0..1: the evidence of a small motion. 0 if none was looked for.
    """
    next_step: str | None = None
    """The option that shows the other result, or None."""
    is_measured: bool = False
    """Whether there are measured layers, which the method "motion" uses in any case."""
    are_names_certain: bool = True
    """Whether it is certain which of the measured layers is behind the glass."""
    is_swapped: bool = False
    """Whether the measured layers were exchanged on request."""
    is_second_motion_seen: bool = False
    """Whether a second motion explains the photos clearly better than one layer does, even if too
    weakly for layers.
    """
    measured_verdict: Verdict | None = None
    """What the measured layers are worth, whether they are used or not; None if there are none.
    `Separation.assessment` has the verdict of the result.

    - removed, partly removed: the layers explain the photos well, or less well.
    - little found: the photos show a reflection, but it changes hardly any pixel.
    - doubtful: the motion does not separate the layers.
    """
    doubtful_area: float = 0.0
    """The share of the photo in which the measured layers are doubtful, 0..1: neither of them
    explains the photos there. The transmission is that of the single photo there, and the
    confidence is 0.
    """
    is_side_by_side: bool = False
    """Whether two scenes lie side by side, as a mirror or a door beside a wall, which two layers do
    not explain. All of the photo is doubtful then, and stays as it is.
    """
    film: PhotoFilmReport | None = None
    """The film of the photo, if the layers were measured by it."""
    light: LightReport | None = None
    """How the light changed, if this was measured."""


def burst_photo_name(photos: Sequence[object], index: int) -> str:
    """Returns the number of a photo for messages, and its path if it has one: `photo 3 of the burst
    (c.jpg)`.
    """
    photo = photos[index]
    path = f" ({os.fspath(photo)})" if isinstance(photo, str | os.PathLike) else ""
    return f"photo {index + 1} of the burst{path}"


def check_photo_count(count: int, method: BurstMethod = "auto") -> None:
    """Checks that a burst can have this many photos.

    Args:
        count: the number of photos.
        method: how they are to be separated.

    Raises:
        PhotoError: there are too few or too many photos.
    """
    most = MAX_LIGHT_PHOTOS if method == "light" else MAX_BURST_PHOTOS
    if not 2 <= count <= most:
        raise PhotoError(
            f"a burst has {counted(count, 'photo')}",
            f"expected 2 to {most} photos of one window",
            "separate a single photo alone (brewster PHOTO, in Python brewster.separate)"
            if count < 2
            else "select some of the photos",
        )
