"""Runs independent tasks of any kind in this process, in several processes, or on a Ray cluster."""

from brewster.executors.local import (
    MAX_ATTEMPTS,
    Executor,
    ProcessExecutor,
    Runner,
    SerialExecutor,
    Task,
    exit_with_parent,
    run_tasks,
)

__all__ = [
    "MAX_ATTEMPTS",
    "Executor",
    "ProcessExecutor",
    "Runner",
    "SerialExecutor",
    "Task",
    "exit_with_parent",
    "run_tasks",
]
