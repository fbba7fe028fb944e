"""Measures the layers of several photos of one window: those of a burst or a film by their motions,
which differ; those of a photo by the film that its phone recorded; and if the camera stood, by the
change of the light.
"""

from brewster.errors import MissingExtra

try:
    from brewster.film.separate import fit_burst, separate_burst
    from brewster.film.separate_video import VideoSeparation, separate_video
    from brewster.film.video.film import read_video
except ImportError as error:
    raise MissingExtra.for_extra(
        "burst", f"{error.name} is not installed", f"expected {error.name}, because bursts need it"
    ) from error
from brewster.separation.burst_report import BurstReport

__all__ = [
    "BurstReport",
    "VideoSeparation",
    "fit_burst",
    "read_video",
    "separate_burst",
    "separate_video",
]
