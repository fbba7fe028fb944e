"""Compiles what films need while the server runs, so that the first film after an installation
waits less, and its page can say for what it waits.
"""

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from threading import Thread
from typing import IO, Final, final

_SCRIPT: Final = """
from functools import partial
from brewster.film.motion.compilation import compile_all, is_compiled
compile_all(*([] if is_compiled() else [partial(print, flush=True)]))
"""


@final
class FilmPreparation:
    """Compiles in a process, because a thread that compiles cannot be stopped."""

    def __init__(self) -> None:
        self.share: float | None = None
        """The completed fraction, 0 to 1; None: nothing is being compiled."""

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Compiles until the end of the `with` block, at most."""
        with subprocess.Popen(  # noqa: S603  (the command is a constant)
            [sys.executable, "-c", _SCRIPT],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as process:
            reader = Thread(target=self._read, args=(process.stdout,), name="brewster-preparation")
            reader.start()
            try:
                yield
            finally:
                process.terminate()
                reader.join()

    def _read(self, output: IO[str]) -> None:
        for line in output:
            self.share = float(line)
        self.share = None
