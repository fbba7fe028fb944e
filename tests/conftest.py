"""Every test runs offline, with one thread (two shared cores spin against each other), and leaves no trace."""

import io
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("VIPS_CONCURRENCY", "1")

import socket
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from shape_checks import check_shapes

check_shapes()

from brewster import Photo  # noqa: E402
from brewster.cli import main  # noqa: E402
from front_door import write_pane  # noqa: E402

RECIPES = Path(__file__).parents[1] / "recipes"

hypothesis.settings.register_profile("shared machine", deadline=None)
hypothesis.settings.load_profile("shared machine")


@pytest.fixture(autouse=True)
def _network_off(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: socket.socket, address: object) -> None:
        raise AssertionError(f"a test tried to reach {address}")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket.socket, "connect_ex", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", lambda *address, **_: refuse(None, address))


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def data() -> Path:
    """The shared data; BREWSTER_DATA or ../shared/data, else the test is skipped."""
    named = os.environ.get("BREWSTER_DATA") or Path(__file__).parents[2] / "shared" / "data"
    folder = Path(named).resolve()
    if not folder.is_dir():
        pytest.skip(f"no data: {folder} does not exist, and BREWSTER_DATA names no other folder")
    return folder


@pytest.fixture(scope="session")
def model(tmp_path_factory):
    return write_pane(tmp_path_factory.mktemp("model") / "pane.onnx")


@pytest.fixture
def run(model, monkeypatch, tmp_path, capfdbinary):
    """Runs a command in an empty folder: exit code, standard output (bytes) and standard error (text)."""
    monkeypatch.chdir(tmp_path)

    def run(*args, stdin=b"", with_model=True):
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(stdin)))
        code = main([*map(str, args), *(["--model", str(model)] if with_model else [])])
        out, err = capfdbinary.readouterr()
        return code, out, err.decode()

    return run


@pytest.fixture
def bare(run):
    """The same for commands that take no model."""
    return lambda *args: run(*args, with_model=False)


@pytest.fixture
def recipe(tmp_path, monkeypatch, random):
    """The tiny training recipe, with three photos to learn from."""
    from brewster.train.recipe import read_recipe  # noqa: PLC0415  (wakes torch)

    folder = tmp_path / "data" / "photos" / "permissive"
    folder.mkdir(parents=True)
    for index in range(3):
        picture = np.kron(random.integers(0, 256, (5, 7, 3)), np.ones((20, 20, 1))).astype(np.uint8)
        Photo.from_array(picture, encoding="srgb").save(folder / f"{index}.png")
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path / "data"))
    return read_recipe(RECIPES / "train/tiny.toml")


@pytest.fixture
def rendered(monkeypatch):
    """A recipe that renders; its worlds are computed once, as that takes longer than all the rest."""
    from brewster.train.recipe import read_recipe  # noqa: PLC0415
    from brewster.worlds.assets import Assets  # noqa: PLC0415

    assets = Assets()
    monkeypatch.setattr("brewster.train.data.Assets", lambda folders: assets)
    monkeypatch.delenv("BREWSTER_DATA", raising=False)
    return read_recipe(RECIPES / "ablations/tiny.toml")
