"""Every error brewster raises on purpose, in one tree.

    BrewsterError              exit code 1 on the command line, one sentence, no traceback
    |-- PhotoError             a picture cannot be read, understood or written
    |   |-- UnreadablePhoto    not a picture, empty, truncated
    |   |-- UnsupportedPhoto   a picture, but of a kind we refuse (five channels, animation, NaN)
    |   `-- PhotoTooLarge      beyond the stated pixel limit
    |-- TargetError            the place to write to: exists, read-only, full, equal to the source
    |-- ModelError             unknown model, damaged file, wrong inputs
    |-- DeviceError            the asked device is not there
    |-- RecipeError            a TOML recipe that does not say what it must
    |-- DownloadError          a server cannot be reached, or did not send what it promised
    `-- MissingExtra           an optional part is not installed

Messages have three parts: what happened (with the value), what was expected, what to do.
"""

from __future__ import annotations


class BrewsterError(Exception):
    """Anything brewster can explain; the message is one sentence in three parts.

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
        """Errors are sent between processes; the attributes count, as a caller may have changed them."""
        return type(self), (self.happened, self.expected, self.cure)


class PhotoError(BrewsterError):
    """A picture cannot be read, understood or written."""


class UnreadablePhoto(PhotoError):
    """The bytes are not a whole picture: empty, truncated, or something else entirely."""


class UnsupportedPhoto(PhotoError):
    """A picture of a kind that brewster refuses: five channels, an animation, NaN."""


class PhotoTooLarge(PhotoError):
    """The picture has more pixels than the stated limit."""


class TargetError(BrewsterError):
    """The target cannot be written: it exists, is read-only, is the source, or the disk is full."""


class ModelError(BrewsterError):
    """A model is unknown, damaged or not one of ours."""


class DeviceError(BrewsterError):
    """The asked device is not available to the installed runtime."""


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
    """A server cannot be reached, refuses, or did not send what it promised."""


class MissingExtra(BrewsterError):
    """An optional part of brewster is needed and not installed."""
