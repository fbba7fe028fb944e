import asyncio
import contextlib
from threading import Event

import pytest
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from brewster.web.job_queue import JobCancelled, JobQueue


class Busy:
    """Work that goes on until it is let go, and tells how it ended."""

    def __init__(self):
        self.started, self.go, self.ended = Event(), Event(), []

    def __call__(self, on_progress):
        self.started.set()
        on_progress(0.25)
        self.go.wait(30)
        try:
            on_progress(0.5)
        except JobCancelled:
            self.ended.append("stopped")
            raise
        self.ended.append("done")
        return "answer"


class Client:
    """A client that stays on the line until it hangs up."""

    def __init__(self):
        self.hung_up = asyncio.Event()

    async def __call__(self):
        await self.hung_up.wait()
        return {"type": "http.disconnect"}


async def hand_in(desk, work, client=None, name=None):
    with desk.place(name) as job:
        return await desk.do(job, work, client or Client())


async def until(is_so):
    while not is_so():
        await asyncio.sleep(0.001)


def test_work_is_answered_and_leaves_its_place():
    async def day(desk, work):
        work.go.set()
        assert await hand_in(desk, work) == "answer"
        await until(lambda: not desk.jobs)

    asyncio.run(day(JobQueue(), Busy()))


def test_what_the_work_raises_comes_out():
    def fails(on_progress):
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        asyncio.run(hand_in(JobQueue(), fails))


def test_a_full_queue_sends_away_with_a_time_to_come_back():
    async def day(desk, work):
        waiting = [asyncio.create_task(hand_in(desk, work)) for _ in range(3)]
        await until(lambda: desk.jobs == 3)
        with pytest.raises(HTTPException, match="3 photos are waiting") as refused:
            await hand_in(desk, work)
        work.go.set()
        assert await asyncio.gather(*waiting) == ["answer"] * 3
        return refused.value

    refused = asyncio.run(day(JobQueue(workers=1, queue=2), Busy()))
    assert refused.status_code == 503
    assert int(refused.headers["Retry-After"]) > 0


def test_a_client_that_hangs_up_stops_its_work_and_no_other():
    async def day(desk, work, other):
        client = Client()
        leaving = asyncio.create_task(hand_in(desk, work, client))
        staying = asyncio.create_task(hand_in(desk, other))
        await until(work.started.is_set)
        client.hung_up.set()
        with pytest.raises(ClientDisconnect):
            await leaving
        assert desk.jobs == 2  # its thread has not noticed yet, and memory is still used
        work.go.set()
        other.go.set()
        assert await staying == "answer"

    work, other = Busy(), Busy()
    asyncio.run(day(JobQueue(), work, other))
    assert (work.ended, other.ended) == (["stopped"], ["done"])


def test_work_that_still_waits_when_its_client_hangs_up_is_never_begun():
    async def day(desk, work, late):
        first = asyncio.create_task(hand_in(desk, work))
        await until(work.started.is_set)
        client = Client()
        second = asyncio.create_task(hand_in(desk, late, client))
        await until(lambda: desk.jobs == 2)
        client.hung_up.set()
        with pytest.raises(ClientDisconnect):
            await second
        assert desk.jobs == 1
        work.go.set()
        await first

    late = Busy()
    asyncio.run(day(JobQueue(), Busy(), late))
    assert not late.started.is_set()


def test_work_that_takes_too_long_is_stopped():
    async def day(desk, work):
        with pytest.raises(HTTPException, match="it took longer") as refused:
            await hand_in(desk, work)
        assert refused.value.status_code == 504
        work.go.set()
        await until(lambda: not desk.jobs)

    work = Busy()
    asyncio.run(day(JobQueue(seconds=0.01), work))
    assert work.ended == ["stopped"]


def test_a_server_that_ends_stops_the_work():
    async def day(desk, work):
        task = asyncio.create_task(hand_in(desk, work))
        await until(work.started.is_set)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        work.go.set()
        await until(lambda: not desk.jobs)

    work = Busy()
    asyncio.run(day(JobQueue(), work))
    assert work.ended == ["stopped"]


def test_progress_tells_the_place_in_the_queue_and_the_share_done():
    async def day(desk, works):
        tasks = [
            asyncio.create_task(hand_in(desk, work, name=f"job-{number}"))
            for number, work in enumerate(works)
        ]
        await until(lambda: desk.jobs == 3 and desk.progress("job-0").share == 0.25)
        told = [desk.progress(f"job-{number}") for number in range(3)]
        for work in works:
            work.go.set()
        await asyncio.gather(*tasks)
        assert desk.progress("job-0") is None
        return [(progress.state, progress.ahead) for progress in told]

    told = asyncio.run(day(JobQueue(), [Busy(), Busy(), Busy()]))
    assert told == [("working", 0), ("waiting", 1), ("waiting", 2)]


def test_two_jobs_cannot_have_one_name():
    desk = JobQueue()
    with desk.place("one"):
        with pytest.raises(HTTPException, match="choose another name"), desk.place("one"):
            pass
        assert desk.jobs == 1
    assert not desk.jobs


def test_a_place_whose_upload_fails_is_free_again():
    desk = JobQueue()
    with pytest.raises(OSError, match="cut"), desk.place():
        raise OSError("cut")
    assert not desk.jobs
