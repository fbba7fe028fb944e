"""Inference: separates a photo into transmission and reflection. The package imports neither the renderer nor the trainer."""

from brewster.inference.batch import FileResult, SeparationTask, plan_files, separate_files, separate_tasks
from brewster.inference.predictor import QUALITIES
from brewster.inference.separation import Separation
from brewster.inference.separator import Separator, separate
from brewster.options import Quality

__all__ = [
    "QUALITIES",
    "FileResult",
    "Quality",
    "Separation",
    "SeparationTask",
    "Separator",
    "plan_files",
    "separate",
    "separate_files",
    "separate_tasks",
]
