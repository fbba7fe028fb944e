"""Inference: separates a photo into transmission and reflection. It imports neither the renderer
nor the trainer.
"""

from brewster.inference.predictor import QUALITIES
from brewster.inference.separation import Separation
from brewster.inference.separator import Separator
from brewster.options import Quality

__all__ = ["QUALITIES", "Quality", "Separation", "Separator"]
