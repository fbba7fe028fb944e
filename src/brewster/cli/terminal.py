"""What the command line says and where, results on standard output and all else on standard error; and Ctrl-C."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Final, TextIO, final

from brewster.errors import TargetError

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

Advance = Callable[[float, str], None]
"""Called with how many are done, perhaps in part, and what comes next, or how it goes."""


@final
class _DeferredInterrupts:
    """Ctrl-C that got lost.

    Where C code calls Python (libvips does, whenever it has something to log), no exception can pass: Python drops
    a KeyboardInterrupt there, and the work would go on as if nobody had pressed anything.
    """

    def __init__(self) -> None:
        self._pending = False

    @contextmanager
    def captured(self) -> Iterator[None]:
        """Notices within this block when an interrupt is dropped."""
        hook = sys.unraisablehook

        def capture(dropped: UnraisableHookArgs) -> None:
            if dropped.exc_type is KeyboardInterrupt:
                self._pending = True
            else:
                hook(dropped)

        self._pending, sys.unraisablehook = False, capture
        try:
            yield
        finally:
            sys.unraisablehook = hook

    def raise_pending(self) -> None:
        """Raises the interrupt that was dropped, if there was one: to be called before what cannot be undone."""
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt


interrupts = _DeferredInterrupts()


def one_line(text: object) -> str:
    """Text as it can stand in one line: file names may hold newlines, and bytes that are no text."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in str(text)
    )


def print_status(text: object) -> None:
    """One line on standard error."""
    sys.stderr.write(f"{one_line(text)}\n")
    sys.stderr.flush()


def print_error(text: object) -> None:
    """One line on standard error that says what went wrong."""
    print_status(f"error: {text}")


@final
class _Output:
    """Standard output, which belongs to the command: what a library prints there goes to standard error.

    Libraries print in two ways, and each is led away in its own: C code writes to file descriptor 1 (so do processes
    that are started here), and Python code writes to `sys.stdout`, as OpenEXR does for a damaged file.
    """

    def __init__(self) -> None:
        self._stream: TextIO | None = None

    @property
    def stream(self) -> TextIO:
        """Where results are written."""
        return self._stream or sys.stdout

    def redirect_descriptor(self) -> None:
        """Points file descriptor 1 to standard error, for the rest of this process; `sys.stdout` gets another one.

        It is not given back, because C code keeps what it prints in a buffer until the process ends.
        """
        try:
            if sys.stdout.fileno() != _STDOUT:  # a test or a notebook has put something else there
                return
            sys.stdout.flush()
            own = os.dup(_STDOUT)
            os.dup2(_STDERR, _STDOUT)
        except (AttributeError, OSError):  # one of the two is closed, or none
            return
        sys.stdout = open(own, "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors, closefd=False)  # noqa: SIM115

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Within this block, `sys.stdout` is standard error, and only `print_out` and `write_out` write results."""
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
    """One line to standard output, now.

    Raises:
        TargetError: it cannot be written.
    """
    stream = standard_output.stream
    write_out(f"{text}\n".encode(stream.encoding or "utf-8", stream.errors or "strict"))


def write_out(data: bytes) -> None:
    """Bytes to standard output, now.

    Raises:
        TargetError: they cannot be written.
    """
    stream = standard_output.stream
    try:
        stream.buffer.write(data)
        stream.flush()
    except OSError as error:
        # What is still in the buffer must not fail again when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        raise TargetError(
            f"standard output was not written ({error.strerror})",
            "somebody must take all of it",
            "write to a file with -o",
        ) from error


@contextmanager
def progress(total: int, *, shown: bool) -> Iterator[Advance]:
    """A bar on standard error, if that is a terminal and the bar is to be shown."""
    if not (shown and sys.stderr.isatty()):
        yield lambda _done, _text: None
        return
    from rich.console import Console  # noqa: PLC0415  (only a terminal pays for it)
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True), redirect_stdout=False, transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda done, text: bar.update(task, completed=done, description=one_line(text))
