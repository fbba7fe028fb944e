"""The list of `make mutants` matches the code. Running the mutants takes minutes and is not done here."""

import importlib
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "bench"))
mutants = importlib.import_module("mutants")
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
