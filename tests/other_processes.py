"""Processes that tests start, watch and kill."""

import contextlib
import signal
import subprocess
import time
from pathlib import Path


@contextlib.contextmanager
def started(command, **kwargs):
    """A process that is killed in the end, if it has not ended by itself; Ctrl-C reaches it.

    A shell starts background jobs with SIGINT ignored, and children inherit that.
    """
    command = [*map(str, command)]
    with subprocess.Popen(command, preexec_fn=_restore_sigint, **kwargs) as process:  # noqa: PLW1509
        try:
            yield process
        finally:
            process.kill()


def _restore_sigint():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for(condition, process=None):
    """Waits until something is so, while this process runs; only the time limit of the test ends it before."""
    while not condition():
        assert process is None or process.poll() is None, f"it ended, with exit code {process.returncode}"
        time.sleep(0.01)


def children(process):
    return Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False
