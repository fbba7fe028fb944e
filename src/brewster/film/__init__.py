"""Several photos of one window: the layers move differently, so that they can be measured instead
of guessed.
"""

from brewster.errors import MissingExtra

try:
    from brewster.film.separate import fit_burst, separate_burst
    from brewster.film.separate_video import VideoSeparation, separate_video
    from brewster.film.video import read_video
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
