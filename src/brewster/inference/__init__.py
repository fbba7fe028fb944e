"""Inference: separates a photo into transmission and reflection. Imports neither the renderer nor the trainer."""

from brewster.inference.predictor import QUALITIES
from brewster.inference.separator import Separation, Separator, separate
from brewster.options import Quality

__all__ = ["QUALITIES", "Quality", "Separation", "Separator", "separate"]
