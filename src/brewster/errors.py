"""All exceptions that brewster raises for expected failures.

    BrewsterError              exit code 1 on the command line, a message without a traceback
    |-- PhotoError             a photo cannot be read, interpreted or written
    |   |-- UnreadablePhoto    the file does not exist, is not an image, is empty or is truncated
    |   |-- UnsupportedPhoto   an unsupported kind of image (five channels, animation, NaN)
    |   |-- PhotoTooLarge      the image has more pixels than the limit
    |   `-- MaskError          a mask or hints cannot be read, or do not fit their photo
    |-- ManifestError          a list of photos is not a table of paths
    |-- OutputError            an output file cannot be written, for example because it exists
    |   `-- DiskFull           the disk, or its quota, has no space left
    |-- ModelError             a model is unknown, damaged, or has the wrong inputs
    |-- DeviceError            the device is not available or has too little memory; or a cluster, a
    |                          process group or LLVM is missing
    |-- RecipeError            a recipe is not TOML, or its values are invalid
    |-- DownloadError          a server cannot be reached, or its file has another digest; or the
    |                          disk is too small, or a download is not allowed
    `-- MissingExtra           an optional dependency is not installed

Messages have three parts: what happened (with the value), what was expected, what to do.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

_MAX_VALUE_LENGTH: Final = 40

_EXPECTED: Final = {
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than": "a number below {lt:g}",
    "less_than_equal": "a number of at most {le:g}",
    "finite_number": "a finite number",
    "literal_error": "{expected}",
    "string_pattern_mismatch": "a text that matches {pattern}",
    "string_too_long": "at most {max_length} characters",
    "string_too_short": "at least {min_length} characters",
    "too_long": "at most {max_length} entries",
    "too_short": "at least {min_length} entries",
}
"""What is expected, by the type of pydantic's error. The names in braces are keys of its context.
"""

_EXPECTED_KINDS: Final = {
    "bool": "true or false",
    "int": "an integer",
    "float": "a number",
    "string": "a text",
    "path": "a path",
    "date": "a date such as 2026-01-31",
    "datetime": "a time such as 2026-01-31T12:00:00Z",
    "timezone": "a time with its time zone",
    "list": "a list",
    "tuple": "a list",
    "model": "an object with named values",
    "dataclass": "an object with named values",
}
"""What is expected, by the first word of the type of pydantic's error, for the types that are not
in `_EXPECTED`.
"""


class BrewsterError(Exception):
    """Base class of all brewster errors. The message has three parts, separated by semicolons.

    Attributes:
        happened: what happened, with the value.
        expected: what was expected.
        cure: what to do.
    """

    def __init__(self, happened: str, expected: str, cure: str) -> None:
        super().__init__(happened, expected, cure)
        self.happened = happened
        self.expected = expected
        self.cure = cure

    def __str__(self) -> str:
        return (
            f"{self.happened}; {self.expected}; {self.cure}{'' if self.cure.endswith('?') else '.'}"
        )

    def messages(self) -> list[str]:
        """Returns the message as a list with one item for each problem. Only a RecipeError has
        several.
        """
        return [str(self)]


@contextmanager
def error_prefix(name: object | None) -> Iterator[None]:
    """Adds what an error is about, such as a file, to the errors in the block, unless the message
    contains it.
    """
    try:
        yield
    except BrewsterError as error:
        if name is not None and str(name) not in str(error):
            error.happened = f"{name}: {error.happened}"
        raise


@contextmanager
def read_errors(
    path: object,
    kind: type[BrewsterError],
    expected: str,
    cure: str,
    more: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Turns errors of the system and of decoding text, and `more`, into this kind: `path` cannot be
    read.
    """
    kinds: tuple[type[Exception], ...] = (OSError, UnicodeDecodeError, *more)
    try:
        yield
    except kinds as error:
        reason = getattr(error, "strerror", None) or error
        raise kind(f"{path} cannot be read ({reason})", expected, cure) from error


class PhotoError(BrewsterError):
    """A photo cannot be read, interpreted or written."""


class UnreadablePhoto(PhotoError):
    """The file cannot be read: it does not exist, is not an image, is empty, or is truncated."""


class UnsupportedPhoto(PhotoError):
    """The kind of image is not supported: for example five channels, an animation, or NaN
    values.
    """


class PhotoTooLarge(PhotoError):
    """The image has more pixels than the limit."""


class ManifestError(BrewsterError):
    """A manifest, which lists the photos of a batch, is not a CSV or Parquet table of paths."""


class MaskError(PhotoError):
    """A mask or hints cannot be read, have unexpected colours, or do not have the size of their
    photo.
    """


class OutputError(BrewsterError):
    """An output file cannot be written: it already exists, is read-only or is the input file, or
    the disk is full.
    """


class DiskFull(OutputError):
    """An output file cannot be written, because the disk, or its quota, has no space left. A batch
    stops.
    """


class ModelError(BrewsterError):
    """A model is unknown, damaged, or has the wrong inputs and outputs."""


class DeviceError(BrewsterError):
    """The device is not available or has too little memory; or a cluster, a process group or LLVM
    is missing.
    """


class RecipeError(BrewsterError):
    """A recipe is not TOML, or its values are missing, unknown or impossible.

    Attributes:
        happened: what happened, with the value.
        expected: what was expected.
        cure: what to do.
        others: one error for each further problem of the same recipe. The message has a line for
            each problem.
    """

    def __init__(
        self, happened: str, expected: str, cure: str, others: tuple[RecipeError, ...] = ()
    ) -> None:
        super().__init__(happened, expected, cure)
        self.others = others

    def __str__(self) -> str:
        return "\n".join(self.messages())

    def messages(self) -> list[str]:
        """Returns one message for each problem of the recipe."""
        return [
            super().__str__(),
            *(message for other in self.others for message in other.messages()),
        ]


class DownloadError(BrewsterError):
    """A server cannot be reached, refuses a request, or sends another file; or the disk is too
    small, or a download is not allowed.
    """


def counted(number: int, noun: str) -> str:
    """Returns a number with its noun: `1 video` or `2 videos`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


VIDEO_CURE: Final = (
    "use `brewster burst` for a video of one window, or extract single images, "
    "for example with ffmpeg"
)


def video_error(name: str) -> UnsupportedPhoto:
    """Returns the error for a video. `name` is its path, or "the file" if the path is unknown."""
    return UnsupportedPhoto(f"{name} is a video", "expected a photo", VIDEO_CURE)


def empty_file_error() -> UnreadablePhoto:
    """Returns the error for an image file of 0 bytes."""
    return UnreadablePhoto("the file is empty", "expected an image file", "copy the file again")


INSTALL_COMMAND: Final = "pip install -c constraints.txt -e"
"""Installs brewster from its repository: it is on no package index. The next argument is "." or
".[EXTRA]".
"""


def install_command(extra: str) -> str:
    """Returns the command that installs an extra of brewster. It must be run in the root of the
    repository.
    """
    return f"{INSTALL_COMMAND} '.[{extra}]'"


class MissingExtra(BrewsterError):
    """An optional dependency is needed, but not installed."""

    @classmethod
    def for_extra(cls, extra: str, happened: str, expected: str) -> MissingExtra:
        """Returns the error for a package of an extra of brewster. Its third part is the command
        that installs it.

        Args:
            extra: the name of the extra in pyproject.toml, such as "heic".
            happened: what happened, with the value.
            expected: what was expected.
        """
        return cls(
            happened, expected, f"run in the repository of brewster: {install_command(extra)}"
        )


def invalid_value(details: Mapping[str, Any]) -> BrewsterError:
    """Returns an error about one invalid value, from an item of `errors()` of pydantic's
    ValidationError.
    """
    name = ".".join(map(str, details["loc"])) or "the whole value"
    kind = details["type"]
    value = details["input"]
    if kind.startswith("missing"):
        return BrewsterError(f"{name} is missing", "expected a value", f"add {name}")
    if kind == "json_invalid":  # FastAPI adds the position in the text to the location
        name = str(details["loc"][0]) if details["loc"] else "the text"
        return BrewsterError(
            f"{name} is not JSON ({details['ctx']['error']})", "expected JSON", f"correct {name}"
        )
    text = (
        repr(value[:_MAX_VALUE_LENGTH])
        if isinstance(value, str)
        else repr(value)[:_MAX_VALUE_LENGTH]
    )
    if kind in {"extra_forbidden", "unexpected_keyword_argument"}:
        return BrewsterError(
            f"there is no field {name} (its value is {text})",
            "expected known fields only",
            f"remove {name}",
        )
    return BrewsterError(f"{name} is {text}", expected_value(details), f"correct {name}")


def expected_value(details: Mapping[str, Any]) -> str:
    """Returns the second part of a message, such as "expected a finite number", for an item of
    `errors()` of pydantic.

    The text of a validator of our own has this form already and is returned unchanged.
    """
    kind: str = details["type"]
    if kind == "value_error":
        return str(details["ctx"]["error"])
    known = _EXPECTED.get(kind) or _EXPECTED_KINDS.get(kind.partition("_")[0])
    return (
        f"expected {known.format(**details.get('ctx', {})) if known else f'a valid value ({kind})'}"
    )
