"""How do I use it? `Separator` and `separate`; a photograph here wakes no renderer and no trainer."""

from brewster.separate.separator import QUALITIES, Quality, Separation, Separator, separate

__all__ = ["QUALITIES", "Quality", "Separation", "Separator", "separate"]
