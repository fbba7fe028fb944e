"""Mutation testing: applies the faults of mutants.toml one at a time, and runs the tests that should fail.

    make mutants                                  # all mutants
    python bench/mutants.py losses render/rays    # the mutants with one of these texts in `file` or `old`

The tests run in a temporary copy of the tree. A mutant is killed if a test fails that passes without the mutation. If
all tests of a mutant together exceed the time limit, the mutant counts as killed. The tools mutmut and cosmic-ray are not used, because they generate every possible mutation
of a file (thousands here) and cannot run a short list with a few test files for each mutant.
"""

from __future__ import annotations

import ast
import compileall
import importlib
import os
import py_compile
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIST_FILE = ROOT / "bench" / "mutants.toml"
PACKAGE = Path("src/brewster")
COPIED_PATHS = (
    "src",
    "tests",
    "recipes",
    "docs",
    "runs",
    "bench",
    "README.md",
    "pyproject.toml",
    "constraints.txt",
)
TIMEOUT_S = 900
MIN_KILLED_FRACTION = 0.95


@dataclass(frozen=True)
class Mutant:
    """One fault: `old` in `file` is replaced by `new`, and one of `tests` should fail.

    `expected_survival_reason` explains why no test can fail, or is "". In mutants.toml, its key is `survives`.
    """

    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    expected_survival_reason: str = ""

    def __str__(self) -> str:
        return f"{self.file}: {_abbreviated(self.old)} -> {_abbreviated(self.new)}"

    def applied(self, root: Path = ROOT) -> str:
        """Returns the mutated source.

        Raises:
            ValueError: the file is missing, does not contain `old` exactly once, or is not changed by the mutation.
        """
        path = root / PACKAGE / self.file
        source = path.read_text("utf-8") if path.is_file() else ""
        if (count := source.count(self.old)) != 1:
            raise ValueError(
                f"{self}: the fragment occurs {count} times; expected once; change this entry of {LIST_FILE.name}"
            )
        mutated = source.replace(self.old, self.new)
        if ast.dump(ast.parse(mutated)) == ast.dump(ast.parse(source)):
            raise ValueError(
                f"{self}: the syntax tree is unchanged; expected a change; correct this entry of {LIST_FILE.name}"
            )
        return mutated


def read_list() -> list[Mutant]:
    """Returns all entries of mutants.toml."""
    entries = tomllib.loads(LIST_FILE.read_text("utf-8"))["mutant"]
    return [
        Mutant(entry["file"], entry["old"], entry["new"], tuple(entry["tests"]), entry.get("survives", ""))
        for entry in entries
    ]


def main(patterns: Sequence[str]) -> int:
    """Prints a result for each mutant and the percentage of killed mutants. Returns 0 if it is at least 95 %, else 1.

    Raises:
        ValueError: no mutant contains one of the patterns, or an entry of mutants.toml is invalid.
    """
    mutants = [m for m in read_list() if not patterns or any(p in f"{m.file} {m.old}" for p in patterns)]
    if not mutants:
        raise ValueError(
            f"no mutant contains {' or '.join(patterns)}; expected a text in `file` or `old`; choose another text"
        )
    for mutant in mutants:
        mutant.applied()
    _import_heavy()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = _copy(Path(folder))
        survivors = {mutant: reason for mutant in mutants if (reason := _survival_reason(copy, mutant))}
    killed = len(mutants) - len(survivors)
    print(f"\n{killed} of {len(mutants)} mutants killed, {killed / max(1, len(mutants)):.1%}")
    for mutant, reason in survivors.items():
        print(f"survives: {mutant}\n    {reason}")
    return int(killed < MIN_KILLED_FRACTION * len(mutants))


def _survival_reason(copy: Path, mutant: Mutant) -> str:
    """Runs the tests on a mutant. Returns the reason why it survives, or an empty string if a test kills it."""
    started = time.monotonic()
    path, tests = copy / PACKAGE / mutant.file, [f"tests/{test}" for test in mutant.tests]
    source = path.read_text("utf-8")
    path.write_text(mutant.applied(copy), "utf-8")
    try:
        is_killed, failed = _run_tests(copy, tests)
    finally:
        path.write_text(source, "utf-8")
    reason = (
        ""
        if is_killed
        else mutant.expected_survival_reason or "no reason is known; expected a failing test; write one"
    )
    if is_killed and _run_tests(copy, failed or tests, must_exist=True)[0]:
        reason = f"{' '.join(failed or tests)} fails without the mutation, too; expected it to pass; repair the test first"
    result = (
        f"SURVIVES  {reason}"
        if reason
        else f"killed    {' '.join(failed)[:100] or 'before the first test, or by the time limit'}"
    )
    print(f"{time.monotonic() - started:4.0f} s  {mutant}\n        {result}", flush=True)
    return reason


def _copy(folder: Path) -> Path:
    """Copies the tree without caches. Returns the path of the copy.

    Python compares bytecode with the source by content, because a mutation may keep the size and time of a file.
    """
    copy = folder / "brewster"
    copy.mkdir()
    for name in COPIED_PATHS:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        else:
            shutil.copy(source, copy / name)
    checked = py_compile.PycInvalidationMode.CHECKED_HASH
    compileall.compile_dir(copy / PACKAGE, quiet=1, invalidation_mode=checked)
    return copy


def _run_tests(copy: Path, tests: Sequence[str], *, must_exist: bool = False) -> tuple[bool, list[str]]:
    """Runs tests until the first failure or the time limit. Then all processes of the tests are killed.

    Returns:
        Whether a test failed, the time limit was exceeded or pytest found no test, and the ids of failed tests. With a
        mutation, pytest may find no test because conftest.py cannot be imported.

    Raises:
        ValueError: `must_exist` is set, and pytest found no test.
    """
    log = copy.parent / "failed.txt"
    log.write_text("")
    process = get_context("fork").Process(target=_pytest, args=(copy, tests, log))
    process.start()
    process.join(TIMEOUT_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid or 0, signal.SIGKILL)
    process.join()
    if must_exist and process.exitcode in {pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED}:
        raise ValueError(
            f"pytest found no test in {' '.join(tests)}; expected at least one; change this entry of {LIST_FILE.name}"
        )
    return process.exitcode != 0, log.read_text().splitlines()


class _Recorder:
    """A pytest plugin that logs which tests fail."""

    def __init__(self, log: Path) -> None:
        self._log = log

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._log.write_text(f"{report.nodeid}\n")

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self._log.write_text(f"{report.nodeid}\n")


def _pytest(copy: Path, tests: Sequence[str], log: Path) -> None:
    """Runs pytest in the copy, like `python -m pytest`. The parent process has already imported large libraries."""
    os.setsid()
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    os.chdir(copy)
    data = os.environ.get("BREWSTER_DATA") or str(ROOT.parent / "shared" / "data")
    os.environ |= {"PYTHONPATH": str(copy / "src"), "BREWSTER_DATA": data}
    sys.path[0] = str(copy / "src")
    plugins_are_imported = "ignore::pytest.PytestAssertRewriteWarning"
    rawpy_is_forked = "ignore:rawpy is being used:RuntimeWarning"
    options = [
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "--tb=no",
        "-W",
        plugins_are_imported,
        "-W",
        rawpy_is_forked,
    ]
    sys.exit(pytest.main([*options, *tests], plugins=[_Recorder(log)]))


def _import_heavy() -> None:
    """Imports libraries that most tests need. Every run is forked from this process, so it does not import them again."""
    os.environ |= {"OMP_NUM_THREADS": "1", "VIPS_CONCURRENCY": "1"}
    for name in (
        "torch",
        "peft",
        "fastapi",
        "hypothesis",
        "jaxtyping",
        "schemathesis.pytest",
        "click",
        "rich",
    ):
        importlib.import_module(name)


def _abbreviated(text: str) -> str:
    words = " ".join(text.split())
    return repr(words if len(words) <= 50 else f"{words[:47]}...")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
