"""The desk where work is handed in: few at a time, a short queue, a time limit, and every job can be cancelled.

    job_queue = Desk()
    with job_queue.reserve("a name") as job:
        answer = await job_queue.run_job(job, work, request.receive)

`work(on_progress)` runs in a thread. It calls `on_progress(share done)` as often as it can: that is where it is stopped when the
client goes away or time is over.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event
from typing import Any, Literal, TypeVar, final

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Receive

from brewster.inference.predictor import ProgressCallback

Result = TypeVar("Result")


@final
class JobCancelled(Exception):
    """Raised within the work, to end it."""


@final
@dataclass(frozen=True)
class JobProgress:
    """How a job stands."""

    state: Literal["waiting", "working"]
    ahead: int
    """How many others are waiting or worked on before it, while it waits."""
    share: float
    """How much of it is done, 0..1."""


@final
@dataclass(eq=False)
class SeparationJob:
    """One piece of work, from the moment it has a place until its thread has let it go."""

    share: float = 0.0
    is_working: bool = False
    future: Future[Any] | None = None
    cancelled: Event = field(default_factory=Event)

    def on_progress(self, share: float) -> None:
        """What the work calls."""
        if self.cancelled.is_set():
            raise JobCancelled
        self.share = share

    def run(self, work: Callable[[ProgressCallback], Result]) -> Result:
        """The work, in its thread."""
        self.on_progress(0)
        self.is_working = True
        return work(self.on_progress)


@final
class JobQueue:
    """Takes jobs within one event loop and has them done in threads."""

    def __init__(self, *, workers: int = 1, max_waiting: int = 16, timeout_seconds: float = 300) -> None:
        self.workers, self.max_waiting, self.timeout_seconds = workers, max_waiting, timeout_seconds
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="brewster-job")
        self._jobs: dict[object, SeparationJob] = {}

    @property
    def jobs(self) -> int:
        """How many jobs have a place."""
        return len(self._jobs)

    def progress(self, name: str) -> JobProgress | None:
        """How the job of this name stands; None if there is none."""
        job, names = self._jobs.get(name), list(self._jobs)  # a thread may end a job at any time
        if job is None or name not in names:
            return None
        ahead = 0 if job.is_working else names.index(name)
        return JobProgress("working" if job.is_working else "waiting", ahead, job.share)

    @contextmanager
    def reserve(self, name: str | None = None) -> Iterator[SeparationJob]:
        """A place for a job, to be taken before its bytes are; it is free again when no thread works on it.

        Raises:
            HTTPException: 503: all places are taken; 409: there is a job of this name.
        """
        if self.jobs >= self.workers + self.max_waiting:
            raise HTTPException(
                503, f"{self.jobs} photos are waiting already; try again in a moment", {"Retry-After": "5"}
            )
        if name in self._jobs:
            raise HTTPException(409, f"there is a job {name} already; choose another name")
        job, key = SeparationJob(), name or object()
        self._jobs[key] = job
        try:
            yield job
        finally:
            job.cancelled.set()
            self._release(key, job.future)

    def _release(self, key: object, future: Future[Any] | None) -> None:
        if future is None or future.cancel():
            del self._jobs[key]
        else:
            future.add_done_callback(lambda _: self._jobs.pop(key))

    async def run_job(
        self, job: SeparationJob, work: Callable[[ProgressCallback], Result], receive: Receive
    ) -> Result:
        """The answer of the work.

        Raises:
            HTTPException: 504: it was not done in time.
            ClientDisconnect: nobody waits for the answer any more, as `receive` tells.
        """
        future: Future[Result] = self._pool.submit(job.run, work)
        job.future, answer = future, asyncio.wrap_future(future)
        disconnected = asyncio.ensure_future(_wait_for_disconnect(receive))
        try:
            done, _ = await asyncio.wait(
                (answer, disconnected), timeout=self.timeout_seconds, return_when=asyncio.FIRST_COMPLETED
            )
            if answer in done:
                return answer.result()
            if disconnected in done:
                raise ClientDisconnect
            raise HTTPException(
                504,
                f"it took longer than {self.timeout_seconds:g} seconds; try a smaller photo, or quality draft",
            )
        finally:
            job.cancelled.set()
            answer.cancel()
            disconnected.cancel()


async def _wait_for_disconnect(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
