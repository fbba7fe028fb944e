"""Runs tasks on a Ray cluster. Ray transfers only tasks and results; the workers read and write the
images.
"""

import importlib
import os
import secrets
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import ModuleType
from typing import Final, Self, final

from brewster.base.executors.local import (
    MAX_ATTEMPTS,
    Executor,
    ResultT,
    Runner,
    Task,
    run_in_worker,
)
from brewster.errors import DeviceError, MissingExtra

LOCAL: Final = "local"
_CONNECT_TIMEOUT_S: Final = 10.0
_AUTHENTICATION: Final = ("RAY_AUTH_TOKEN", "RAY_AUTH_MODE")
"""The environment variables of the token, and of whether Ray requires it, which Ray sets."""
_TASKS_PER_CPU: Final = 2
"""Number of submitted tasks per processor. With 2, no processor waits for the head node."""


@final
class RayExecutor(Executor[ResultT]):
    """Runs tasks on the Ray cluster at an address, or on a cluster of this machine only ("local").

    If a node is lost, its tasks are run on another node: Ray itself tries a task several times."""

    def __init__(
        self,
        create_runner: Callable[[], Runner[ResultT]],
        address: str = LOCAL,
        workers: int | None = None,
    ) -> None:
        self._create_runner = create_runner
        self._address = address
        self._options = (
            {"num_cpus": workers, "include_dashboard": False} if address == LOCAL else {}
        )

    def capacity(self) -> int:
        """Two tasks for each processor of the current nodes."""
        processors = int(self._ray.cluster_resources().get("CPU", 1))
        return _TASKS_PER_CPU * max(1, processors)

    def start(self, task: Task[ResultT]) -> Future[list[ResultT]]:
        """Sends a task to the cluster."""
        submitted = self._run_task.remote(self._create_runner_ref, task)
        future: Future[list[ResultT]] = submitted.future()
        return future

    def lost_reason(self, error: Exception) -> str:
        """Returns how the process or the node was lost. Raises the exception of the runner; its
        cause is Ray's error with the traceback of the worker.
        """
        ray_error = self._ray.exceptions.RayError
        if not isinstance(error, ray_error):
            raise error
        cause = getattr(error, "cause", None)  # the exception that a task has raised
        # A subclass of RayError is not from the runner: the arguments of the task were lost with a
        # node, for example. RayError itself replaces an exception of the runner that cannot be
        # pickled.
        if cause is None or (isinstance(cause, ray_error) and type(cause) is not ray_error):
            return f"the process or the node was lost {MAX_ATTEMPTS} times ({type(error).__name__})"
        raise cause from error

    def __enter__(self) -> Self:
        """Connects to the cluster, or starts a cluster on this machine if the address is "local".
        Raises MissingExtra if Ray is not installed, and DeviceError if no cluster responds at the
        address.
        """
        if self._address != LOCAL and _has_token():
            os.environ.setdefault(_AUTHENTICATION[1], "token")  # Ray reads it on import
        self._ray = _ray()
        try:
            # OSError if no program listens at HOST:PORT: Ray itself retries for many minutes
            host, _, port = self._address.rpartition(":")
            if host and port.isdigit() and "/" not in host:
                socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT_S).close()
            with _own_token() if self._address == LOCAL else nullcontext():
                self._ray.init(
                    self._address, log_to_driver=False, logging_level="error", **self._options
                )
        except (OSError, RuntimeError, ValueError) as error:
            raise DeviceError(
                f"there is no cluster at {self._address} ({error})",
                "expected a running Ray cluster as HOST:PORT, or local, with the same token in "
                "~/.ray/auth_token if it has one",
                "start a cluster (ray start --head), or copy the token of its first machine",
            ) from error
        self._run_task = self._ray.remote(max_retries=MAX_ATTEMPTS - 1, num_cpus=1)(run_in_worker)
        self._create_runner_ref = self._ray.put(self._create_runner)
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnects from the cluster, which ends the running tasks."""
        self._ray.shutdown()


def _has_token() -> bool:
    """Whether this user has a token of Ray. `ray start` then requires it of all programs, and a
    program sends it only if the environment variable says so.
    """
    path = os.environ.get("RAY_AUTH_TOKEN_PATH", Path.home() / ".ray" / "auth_token")
    return _AUTHENTICATION[0] in os.environ or Path(path).is_file()


@contextmanager
def _own_token() -> Iterator[None]:
    """Within this block, a cluster is started with a token of its own.

    Ray 2.60 protects each local cluster with a token, and writes a new one to ~/.ray/auth_token.
    From then on, `ray start` requires this token of all nodes and programs of a cluster, and
    machines without the file cannot join. A token in the environment is not written.
    """
    given = {name: os.environ.get(name) for name in _AUTHENTICATION}
    os.environ.setdefault(_AUTHENTICATION[0], secrets.token_hex(16))
    try:
        yield
    finally:
        for name, value in given.items():
            if value is None:
                os.environ.pop(name, None)


def _ray() -> ModuleType:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reads the variable on import
    try:
        ray = importlib.import_module("ray")
    except ImportError as error:
        expected = "expected the package ray for --cluster"
        raise MissingExtra.for_extra(
            "cluster", "the package ray is not installed", expected
        ) from error
    # Ray prints lost processes on standard output, which is reserved for --json. There is no option
    # to prevent this.
    importlib.import_module("ray._private.worker")._worker_logs_enabled = False  # type: ignore[attr-defined]
    return ray
