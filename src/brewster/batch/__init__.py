"""Separates many photos: files and folders, in one process, in several processes or on a
cluster.
"""

from brewster.batch.one_photo import separate
from brewster.batch.plan import plan_files
from brewster.batch.runner import separate_files, separate_tasks
from brewster.batch.task import FileResult, SeparationTask

__all__ = [
    "FileResult",
    "SeparationTask",
    "plan_files",
    "separate",
    "separate_files",
    "separate_tasks",
]
