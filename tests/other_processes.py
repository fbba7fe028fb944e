"""Starts, watches and kills processes."""

import contextlib
import signal
import subprocess
import time
from pathlib import Path


@contextlib.contextmanager
def started(command, **kwargs):
    """Runs a process that receives Ctrl-C, and kills it at the end if it still runs.

    A shell starts background jobs with SIGINT ignored, and children inherit that setting.
    """
    command = [*map(str, command)]
    with subprocess.Popen(command, preexec_fn=_restore_sigint, **kwargs) as process:  # noqa: PLW1509
        try:
            yield process
        finally:
            process.kill()


def finished(command, **kwargs):
    """Runs a process to its end; its output is text."""
    return subprocess.run(
        [*map(str, command)], capture_output=True, text=True, check=False, **kwargs
    )


def _restore_sigint():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for(condition, process=None):
    """Waits until a condition is true while the process runs; only the time limit of the test stops
    the wait.
    """
    while not condition():
        assert process is None or process.poll() is None, (
            f"the process exited with code {process.returncode}"
        )
        time.sleep(0.01)


def children(process):
    return Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False
