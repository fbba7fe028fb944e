"""Shared fixtures. Each test runs offline, without a GPU, and with one thread, because tests run in
parallel.
"""

import faulthandler
import io
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("VIPS_CONCURRENCY", "1")
os.environ["CUDA_VISIBLE_DEVICES"] = ""

import shutil
import socket
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from shape_checks import check_shapes

check_shapes()

from _pytest.faulthandler import fault_handler_stderr_fd_key  # noqa: E402

from brewster import Photo  # noqa: E402
from brewster.cli import main  # noqa: E402
from brewster.errors import MissingExtra  # noqa: E402
from cli_helpers import write_pane  # noqa: E402
from file_server import loopback_only  # noqa: E402

RECIPES = Path(__file__).parents[1] / "recipes"

hypothesis.settings.register_profile("shared machine", deadline=None)
hypothesis.settings.load_profile("shared machine")

BROWSER_SHARE = 0.8
"""The share of the time limit of a test after which the browser stops to wait. The signal of the
limit itself would interrupt the event loop of Playwright.
"""
SLOW_SECONDS = 1800
"""The time limit of a test marked as slow; the time limit of other tests is in pyproject.toml."""


def pytest_configure(config):
    config.addinivalue_line("markers", "loopback: connects to a server on this machine")


def pytest_collection_modifyitems(items):
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_SECONDS))


@pytest.hookimpl(trylast=True)
def pytest_exception_interact(node):
    """Starts the timer for tests that hang again: pytest stops it where a test fails, but its
    teardown can hang, too (findings/faulthandler_teardown.sh).
    """
    limit = float(node.config.getini("faulthandler_timeout") or 0)
    if limit and isinstance(node, pytest.Item):
        stderr = node.config.stash[fault_handler_stderr_fd_key]
        exits = node.config.getini("faulthandler_exit_on_timeout")
        faulthandler.dump_traceback_later(limit, file=stderr, exit=exits)


def pytest_terminal_summary(terminalreporter):
    """Prints how many tests were skipped, and what they need."""
    reports = terminalreporter.getreports("skipped")
    if not reports:
        return
    reasons = Counter(str(report.longrepr[2]).removeprefix("Skipped: ") for report in reports)
    terminalreporter.section(f"{len(reports)} tests skipped: how many, and what they need")
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count:5}  {reason}")


@pytest.fixture(autouse=True)
def _network_off(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuses every connection, or with the marker `loopback` every connection to another
    machine.
    """
    if request.node.get_closest_marker("loopback"):
        loopback_only(monkeypatch)
        return

    def refuse(self: socket.socket, address: object) -> None:
        raise AssertionError(f"a test tried to reach {address}")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket.socket, "connect_ex", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", lambda *address, **_: refuse(None, address))


@pytest.fixture(autouse=True)
def _ordinary_priority() -> Iterator[None]:
    """Fails a test after which this thread has another priority, which all later threads and
    processes inherit: as root, it starves every other process.
    """
    yield
    if hasattr(os, "sched_getscheduler"):
        assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def data() -> Path:
    """The data folder, BREWSTER_DATA or ../shared/data; without it, the test is skipped."""
    named = os.environ.get("BREWSTER_DATA") or Path(__file__).parents[2] / "shared" / "data"
    folder = Path(named).resolve()
    if not folder.is_dir():
        pytest.skip(f"no data: {folder} does not exist, and BREWSTER_DATA names no other folder")
    return folder


@pytest.fixture(scope="session")
def mitsuba():
    """Mitsuba, with one thread; the test is skipped if it cannot be imported."""
    from brewster.render.mitsuba import variant  # noqa: PLC0415

    try:
        with warnings.catch_warnings(
            action="ignore", category=RuntimeWarning
        ):  # about LLVM; see `requires_llvm`
            mitsuba = variant.load()
    except MissingExtra as error:
        pytest.skip(str(error))
    import drjit  # noqa: PLC0415  (only after variant.load has chosen the LLVM library)

    drjit.set_thread_count(1)
    return mitsuba


@pytest.fixture
def requires_llvm(mitsuba):
    """Skips the test if Mitsuba's kernels cannot be compiled."""
    from brewster.render.mitsuba import variant  # noqa: PLC0415

    if variant.probe().variant != variant.COMPILED:
        pytest.skip(f"no LLVM works for Mitsuba; run: {variant.INSTALL_LLVM}")


@pytest.fixture(autouse=True, scope="session")
def state_folder(tmp_path_factory):
    """Keeps what servers of tests store out of the folder of the user."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="module")
def chromium():
    """Headless Chromium; the test is skipped if it is not installed."""
    program = shutil.which("chromium")
    if not program:
        pytest.skip("no browser; run: apt install chromium")
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def page_link(model):
    """The link to a server of the page with two models."""
    from web_servers import serve_process  # noqa: PLC0415  (imports FastAPI)

    with serve_process("--model", model, "--token", "auto") as link:
        yield link


@pytest.fixture
def new_page(chromium, request):
    """Creates an empty page in its own context; an error in its scripts fails the test."""
    marker = request.node.get_closest_marker("timeout")
    limit = marker.args[0] if marker else float(request.config.getini("timeout"))
    contexts = []
    errors = []

    def new_page(**kwargs):
        contexts.append(chromium.new_context(**kwargs))
        contexts[-1].set_default_timeout(1000 * BROWSER_SHARE * limit)
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        return page

    yield new_page
    for context in contexts:
        context.close()
    assert not errors


@pytest.fixture
def open_page(new_page, page_link):
    """Opens the page; a violation of its security policy, or a request to another server, fails the
    test.
    """
    messages = []
    requested = []

    def open_page(**kwargs):
        page = new_page(
            **{"viewport": {"width": 1100, "height": 760}, "accept_downloads": True, **kwargs}
        )
        page.on("console", lambda message: messages.append(message.text))
        page.on("request", lambda request: requested.append(request.url))
        page.goto(page_link)
        page.wait_for_selector("#model option", state="attached")  # the scripts have run
        assert "token" not in page.url
        return page

    yield open_page
    assert not [text for text in messages if "Content Security" in text]
    here = page_link.partition("?")[0]
    assert [url for url in requested if not url.startswith((here, "blob:"))] == []


@pytest.fixture(scope="session")
def model(tmp_path_factory):
    return write_pane(tmp_path_factory.mktemp("model") / "pane.onnx")


@pytest.fixture
def run(model, monkeypatch, tmp_path, capfdbinary):
    """Runs a command in an empty folder, with the model of a pane. Returns (exit code, stdout,
    stderr).
    """
    monkeypatch.chdir(tmp_path)

    def run(*args, stdin=b"", with_model=True):
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(stdin)))
        code = main([*map(str, args), *(["--model", str(model)] if with_model else [])])
        out, err = capfdbinary.readouterr()
        return code, out, err.decode()

    return run


@pytest.fixture
def run_without_model(run):
    """Runs a command like `run`, but without the option --model."""
    return lambda *args: run(*args, with_model=False)


@pytest.fixture
def recipe(tmp_path, monkeypatch, rng):
    """The tiny training recipe, with three photos as training data."""
    from brewster.training.recipe import read_recipe  # noqa: PLC0415  (imports torch)

    folder = tmp_path / "data" / "photos" / "permissive"
    for index in range(3):
        picture = np.kron(rng.integers(0, 256, (5, 7, 3)), np.ones((20, 20, 1))).astype(np.uint8)
        Photo.from_array(picture, encoding="srgb").save(folder / f"{index}.png")
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path / "data"))
    return read_recipe(RECIPES / "train/tiny.toml")


@pytest.fixture
def rendered_recipe(monkeypatch):
    """A training recipe with rendered samples, which do not exist."""
    from brewster.training.recipe import read_recipe  # noqa: PLC0415

    monkeypatch.delenv("BREWSTER_DATA", raising=False)
    return read_recipe(RECIPES / "ablations/tiny.toml")


@pytest.fixture
def few_steps(monkeypatch):
    """For bursts in tests that do not measure the separation."""
    from brewster.film.motion.model.levels import SMALL_SEARCH, Level  # noqa: PLC0415  (needs the extra burst)
    from brewster.film.motion.solver import solve, solve_small_motion  # noqa: PLC0415

    few = (Level(48, 2, None),)
    monkeypatch.setattr("brewster.film.measuring.solve", partial(solve, search=few, levels=few))
    monkeypatch.setattr("brewster.film.motion.search.SMALL_SEARCH", replace(SMALL_SEARCH, steps=2))
    # After two steps, both layers still have the edges of the photo
    monkeypatch.setattr("brewster.film.self_check._MAX_EDGE_CORRELATION_IF_SMALL", 1.0)
    monkeypatch.setattr(
        "brewster.film.photo_film.solve_small_motion", partial(solve_small_motion, levels=few)
    )


@pytest.fixture
def store():
    """The empty memory store of fsspec, which behaves like S3 without a network."""
    memory = pytest.importorskip("fsspec").filesystem("memory")
    memory.store.clear()
    yield memory
    memory.store.clear()
