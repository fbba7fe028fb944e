"""The job queue: limits, time limit, cancellation and progress."""

import asyncio
import contextlib
import threading
from threading import Event

import numpy as np
import pytest
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from brewster import Photo
from brewster.web.job_queue import JobCancelled, JobQueue


class BlockingWork:
    """Work that waits for `proceed` and records how it ended."""

    def __init__(self):
        self.started = Event()
        self.proceed = Event()
        self.ended = []

    def __call__(self, on_progress):
        self.started.set()
        on_progress(0.25)
        self.proceed.wait(30)
        try:
            on_progress(0.5)
        except JobCancelled:
            self.ended.append("stopped")
            raise
        self.ended.append("done")
        return "result"


class Client:
    """A client that stays connected until `disconnected` is set."""

    def __init__(self):
        self.disconnected = asyncio.Event()

    async def __call__(self):
        await self.disconnected.wait()
        return {"type": "http.disconnect"}


async def submit(job_queue, work, client=None, name=None):
    with job_queue.reserve(name) as job:
        return await job_queue.run_job(job, work, client or Client())


async def wait_until(condition):
    while not condition():
        await asyncio.sleep(0.001)


def job_threads():
    return [one for one in threading.enumerate() if one.name.startswith("brewster-job")]


def test_closing_stops_the_running_job_and_the_waiting_ones_and_ends_the_threads():
    before = job_threads()

    async def scenario(job_queue, works):
        tasks = [asyncio.create_task(submit(job_queue, work)) for work in works]
        await wait_until(works[0].started.is_set)
        job_queue.close()
        for work in works:
            work.proceed.set()
        return await asyncio.gather(*tasks, return_exceptions=True)

    works = [BlockingWork(), BlockingWork()]
    job_queue = JobQueue()
    running, waiting = asyncio.run(scenario(job_queue, works))
    assert isinstance(running, JobCancelled)
    assert isinstance(waiting, asyncio.CancelledError)
    assert works[0].ended == ["stopped"]
    assert not works[1].started.is_set()
    assert job_queue.job_count == 0
    assert asyncio.run(submit(job_queue, lambda _: "again")) == "again"
    job_queue.close()
    for thread in set(job_threads()) - set(before):
        thread.join(30)
        assert not thread.is_alive()


def test_an_exception_of_the_work_is_raised():
    def raise_error(on_progress):
        raise KeyError("the error")

    with pytest.raises(KeyError, match="the error"):
        asyncio.run(submit(JobQueue(), raise_error))


def test_a_full_queue_refuses_with_retry_after():
    async def scenario(job_queue, work):
        waiting = [asyncio.create_task(submit(job_queue, work)) for _ in range(3)]
        await wait_until(lambda: job_queue.job_count == 3)
        with pytest.raises(HTTPException, match="full with 3 photos") as refused:
            await submit(job_queue, work)
        work.proceed.set()
        assert await asyncio.gather(*waiting) == ["result"] * 3
        return refused.value

    refused = asyncio.run(scenario(JobQueue(workers=1, max_waiting=2), BlockingWork()))
    assert refused.status_code == 503
    assert int(refused.headers["Retry-After"]) > 0


def test_a_client_that_disconnects_stops_its_own_work_only():
    async def scenario(job_queue, work, other):
        client = Client()
        leaving = asyncio.create_task(submit(job_queue, work, client))
        staying = asyncio.create_task(submit(job_queue, other))
        await wait_until(work.started.is_set)
        client.disconnected.set()
        with pytest.raises(ClientDisconnect):
            await leaving
        assert job_queue.job_count == 2  # the thread still runs and uses memory
        work.proceed.set()
        other.proceed.set()
        assert await staying == "result"

    work = BlockingWork()
    other = BlockingWork()
    asyncio.run(scenario(JobQueue(), work, other))
    assert (work.ended, other.ended) == (["stopped"], ["done"])


def test_waiting_work_whose_client_disconnects_never_starts():
    async def scenario(job_queue, work, late):
        first = asyncio.create_task(submit(job_queue, work))
        await wait_until(work.started.is_set)
        client = Client()
        second = asyncio.create_task(submit(job_queue, late, client))
        await wait_until(lambda: job_queue.job_count == 2)
        client.disconnected.set()
        with pytest.raises(ClientDisconnect):
            await second
        assert job_queue.job_count == 1
        work.proceed.set()
        await first

    late = BlockingWork()
    asyncio.run(scenario(JobQueue(), BlockingWork(), late))
    assert not late.started.is_set()


def test_work_that_takes_too_long_is_stopped():
    async def scenario(job_queue, work):
        with pytest.raises(HTTPException, match="did not finish within") as refused:
            await submit(job_queue, work)
        assert refused.value.status_code == 504
        work.proceed.set()
        await wait_until(lambda: not job_queue.job_count)

    work = BlockingWork()
    asyncio.run(scenario(JobQueue(timeout_seconds=0.01), work))
    assert work.ended == ["stopped"]


def test_cancelling_the_request_cancels_the_work():
    async def scenario(job_queue, work):
        task = asyncio.create_task(submit(job_queue, work))
        await wait_until(work.started.is_set)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        work.proceed.set()
        await wait_until(lambda: not job_queue.job_count)

    work = BlockingWork()
    asyncio.run(scenario(JobQueue(), work))
    assert work.ended == ["stopped"]


def test_progress_contains_the_place_in_the_queue_and_the_share():
    async def scenario(job_queue, works):
        jobs = [submit(job_queue, work, name=f"job-{number}") for number, work in enumerate(works)]
        tasks = [asyncio.create_task(job) for job in jobs]
        await wait_until(lambda: job_queue.job_count == 3)
        for number in range(job_queue.workers):
            await wait_until(lambda name=f"job-{number}": job_queue.progress(name).share == 0.25)
        progress = [job_queue.progress(f"job-{number}") for number in range(3)]
        for work in works:
            work.proceed.set()
        await asyncio.gather(*tasks)
        assert job_queue.progress("job-0") is None
        return [(row.state, row.ahead) for row in progress]

    for workers, ahead in ((1, [0, 1, 2]), (2, [0, 0, 2])):
        works = [BlockingWork(), BlockingWork(), BlockingWork()]
        progress = asyncio.run(scenario(JobQueue(workers=workers), works))
        states = ["working"] * workers + ["waiting"] * (3 - workers)
        assert progress == [*zip(states, ahead, strict=True)]


def test_the_layers_of_a_job_so_far_stand_beside_each_other():
    job_queue = JobQueue()
    with job_queue.reserve("a job") as job:
        assert job_queue.layers("a job") is None
        layers = np.stack([np.full((24, 32, 3), light, np.float32) for light in (0.5, 0.1)])
        job.on_layers(layers)
        assert job_queue.progress("a job").levels == 1
        shown = Photo.open(job_queue.layers("a job")).linear()
        np.testing.assert_allclose(shown[:, :30], layers[0][:, :30], atol=0.01)
        np.testing.assert_allclose(shown[:, 34:], layers[1][:, 2:], atol=0.01)
        job.on_layers(0.5 * layers)
        job.on_layers(0.2 * layers)  # the page asks for each level once
        assert job_queue.progress("a job").levels == 3
        shown = Photo.open(job_queue.layers("a job")).linear()
        np.testing.assert_allclose(shown[:, :30], 0.2 * layers[0][:, :30], atol=0.01)
    assert job_queue.layers("a job") is None
