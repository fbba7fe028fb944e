"""All exceptions that brewster raises for expected failures.

    BrewsterError              exit code 1 on the command line, one sentence without a traceback
    |-- PhotoError             an image cannot be read, interpreted or written
    |   |-- UnreadablePhoto    not an image, empty, truncated
    |   |-- UnsupportedPhoto   an image of an unsupported kind (five channels, animation, NaN)
    |   `-- PhotoTooLarge      more pixels than the limit
    |-- TargetError            the target exists, is read-only or the source, or the disk is full
    |-- ModelError             unknown model, damaged file, wrong inputs
    |-- DeviceError            the requested device is not available
    |-- RecipeError            a recipe is not TOML, or its values are invalid
    |-- DownloadError          a server cannot be reached, or its file has the wrong digest
    `-- MissingExtra           an optional dependency is not installed

Messages have three parts: what happened (with the value), what was expected, what to do.
"""

from __future__ import annotations


class BrewsterError(Exception):
    """Base class of all brewster errors; the message is one sentence in three parts.

    Attributes:
        happened: what happened, with the value.
        expected: what was expected.
        cure: what to do.
    """

    def __init__(self, happened: str, expected: str, cure: str) -> None:
        super().__init__(happened, expected, cure)
        self.happened, self.expected, self.cure = happened, expected, cure

    def __str__(self) -> str:
        return f"{self.happened}; {self.expected}; {self.cure}{'' if self.cure.endswith('?') else '.'}"

    def sentences(self) -> list[str]:
        """The message, a sentence for each problem; only a RecipeError has several."""
        return [str(self)]

    def __reduce__(self) -> tuple[type[BrewsterError], tuple[object, ...]]:
        """Pickles the attributes, not `args`: callers may have changed them before the error crosses processes."""
        return type(self), (self.happened, self.expected, self.cure)


class PhotoError(BrewsterError):
    """An image cannot be read, interpreted or written."""


class UnreadablePhoto(PhotoError):
    """The bytes are not a complete image: empty, truncated, or another kind of file."""


class UnsupportedPhoto(PhotoError):
    """An image of an unsupported kind, such as five channels, an animation, or NaN values."""


class PhotoTooLarge(PhotoError):
    """The image has more pixels than the limit."""


class TargetError(BrewsterError):
    """The target cannot be written: it exists, is read-only, is the source, or the disk is full."""


class ModelError(BrewsterError):
    """A model is unknown, damaged, or has the wrong inputs and outputs."""


class DeviceError(BrewsterError):
    """The requested device is not available to the installed runtime."""


class RecipeError(BrewsterError):
    """A recipe is not TOML, or its values are missing, unknown or impossible.

    Attributes:
        others: further problems of the same recipe, each an error of its own. The message has a line for each.
    """

    def __init__(self, happened: str, expected: str, cure: str, others: tuple[RecipeError, ...] = ()) -> None:
        super().__init__(happened, expected, cure)
        self.others = others

    def __str__(self) -> str:
        return "\n".join(self.sentences())

    def sentences(self) -> list[str]:
        """The message, a sentence for each problem."""
        return [super().__str__(), *(sentence for other in self.others for sentence in other.sentences())]

    def __reduce__(self) -> tuple[type[BrewsterError], tuple[object, ...]]:
        """Errors are sent between processes; the attributes count, as a caller may have changed them."""
        return type(self), (self.happened, self.expected, self.cure, self.others)


class DownloadError(BrewsterError):
    """A server cannot be reached, refuses a request, or sends a file with the wrong digest."""


class MissingExtra(BrewsterError):
    """An optional dependency is needed and not installed."""
