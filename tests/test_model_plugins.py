"""Models of other packages: a package of ten lines is built, installed and used everywhere."""

import json
import os
import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.errors import ModelError
from brewster.evaluation.methods import ModelMethod
from brewster.separation import registry
from brewster.web.model_cache import ModelCache
from other_processes import finished

ROOT = Path(__file__).parents[1]
EXAMPLE, SETTINGS = (
    re.search(rf"```{language}\n(# {name}\n.*?)```", (ROOT / "docs/models.md").read_text(), re.S)[1]
    for language, name in (("python", "brewster_halves.py"), ("toml", "pyproject.toml"))
)
BROKEN = {
    "rusty": "import nonsuch_library\n",
    "greedy": EXAMPLE.replace('"halves"', '"compact"'),
    "vague": "def register(add):\n    add('vague')\n",
    "late": EXAMPLE.replace('"halves"', '"late"').replace("return Separator(", "return nonsuch("),
}
pytestmark = pytest.mark.timeout(300)  # packages are built in other processes


@pytest.fixture(scope="module")
def plugins(tmp_path_factory):
    """A folder in which the example of docs/models.md and four broken packages are installed."""
    sources = tmp_path_factory.mktemp("packages")
    target = sources / "installed"
    for name, code in {"halves": EXAMPLE, **BROKEN}.items():
        folder = sources / name
        folder.mkdir()
        (folder / f"brewster_{name}.py").write_text(code)
        (folder / "pyproject.toml").write_text(SETTINGS.replace("halves", name))
    options = ["--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--target", target]
    folders = [sources / name for name in ("halves", *BROKEN)]
    process = finished([sys.executable, "-m", "pip", "install", *options, *folders])
    assert process.returncode == 0, process.stderr
    return target


@pytest.fixture
def environment(plugins):
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(plugins), str(ROOT / "src")])}


@pytest.fixture
def installed(plugins, monkeypatch):
    """The packages, in this process."""
    monkeypatch.syspath_prepend(plugins)
    registry._plugins.cache_clear()
    yield
    registry._plugins.cache_clear()


@pytest.fixture
def photo(tmp_path, rng):
    path = tmp_path / "photo.png"
    Photo.from_array(rng.integers(20, 200, (48, 64, 3), np.uint8), encoding="srgb").save(path)
    return path


def test_the_command_line_separates_with_the_model_of_a_package(environment, photo):
    command = [sys.executable, "-m", "brewster"]
    process = finished([*command, photo, "--model", "halves", "--json"], env=environment)
    assert process.returncode == 0, process.stderr
    light, transmission, reflection = (
        Photo.open(photo.with_suffix(suffix)).linear()
        for suffix in (".png", ".transmission.png", ".reflection.png")
    )
    np.testing.assert_allclose(transmission, light / 2, atol=0.01)
    np.testing.assert_allclose(reflection, light / 2, atol=0.01)
    process = finished([*command, photo, "--model", "halvs"], env=environment)
    assert process.returncode == 1
    assert "did you mean halves?" in process.stderr
    assert "nonsuch_library" in process.stderr  # perhaps its package has the model


def test_models_list_shows_the_models_of_packages_and_the_broken_ones(environment):
    command = [sys.executable, "-m", "brewster", "models", "list"]
    process = finished(command, env=environment)
    assert process.returncode == 0, process.stderr
    names = [line.split()[0] for line in process.stdout.splitlines() if line[0] != " "]
    assert set(names) == {"name", "halves", "late", *registry.registered()}
    assert "the package brewster-halves" in process.stdout
    errors = [line for line in process.stderr.splitlines() if line.startswith("error: ")]
    for name in ("rusty", "greedy", "vague"):
        assert sum(f"brewster-{name} " in line for line in errors) == 1
    rows = json.loads(finished([*command, "--json"], env=environment).stdout)
    (halves,) = (row for row in rows if row["name"] == "halves")
    assert halves["licence"] == "MIT"
    assert halves["package"] == "brewster-halves"


def test_a_model_of_a_package_has_only_the_options_that_it_names(installed):
    with pytest.raises(ModelError, match="steps was set for the model halves"):
        Separator.load("halves", steps=3)
    assert Separator.load("halves", device="cpu").name == "halves"


def test_a_model_that_fails_to_load_names_its_package_and_breaks_no_other(installed, photo):
    with pytest.raises(ModelError, match=r"the package brewster-late failed .*nonsuch"):
        Separator.load("late")
    assert Separator.load("halves")(photo).model == "halves"
    assert Separator.load("compact").name == "compact"


def register_twin(add):
    class Twin(registry.Model):
        name = "twin"
        licence = "MIT"

        def load(self, device, **options):
            return Separator(lambda tile: (tile, 0 * tile), name=self.name)

    add(Twin())


def test_the_second_of_two_packages_with_models_of_one_name_is_reported(monkeypatch):
    points = [
        EntryPoint(name, f"{__name__}:register_twin", registry.GROUP) for name in ("one", "two")
    ]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda *, group: points)
    registry._plugins.cache_clear()
    try:
        assert "twin" in registry.registered()
        (error,) = registry.broken_packages()
        assert "there is a model twin already" in str(error)
    finally:
        registry._plugins.cache_clear()


def test_a_server_offers_the_models_of_packages(installed):
    cache = ModelCache()
    assert cache.names[0] == "compact"
    (row,) = (row for row in cache.rows() if row.name == "halves")
    assert (row.licence, row.card, row.sha256) == ("MIT", None, None)


def test_an_evaluation_needs_a_digest_by_which_stored_layers_are_found_again(installed, tmp_path):
    with pytest.raises(ModelError, match="halves has no SHA-256"):
        ModelMethod("halves", "halves", tmp_path).about()
    assert not ModelMethod("halves", "halves", tmp_path).exclusive


def test_the_models_of_brewster_need_no_metadata_of_an_installation(tmp_path):
    """As in a source tree that was copied."""
    (tmp_path / "brewster").symlink_to(ROOT / "src/brewster")
    code = (
        "import importlib.metadata as m; m.distribution = m.entry_points = None;"
        "import brewster; print(brewster.Separator.load('compact').name)"
    )
    process = finished(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(tmp_path)}, cwd=tmp_path
    )
    assert process.stdout.strip() == "compact", process.stderr
