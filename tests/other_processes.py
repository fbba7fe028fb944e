"""Child processes of tests: start them, wait for them, and kill them."""

import contextlib
import signal
import subprocess
import time
from pathlib import Path


@contextlib.contextmanager
def started(command, **options):
    """Starts a process that accepts SIGINT, and kills it at the end of the block.

    A shell starts background jobs with SIGINT ignored, and children inherit that setting.
    """
    command = [*map(str, command)]
    with subprocess.Popen(command, preexec_fn=_enable_interrupts, **options) as process:  # noqa: PLW1509
        try:
            yield process
        finally:
            process.kill()


def _enable_interrupts():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for(condition, process=None):
    """Waits until the condition is true. Fails if the process exits first; otherwise only the time limit of the test ends it."""
    while not condition():
        assert process is None or process.poll() is None, f"the process exited with code {process.returncode}"
        time.sleep(0.01)


def children(process):
    return Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False
