"""A job queue with worker threads, a limited number of waiting jobs, a time limit, and
cancellation.

    job_queue = JobQueue()
    with job_queue.reserve("a name") as job:
        result = await job_queue.run_job(job, work, request.receive)

`work(on_progress)` runs in a thread and often calls `on_progress` with the completed fraction, 0 to
1. This call raises JobCancelled if the client has disconnected, the time limit is exceeded, or the
queue was closed.
"""

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event
from typing import Any, Literal, TypeVar, final

import numpy as np
from numpy.typing import NDArray
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Receive

from brewster.photo import Photo
from brewster.separation.predictor import ProgressCallback

Result = TypeVar("Result")


@final
class JobCancelled(Exception):
    """Raised inside the work function to stop it."""


@final
@dataclass(frozen=True)
class JobProgress:
    """The progress of a job."""

    state: Literal["waiting", "working"]
    ahead: int
    """Number of waiting and running jobs before this job; 0 while this job runs."""
    share: float
    """The completed fraction, 0 to 1."""
    levels: int = 0
    """How many times the layers of a burst so far can be shown, each time with more detail: see
    `JobQueue.layers`.
    """
    is_measuring: bool = False
    """Whether the motion or the light of several photos, or of a film, is measured."""
    preparing: float | None = None
    """While the first film after an installation waits for the compilation of what it needs: the
    completed fraction of that, 0 to 1. None otherwise.
    """


@final
@dataclass(eq=False)
class SeparationJob:
    """One job. It exists from the reservation of its place in the queue until its thread has
    finished.
    """

    share: float = 0.0
    is_working: bool = False
    levels: int = 0
    layers: bytes = b""
    """Of the last level, as a JPEG: T beside R."""
    is_measuring: bool = False
    future: Future[Any] | None = None
    cancelled: Event = field(default_factory=Event)

    def on_progress(self, share: float) -> None:
        """Records the completed fraction. Raises JobCancelled if the job is cancelled."""
        if self.cancelled.is_set():
            raise JobCancelled
        self.share = share

    def on_layers(self, layers: NDArray[np.float32]) -> None:
        """Keeps T and R so far, (2, h, w, 3) linear light."""
        beside = np.clip(np.concatenate(list(layers), axis=1), 0, 1)
        self.layers = Photo.from_array(beside, encoding="linear").encode("jpeg")
        self.levels += 1

    def run(self, work: Callable[[ProgressCallback], Result]) -> Result:
        """Runs the work function and returns its result. This method is called in a worker
        thread.
        """
        self.on_progress(0)
        self.is_working = True
        return work(self.on_progress)


@final
class JobQueue:
    """Runs jobs of one event loop in worker threads. A job waits and runs for at most
    `timeout_seconds`; if `max_waiting` jobs wait, further ones are refused.
    """

    def __init__(
        self, *, workers: int = 1, max_waiting: int = 16, timeout_seconds: float = 300
    ) -> None:
        self.workers = workers
        self.max_waiting = max_waiting
        self.timeout_seconds = timeout_seconds
        self._pool: ThreadPoolExecutor | None = None
        self._jobs: dict[object, SeparationJob] = {}

    def close(self) -> None:
        """Cancels all jobs, and ends the threads: that of a running job ends when the job notices.
        A later job starts them again.
        """
        for job in list(self._jobs.values()):
            job.cancelled.set()
        if self._pool:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None

    @property
    def job_count(self) -> int:
        """Number of waiting and running jobs."""
        return len(self._jobs)

    def progress(self, name: str) -> JobProgress | None:
        """Returns the progress of the job with this name, or None if there is no such job."""
        job = self._jobs.get(name)
        names = list(self._jobs)  # another thread may remove a job at any time
        if job is None or name not in names:
            return None
        ahead = 0 if job.is_working else names.index(name)
        return JobProgress(
            state="working" if job.is_working else "waiting",
            ahead=ahead,
            share=job.share,
            levels=job.levels,
            is_measuring=job.is_measuring,
        )

    def layers(self, name: str) -> bytes | None:
        """Returns the layers of the last level of the job with this name as a JPEG, T beside R, or
        None if there are none.
        """
        job = self._jobs.get(name)
        return job.layers if job and job.layers else None

    @contextmanager
    def reserve(self, name: str | None = None) -> Iterator[SeparationJob]:
        """Reserves a place for a job, before its upload is read. Raises HTTPException 503 if the
        queue is full, and 409 if a job with this name exists.

        The place is released at the end of the `with` block, or later, when the thread of the job
        has finished.
        """
        if self.job_count >= self.workers + self.max_waiting:
            raise HTTPException(
                503,
                f"the queue is full with {self.job_count} photos; expected a free place; try "
                "again in a few seconds",
                {"Retry-After": "5"},
            )
        if name in self._jobs:
            raise HTTPException(
                409,
                f"a job with the name {name} exists already; expected a new name; choose another "
                "name",
            )
        job = SeparationJob()
        key = name or object()
        self._jobs[key] = job
        try:
            yield job
        finally:
            job.cancelled.set()
            if job.future is None or job.future.cancel():
                del self._jobs[key]
            else:
                job.future.add_done_callback(lambda _: self._jobs.pop(key))

    async def run_job(
        self, job: SeparationJob, work: Callable[[ProgressCallback], Result], receive: Receive
    ) -> Result:
        """Runs a work function in a worker thread, and returns its result. Raises HTTPException 504
        if the time limit is exceeded, and ClientDisconnect if the client has disconnected, as
        `receive` of the request (ASGI) reports.
        """

        async def wait_for_disconnect() -> None:
            while (await receive())["type"] != "http.disconnect":
                pass

        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.workers, thread_name_prefix="brewster-job")
        future: Future[Result] = self._pool.submit(job.run, work)
        job.future = future
        result = asyncio.wrap_future(future)
        disconnected = asyncio.ensure_future(wait_for_disconnect())
        try:
            done, _ = await asyncio.wait(
                (result, disconnected),
                timeout=self.timeout_seconds,
                return_when=asyncio.FIRST_COMPLETED,
            )
            if result in done:
                return result.result()
            if disconnected in done:
                raise ClientDisconnect
            raise HTTPException(
                504,
                f"the separation did not finish within {self.timeout_seconds:g} seconds, including "
                "the waiting time; expected it to finish in this time; try a smaller photo or "
                "quality draft",
            )
        finally:
            job.cancelled.set()
            result.cancel()
            disconnected.cancel()
