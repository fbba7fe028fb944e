"""The scripts of bench/: the list of `make mutants` matches the code, and errors of the scripts.

Running the mutants takes minutes and is not done here.
"""

import importlib
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "bench"))
mutants, verdict = (importlib.import_module(name) for name in ("mutants", "verdict"))
MUTANTS = mutants.read_list()
MIN_MUTANTS = 60


def package(file):
    return Path(file).parts[0]


@pytest.mark.parametrize("mutant", MUTANTS, ids=str)
def test_every_mutant_can_be_applied_and_names_tests_that_exist(mutant):
    mutant.applied()
    assert mutant.tests
    assert all((ROOT / "tests" / test).is_file() for test in mutant.tests)


def test_no_mutant_is_listed_twice():
    assert len({(mutant.file, mutant.old, mutant.new) for mutant in MUTANTS}) == len(MUTANTS)


def test_every_package_has_mutants_in_proportion_to_its_size():
    """There are at least sixty, and each package has at least half of the number that is proportional to its lines."""
    lines = Counter()
    for path in (ROOT / mutants.PACKAGE).rglob("*.py"):
        lines[package(path.relative_to(ROOT / mutants.PACKAGE))] += len(path.read_text().splitlines())
    count = Counter(package(mutant.file) for mutant in MUTANTS)
    assert len(MUTANTS) >= MIN_MUTANTS
    too_few = [name for name, size in lines.items() if count[name] < MIN_MUTANTS * size / lines.total() // 2]
    assert not too_few


def test_a_pattern_without_a_mutant_is_an_error():
    with pytest.raises(ValueError, match="no mutant contains no such text"):
        mutants.main(["no such text"])


@pytest.mark.parametrize("exit_code", [pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED])
def test_a_mutant_with_which_pytest_finds_no_test_is_killed(tmp_path, monkeypatch, exit_code):
    """pytest finds no test if the mutation prevents the import of conftest.py."""
    monkeypatch.setattr(mutants, "_pytest", lambda *_: sys.exit(exit_code))
    assert mutants._run_tests(tmp_path / "copy", ["test_a.py"]) == (True, [])
    with pytest.raises(ValueError, match=r"pytest found no test in test_a\.py"):
        mutants._run_tests(tmp_path / "copy", ["test_a.py"], must_exist=True)


@pytest.mark.parametrize("count", [0, 5, 8, 201, 400])
def test_the_verdicts_are_measured_on_the_given_number_of_mixtures(monkeypatch, count):
    def stream(step, batch_size, size_px):
        images = torch.full((batch_size, 3, 2, 2), step / 255)
        return SimpleNamespace(photo_encoded=images, transmission_encoded=images)

    monkeypatch.setattr(verdict, "read_recipe", lambda _: None)
    monkeypatch.setattr(verdict, "held_out_mixtures", lambda _: stream)
    steps = [pixels[0, 0, 0] for _, pixels in verdict.mixtures(count)]
    assert steps == [index // 8 for index in range(count)]
