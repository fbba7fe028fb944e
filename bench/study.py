"""A hundred participants at once over HTTP, and the server killed with -9 ten times: is any acknowledged answer lost?

    .venv/bin/python bench/study.py

The server is `brewster study serve` in a process of its own, on the loopback. What participants were told is compared
with what lies in the database afterwards.
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
from brewster.user_study.create import StudyOptions, create
from brewster.user_study.report.participants import ExclusionRule, collect_answers
from brewster.user_study.report.results import summarise
from brewster.user_study.store import AnswerStore

OUT = Path("out/bench/study")
PEOPLE, KILLS = 100, 10
SETS = {"real": 20, "nature": 20, "postcard": 20, "solidobject": 20, "wildscene": 101}


class Server:
    """The server, which can be killed and started again on the same port."""

    def __init__(self, folder):
        self.folder, self.kills = folder, 0
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]

    async def start(self):
        command = ["-m", "brewster", "study", "serve", str(self.folder), "--port", str(self.port)]
        self.process = await asyncio.create_subprocess_exec(
            sys.executable, *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL
        )
        await self.process.stdout.readline()

    async def kill(self):
        os.kill(self.process.pid, signal.SIGKILL)
        await self.process.wait()
        self.kills += 1


class Crowd:
    """What all participants together were told, and how long it took."""

    def __init__(self, port):
        self.url, self.told, self.links, self.times, self.retries = (
            f"http://127.0.0.1:{port}",
            {},
            set(),
            [],
            0,
        )

    async def ask(self, client, method, path, **what):
        """The answer, asked for again and again while there is no server."""
        while True:
            try:
                return await client.request(method, f"{self.url}{path}", **what)
            except httpx.TransportError:
                self.retries += 1
                await asyncio.sleep(0.2)

    async def take_part(self, number):
        dice = random.Random(number)
        async with httpx.AsyncClient(timeout=60) as client:
            link = (await self.ask(client, "POST", "/participants", json={"agreed": True})).json()["link"]
            self.links.add(link)
            state = (await self.ask(client, "GET", f"{link}/trial")).json()
            while (trial := state["trial"]) is not None:
                for side in ("photo", "left", "right"):
                    await self.ask(client, "GET", f"{link}/pictures/{trial}/{side}")
                choice = dice.choice(["left", "similar", "right"])
                started = time.perf_counter()
                given = {"trial": trial, "choice": choice, "seconds": 3.0}
                answer = (await self.ask(client, "POST", f"{link}/answers", json=given)).json()
                self.times.append(time.perf_counter() - started)
                self.told[link, trial] = choice, answer["kept"]
                state = answer["next"]


def make(folder):
    """The paper's 181 pictures and three methods, all of them random and small."""
    dice = np.random.default_rng(1)
    for part in ("inputs", "ours", "RDNet", "DSIT"):
        for name, count in SETS.items():
            (folder / part / name).mkdir(parents=True)
            for i in range(count):
                blocks = np.kron(dice.integers(0, 256, (6, 8, 3)), np.ones((20, 20, 1))).astype(np.uint8)
                Photo.from_array(blocks, encoding="srgb").save(folder / part / name / f"{i}.png")
    methods = {name: folder / name for name in ("ours", "RDNet", "DSIT")}
    return create(folder / "study", folder / "inputs", methods, StudyOptions(seed=1))


async def run(study):
    server = Server(study.folder)
    await server.start()
    crowd = Crowd(server.port)
    started = time.perf_counter()
    visits = [asyncio.create_task(crowd.take_part(number)) for number in range(PEOPLE)]
    total = PEOPLE * (study.description.pairs + study.description.catches)
    for kill in range(1, KILLS + 1):
        while len(crowd.told) < total * kill / (KILLS + 1):
            await asyncio.sleep(0.01)
        await server.kill()
        await server.start()
    await asyncio.gather(*visits)
    seconds = time.perf_counter() - started
    await server.kill()
    return crowd, server.kills - 1, seconds


def main():
    shutil.rmtree(OUT, ignore_errors=True)
    study = make(OUT)
    crowd, kills, seconds = asyncio.run(run(study))
    with sqlite3.connect(study.answers_file) as database:
        whole = database.execute("PRAGMA integrity_check").fetchone()[0]
        rows = database.execute(
            "SELECT '/s/' || token, trial, choice FROM answers JOIN participants ON number = participant"
        ).fetchall()
    kept = {(link, trial): choice for link, trial, choice in rows}
    answered = collect_answers(AnswerStore(study).all_answers())
    results = summarise(study, answered, ExclusionRule(1.0, 0.0))
    slowest = statistics.quantiles(crowd.times, n=100)[98]
    lines = {
        "participants at once": PEOPLE,
        "kill -9": kills,
        "answers acknowledged": len(crowd.told),
        "acknowledged and missing": sum(place not in kept for place in crowd.told),
        "acknowledged otherwise than kept": sum(
            kept.get(place) != told for place, (_, told) in crowd.told.items()
        ),
        "kept otherwise than given": sum(given != told for given, told in crowd.told.values()),
        "kept twice": len(rows) - len(kept),
        "kept and never acknowledged": sum(place not in crowd.told for place in kept),
        "requests sent again": crowd.retries,
        "database": whole,
        "participants in the report": results["everyone"]["participants"],
        "answers per second": f"{len(crowd.told) / seconds:.0f} (kills, restarts and {3 * len(crowd.told)} pictures included)",
        "an answer, median and 99 %": f"{1000 * statistics.median(crowd.times):.0f} ms, {1000 * slowest:.0f} ms",
    }
    for name, value in lines.items():
        print(f"{name:34} {value}")


if __name__ == "__main__":
    main()
