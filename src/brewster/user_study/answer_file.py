"""The file of answers that a participant of a static bundle downloads and sends back."""

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Final, Literal, final

from pydantic import AwareDatetime, ConfigDict, Field, TypeAdapter, ValidationError

from brewster.errors import BrewsterError, invalid_value, read_errors
from brewster.user_study.assignment import Choice

MAX_ANSWER_FILE_BYTES: Final = 2_000_000
"""A file with 44 answers has about 15,000 bytes."""

Px = Annotated[int, Field(ge=0, le=100_000)]


@final
@dataclass(frozen=True)
class ViewingConditions:
    """How the pictures of a trial were shown. Lengths are in CSS px. Multiply them by `pixel_ratio` to get screen
    pixels. `view` is the arrangement at the time of the answer: three pictures, the pair A and B, or one picture at
    a time. `switches` counts how often the picture was replaced by another one in place; `zoomed` is true if the
    pictures were enlarged at any time."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    viewport_width: Px
    viewport_height: Px
    pixel_ratio: Annotated[float, Field(gt=0, le=100)]
    picture_width: Px
    theme: Literal["light", "dark"]
    pointer: Literal["fine", "coarse"]
    view: Literal["all", "pair", "single"]
    switches: Annotated[int, Field(ge=0, le=100_000)]
    zoomed: bool


@final
@dataclass(frozen=True)
class ExportedAnswer:
    """An answer as the browser stored it. `answered_at` is the time of the browser, with its time zone."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    trial: Annotated[int, Field(ge=0)]
    choice: Choice
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    answered_at: AwareDatetime
    conditions: ViewingConditions | None = None


@final
@dataclass(frozen=True)
class AnswerFile:
    """The answers of one participant. `participant` is the token of the personal link."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    format: Literal[1]
    participant: Annotated[str, Field(min_length=1, max_length=64)]
    consented_on: date
    answers: tuple[ExportedAnswer, ...]
    withdrawn: tuple[ExportedAnswer, ...] = ()


_ANSWER_FILE: Final = TypeAdapter(AnswerFile)


def read_answer_file(path: Path) -> AnswerFile:
    """Reads a file of answers. Nothing in it is trusted: types, ranges, names and size are checked. Raises
    BrewsterError if the file cannot be read, is too large, or is not a valid file of answers."""
    expected, cure = "expected a file of answers from a participant", "check the path"
    with read_errors(path, BrewsterError, expected, cure), path.open("rb") as file:
        data = file.read(MAX_ANSWER_FILE_BYTES + 1)
    if len(data) > MAX_ANSWER_FILE_BYTES:
        happened = f"{path} has more than {MAX_ANSWER_FILE_BYTES:,} bytes"
        raise BrewsterError(happened, f"{expected}, which is much smaller", cure)
    try:
        return _ANSWER_FILE.validate_json(data)
    except ValidationError as error:
        problem = invalid_value(error.errors()[0])
        raise BrewsterError(
            f"{path} is not a valid file of answers: {problem.happened}",
            f"{problem.expected}, as in the file that the page of the study has written",
            "ask the participant to download the answers again",
        ) from error
