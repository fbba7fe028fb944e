"""All exceptions that brewster raises for expected failures.

    BrewsterError              exit code 1 on the command line, a message without a traceback
    |-- PhotoError             a photo cannot be read, interpreted or written
    |   |-- UnreadablePhoto    the file does not exist, is not an image, is empty or is truncated
    |   |-- UnsupportedPhoto   an unsupported kind of image (five channels, animation, NaN)
    |   |-- PhotoTooLarge      the image has more pixels than the limit
    |   `-- MaskError          a mask cannot be read, or does not fit its photo
    |-- ManifestError          a list of photos is not a table of paths
    |-- OutputError            an output file cannot be written, for example because it already exists
    |-- ModelError             a model is unknown, damaged, or has the wrong inputs
    |-- DeviceError            the requested device is not available or has too little memory; or a cluster, a process group
    |                          or LLVM is missing
    |-- RecipeError            a recipe is not TOML, or its values are invalid
    |-- DownloadError          a server cannot be reached, or its file has an unexpected digest; or the disk is too small, or
    |                          a download is not allowed
    `-- MissingExtra           an optional dependency is not installed

Messages have three parts: what happened (with the value), what was expected, what to do.
"""

from __future__ import annotations


class BrewsterError(Exception):
    """Base class of all brewster errors. The message has three parts, separated by semicolons.

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

    def messages(self) -> list[str]:
        """Returns the message as a list with one item for each problem. Only a RecipeError has several."""
        return [str(self)]

    def __reduce__(self) -> tuple[type[BrewsterError], tuple[object, ...]]:
        """Pickles the attributes instead of `args`, because a caller may have changed them after the error was created."""
        return type(self), (self.happened, self.expected, self.cure)


class PhotoError(BrewsterError):
    """A photo cannot be read, interpreted or written."""


class UnreadablePhoto(PhotoError):
    """The file cannot be read: it does not exist, is not an image, is empty, or is truncated."""


class UnsupportedPhoto(PhotoError):
    """The kind of image is not supported: for example five channels, an animation, or NaN values."""


class PhotoTooLarge(PhotoError):
    """The image has more pixels than the limit."""


class ManifestError(BrewsterError):
    """A manifest, which lists the photos of a batch, is not a CSV or Parquet table of paths."""


class MaskError(PhotoError):
    """A mask cannot be read, is not grey, or does not have the size of its photo."""


class OutputError(BrewsterError):
    """An output file cannot be written: it already exists, is read-only or is the input file, or the disk is full."""


class ModelError(BrewsterError):
    """A model is unknown, damaged, or has the wrong inputs and outputs."""


class DeviceError(BrewsterError):
    """The requested device is not available or has too little memory; or a cluster, a process group or LLVM is missing."""


class RecipeError(BrewsterError):
    """A recipe is not TOML, or its values are missing, unknown or impossible.

    Attributes:
        others: one error for each further problem of the same recipe. The message has a line for each problem.
    """

    def __init__(self, happened: str, expected: str, cure: str, others: tuple[RecipeError, ...] = ()) -> None:
        super().__init__(happened, expected, cure)
        self.others = others

    def __str__(self) -> str:
        return "\n".join(self.messages())

    def messages(self) -> list[str]:
        """Returns one message for each problem of the recipe."""
        return [super().__str__(), *(message for other in self.others for message in other.messages())]

    def __reduce__(self) -> tuple[type[BrewsterError], tuple[object, ...]]:
        """Pickles the attributes instead of `args`, as the base class does."""
        return type(self), (self.happened, self.expected, self.cure, self.others)


class DownloadError(BrewsterError):
    """A server cannot be reached, refuses a request, or sends a file with another digest than expected; or the disk is too
    small, or a download is not allowed."""


class MissingExtra(BrewsterError):
    """An optional dependency is needed, but not installed."""
