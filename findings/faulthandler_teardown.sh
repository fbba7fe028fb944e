#!/bin/bash
# pytest's faulthandler_timeout does not end a test that fails and then hangs in its teardown.
#
# `-o faulthandler_timeout=N -o faulthandler_exit_on_timeout=true` looks like the last guard of a run: a
# thread in C ends the process N seconds after a test began, even if no Python code can run any more. But
# pytest stops this timer as soon as a test raises an exception (`pytest_exception_interact` in
# _pytest/faulthandler.py: a debugger might begin), and does not start it again for the teardown. So a
# failing test whose fixture hangs afterwards (a browser that does not close, a thread that is joined)
# holds the run forever, while a passing test with the same fixture is ended after N seconds. With
# pytest-timeout it is the same: its signal has been spent on the failure.
#
# The cure: a hook `pytest_exception_interact(trylast=True)` that starts the timer again.
#
# This script runs a passing and a failing test whose teardown sleeps for 6 s with a limit of 2 s, with and
# without the hook, and fails if they end otherwise than described.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pytest==9.2.0
cd "$folder"
cat > test_slow_teardown.py <<'PYTHON'
import time

import pytest


@pytest.fixture
def slow():
    yield
    time.sleep(6)


def test_passes(slow):
    pass


def test_fails(slow):
    assert False
PYTHON
cat > again.py <<'PYTHON'
import faulthandler
import sys

import pytest


@pytest.hookimpl(trylast=True)
def pytest_exception_interact():
    faulthandler.dump_traceback_later(2, exit=True, file=sys.__stderr__)
PYTHON

is_ended() { # whether pytest ends before the summary of its tests
    venv/bin/python -m pytest -q -p no:cacheprovider -o faulthandler_timeout=2 \
        -o faulthandler_exit_on_timeout=true "$@" > log 2>&1 || true
    ! grep -Eq "(passed|failed) in [0-9]" log
}

venv/bin/python -m pytest --version
is_ended test_slow_teardown.py::test_passes || exit 1
echo "test_passes: ended after the limit"
if is_ended test_slow_teardown.py::test_fails; then exit 1; fi
echo "test_fails: not ended, its teardown ran for three times the limit"
PYTHONPATH=. is_ended -p again test_slow_teardown.py::test_fails || exit 1
echo "test_fails, with the hook: ended after the limit"
