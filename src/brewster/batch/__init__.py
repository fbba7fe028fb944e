"""Separates many photos: files and folders, in one process, in several processes or on a
cluster.
"""

from brewster.batch.one_photo import separate
from brewster.batch.plan import FileResult, SeparationTask, plan_files
from brewster.batch.runner import separate_files, separate_tasks

__all__ = [
    "FileResult",
    "SeparationTask",
    "plan_files",
    "separate",
    "separate_files",
    "separate_tasks",
]
