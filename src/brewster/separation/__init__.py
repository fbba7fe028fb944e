"""Inference: separates a photo into transmission and reflection. It imports neither the renderer
nor the trainer.
"""

from brewster.options import Quality
from brewster.separation.predictor import QUALITIES
from brewster.separation.separation import Separation
from brewster.separation.separator import Separator

__all__ = ["QUALITIES", "Quality", "Separation", "Separator"]
