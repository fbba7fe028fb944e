"""Several photos of one window: the layers move differently, so that they can be measured instead of guessed."""

from brewster.burst.separate import MAX_FRAMES, separate_burst
from brewster.inference.burst_report import BurstReport

__all__ = ["MAX_FRAMES", "BurstReport", "separate_burst"]
