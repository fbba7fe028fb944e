"""Standard output, standard error and Ctrl-C.

Results are written to standard output. Status lines, errors and progress bars are written to
standard error.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Final, TextIO, final

from brewster.errors import OutputError

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

ProgressUpdater = Callable[[float, str], None]
"""Called with the number of finished items, which may be fractional, and a text about the current
item.
"""


@final
class _DeferredInterrupts:
    """Raises a KeyboardInterrupt that Python has dropped in a call from C code, as by libvips for
    its log.
    """

    def __init__(self) -> None:
        self._pending = False
        self.has_finished_work = False
        """Whether the command has finished work that it skips if it is run again."""

    @contextmanager
    def captured(self) -> Iterator[None]:
        hook = sys.unraisablehook

        def capture(dropped: UnraisableHookArgs) -> None:
            if dropped.exc_type is KeyboardInterrupt:
                self._pending = True
            else:
                hook(dropped)

        self._pending = False
        self.has_finished_work = False
        sys.unraisablehook = capture
        try:
            yield
        finally:
            sys.unraisablehook = hook

    def raise_pending(self) -> None:
        """Raises KeyboardInterrupt if Python has dropped one. Call this before every step that
        cannot be undone.
        """
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt


interrupts = _DeferredInterrupts()


def one_line(text: object) -> str:
    """Returns the text with unprintable characters escaped, because file names may contain newlines
    and invalid bytes.
    """
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in str(text)
    )


def print_status(text: object) -> None:
    """Prints one line on standard error."""
    sys.stderr.write(f"{one_line(text)}\n")
    sys.stderr.flush()


def print_error(text: object) -> None:
    """Prints one line `error: ...` on standard error."""
    print_status(f"error: {text}")


@final
class _Output:
    """Standard output, for results only. Libraries write to it as C code and as `sys.stdout`
    (OpenEXR).
    """

    def __init__(self) -> None:
        self._stream: TextIO | None = None

    @property
    def stream(self) -> TextIO:
        return self._stream or sys.stdout

    def redirect_descriptor(self) -> None:
        """Redirects file descriptor 1 to standard error. `sys.stdout` writes to a copy of the
        original descriptor. The redirection lasts until the process ends, because C code may write
        its buffered output only then.
        """
        try:
            if sys.stdout.fileno() != _STDOUT:  # a test or a notebook has replaced it
                return
            sys.stdout.flush()
            fd = os.dup(_STDOUT)
            os.dup2(_STDERR, _STDOUT)
        except (AttributeError, OSError):  # standard output or standard error is closed
            return
        encoding = sys.stdout.encoding
        errors = sys.stdout.errors
        sys.stdout = open(fd, "w", encoding=encoding, errors=errors, closefd=False)  # noqa: SIM115

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Within this block, `sys.stdout` is standard error, and only `print_out` and `write_out`
        write results.
        """
        self._stream = sys.stdout
        try:
            with redirect_stdout(sys.stderr):
                yield
        finally:
            self._stream = None


standard_output = _Output()
_STDOUT: Final = 1
_STDERR: Final = 2


def print_out(text: object) -> None:
    """Prints one line on standard output, and flushes it. Raises OutputError if standard output
    cannot be written, for example because the disk is full.
    """
    stream = standard_output.stream
    write_out(f"{text}\n".encode(stream.encoding or "utf-8", stream.errors or "strict"))


def write_out(data: bytes) -> None:
    """Writes bytes to standard output, and flushes them. Raises OutputError if standard output
    cannot be written, for example because the disk is full.
    """
    stream = standard_output.stream
    try:
        stream.buffer.write(data)
        stream.flush()
    except OSError as error:
        # Python flushes the buffer again when it exits. This cannot fail if the descriptor is
        # /dev/null.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        raise OutputError(
            f"standard output was not written ({error.strerror})",
            "expected a destination that accepts all of the output",
            "write to a file with -o instead",
        ) from error


@contextmanager
def progress(total: int, *, shown: bool, as_json: bool = False) -> Iterator[ProgressUpdater]:
    """Shows a progress bar if `shown` is true, standard error is a terminal, and no JSON is printed
    on the same terminal. Yields the function that updates the bar and raises a dropped
    KeyboardInterrupt. A single item has a percentage instead of the number of finished items.
    """
    shares_terminal = as_json and standard_output.stream.isatty()
    if not (shown and sys.stderr.isatty()) or shares_terminal:
        yield lambda _done, _text: interrupts.raise_pending()
        return
    from rich import progress as rich_progress  # noqa: PLC0415
    from rich.console import Console  # noqa: PLC0415  (slow to import; only used on a terminal)

    columns = (
        rich_progress.BarColumn(),
        rich_progress.TaskProgressColumn() if total == 1 else rich_progress.MofNCompleteColumn(),
        rich_progress.TextColumn("time left"),
        rich_progress.TimeRemainingColumn(),
        rich_progress.TextColumn("{task.description}", markup=False),
    )
    console = Console(stderr=True)
    with rich_progress.Progress(
        *columns, console=console, redirect_stdout=False, transient=True
    ) as bar:
        task = bar.add_task("", total=total)

        def update(done: float, text: str) -> None:
            interrupts.raise_pending()
            bar.update(task, completed=done, description=one_line(text))

        yield update
