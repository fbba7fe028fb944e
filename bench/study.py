"""Tests that no acknowledged answer is lost when the server of a study is killed while participants
answer.

    .venv/bin/python bench/study.py

A hundred participants answer concurrently over HTTP, on the loopback interface. The server is
`brewster study serve` in a separate process, which is killed with SIGKILL ten times. Then the
acknowledged answers are compared with the database.
"""

import asyncio
import os
import random
import shutil
import signal
import socket
import sqlite3
import statistics
import sys
import time
from pathlib import Path

import httpx
import numpy as np

from brewster import Photo
from brewster.evaluation.study.create import create_study
from brewster.evaluation.study.report.participants import ExclusionRule, collect_answers
from brewster.evaluation.study.report.results import summarise
from brewster.evaluation.study.store import AnswerStore

OUT = Path("out/bench/study")
PARTICIPANTS = 100
KILLS = 10
IMAGE_COUNTS = {"real": 20, "nature": 20, "postcard": 20, "solidobject": 20, "wildscene": 101}


class Server:
    """The server process. It can be killed and started again on the same port."""

    def __init__(self, folder):
        self.folder = folder
        self.kills = 0
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]

    async def start(self):
        command = ["-m", "brewster", "study", "serve", str(self.folder), "--port", str(self.port)]
        self.process = await asyncio.create_subprocess_exec(
            sys.executable,
            *command,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
        )
        await self.process.stdout.readline()

    async def kill(self):
        os.kill(self.process.pid, signal.SIGKILL)
        await self.process.wait()
        self.kills += 1


class Participants:
    """All participants together: their acknowledged answers, response times and repeated
    requests.
    """

    def __init__(self, port):
        self.url = f"http://127.0.0.1:{port}"
        self.acknowledged = {}
        self.links = set()
        self.times = []
        self.retries = 0

    async def request(self, client, method, path, **options):
        """Sends a request, and repeats it while the server does not respond. Returns the
        response.
        """
        while True:
            try:
                return await client.request(method, f"{self.url}{path}", **options)
            except httpx.TransportError:
                self.retries += 1
                await asyncio.sleep(0.2)

    async def take_part(self, number):
        rng = random.Random(number)
        async with httpx.AsyncClient(timeout=60) as client:
            link = (
                await self.request(client, "POST", "/participants", json={"agreed": True})
            ).json()["link"]
            self.links.add(link)
            state = (await self.request(client, "GET", f"{link}/trial")).json()
            while (trial := state["trial"]) is not None:
                for side in ("photo", "left", "right"):
                    await self.request(client, "GET", f"{link}/pictures/{trial}/{side}")
                choice = rng.choice(["left", "similar", "right"])
                started = time.perf_counter()
                sent = {"trial": trial, "choice": choice, "seconds": 3.0}
                answer = (await self.request(client, "POST", f"{link}/answers", json=sent)).json()
                self.times.append(time.perf_counter() - started)
                self.acknowledged[link, trial] = choice, answer["kept"]
                state = answer["next"]


def create_large_study(folder):
    """Creates a study with 181 images, as in the paper, and three methods. The images are small and
    random.
    """
    rng = np.random.default_rng(1)
    for part in ("inputs", "ours", "RDNet", "DSIT"):
        for name, count in IMAGE_COUNTS.items():
            (folder / part / name).mkdir(parents=True)
            for i in range(count):
                blocks = np.kron(rng.integers(0, 256, (6, 8, 3)), np.ones((20, 20, 1))).astype(
                    np.uint8
                )
                Photo.from_array(blocks, encoding="srgb").save(folder / part / name / f"{i}.png")
    methods = {name: folder / name for name in ("ours", "RDNet", "DSIT")}
    return create_study(folder / "study", folder / "inputs", methods, seed=1)


async def run(study):
    """Runs all participants and kills the server. Returns the participants, the number of kills,
    and the seconds.
    """
    server = Server(study.folder)
    await server.start()
    participants = Participants(server.port)
    started = time.perf_counter()
    sessions = [
        asyncio.create_task(participants.take_part(number)) for number in range(PARTICIPANTS)
    ]
    total = PARTICIPANTS * (study.description.pairs + study.description.catch_trials)
    for kill in range(1, KILLS + 1):
        while len(participants.acknowledged) < total * kill / (KILLS + 1):
            await asyncio.sleep(0.01)
        await server.kill()
        await server.start()
    await asyncio.gather(*sessions)
    seconds = time.perf_counter() - started
    await server.kill()
    return participants, server.kills - 1, seconds


def main():
    shutil.rmtree(OUT, ignore_errors=True)
    study = create_large_study(OUT)
    participants, kills, seconds = asyncio.run(run(study))
    with sqlite3.connect(study.answers_file) as database:
        integrity = database.execute("PRAGMA integrity_check").fetchone()[0]
        rows = database.execute(
            "SELECT '/s/' || token, trial, choice FROM answers JOIN participants ON number = "
            "participant"
        ).fetchall()
    stored = {(link, trial): choice for link, trial, choice in rows}
    answers = collect_answers(AnswerStore(study).all_answers())
    results = summarise(study, answers, ExclusionRule(1.0, 0.0))
    count = len(participants.acknowledged)
    median = statistics.median(participants.times)
    percentile_99 = statistics.quantiles(participants.times, n=100)[98]
    lines = {
        "concurrent participants": PARTICIPANTS,
        "kills of the server (SIGKILL)": kills,
        "answers acknowledged": count,
        "acknowledged and missing": sum(key not in stored for key in participants.acknowledged),
        "stored differently than acknowledged": sum(
            stored.get(key) != acknowledged
            for key, (_, acknowledged) in participants.acknowledged.items()
        ),
        "acknowledged differently than sent": sum(
            sent != acknowledged for sent, acknowledged in participants.acknowledged.values()
        ),
        "stored twice": len(rows) - len(stored),
        "stored and never acknowledged": sum(
            key not in participants.acknowledged for key in stored
        ),
        "repeated requests": participants.retries,
        "integrity check of the database": integrity,
        "participants in the report": results["everyone"]["participants"],
        "answers per second": f"{count / seconds:.0f} (kills, restarts and {3 * count} images "
        "included)",
        "response time, median and 99 %": f"{1000 * median:.0f} ms, {1000 * percentile_99:.0f} ms",
    }
    for name, value in lines.items():
        print(f"{name:34} {value}")


if __name__ == "__main__":
    main()
