"""The description of a study: its pictures, its comparisons, and the number of trials of a
participant.

`create` writes the description once; it never changes. No other file says which method made which
picture.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, final

from pydantic import TypeAdapter, ValidationError

from brewster.base.files import write_atomically
from brewster.errors import BrewsterError, invalid_value, read_errors

DESCRIPTION_FILE: Final = "study.json"
PICTURES_FOLDER: Final = "pictures"
ANSWERS_FILE: Final = "answers.sqlite"
FORMAT_VERSION: Final = 3
UNNAMED_DATASET: Final = ""
"""The name of the only dataset if the source folders have no subfolders."""


@final
@dataclass(frozen=True)
class StudyPicture:
    """A picture of the study: an 8-bit sRGB PNG with a random name. `width` and `height` are in px;
    `sha256` is the digest of the PNG file, `source_sha256` that of its source file.
    """

    name: str
    width: int
    height: int
    sha256: str
    source_sha256: str


@final
@dataclass(frozen=True)
class PairedComparison:
    """A comparison of two methods on one photo. `dataset` and `name` identify the source file.
    `photo` and `outputs` are names of pictures; `outputs` has the order of `methods`.
    """

    dataset: str
    name: str
    methods: tuple[str, str]
    photo: str
    outputs: tuple[str, str]


@final
@dataclass(frozen=True)
class CatchTrial:
    """Pictures for a catch trial, which tests attention: an output is compared with itself or with
    a degraded copy. `photo`, `good` and `degraded` are names of pictures: the photo, the output,
    and the degraded copy of the output.
    """

    dataset: str
    name: str
    photo: str
    good: str
    degraded: str


@final
@dataclass(frozen=True)
class StudyDescription:
    """Everything that is fixed before the first answer; the content of study.json. `pairs` and
    `catch_trials` count the comparisons and catch trials of one participant. `consent` is the text
    that participants agree to, with an empty line between paragraphs.
    """

    brewster: str
    seed: int
    pairs: int
    catch_trials: int
    consent: str
    methods: tuple[str, ...]
    datasets: tuple[str, ...]
    pictures: tuple[StudyPicture, ...]
    comparisons: tuple[PairedComparison, ...]
    catch_pool: tuple[CatchTrial, ...]
    format: int = FORMAT_VERSION


_DESCRIPTION: Final = TypeAdapter(StudyDescription)


@final
@dataclass(frozen=True)
class Study:
    """A study: its folder and its description."""

    folder: Path
    description: StudyDescription

    def picture_file(self, name: str) -> Path:
        """The path of the picture with this name."""
        return self.folder / PICTURES_FOLDER / name

    def picture(self, name: str) -> StudyPicture:
        """The description of the picture with this name."""
        return self._by_name[name]

    @property
    def answers_file(self) -> Path:
        """The path of the database of answers."""
        return self.folder / ANSWERS_FILE

    @property
    def pairs_of_methods(self) -> tuple[tuple[str, str], ...]:
        """The pairs of methods that are compared, in the order of the tables."""
        return tuple(
            dict.fromkeys(comparison.methods for comparison in self.description.comparisons)
        )

    def verify_pictures(self) -> None:
        """Check that all pictures exist and are unchanged. Raises BrewsterError if a picture is
        missing, or its digest differs from the description.
        """
        files = {
            self.picture_file(picture.name): picture.sha256 for picture in self.description.pictures
        }
        changed = [
            path
            for path, digest in files.items()
            if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest
        ]
        if changed:
            raise BrewsterError(
                f"pictures of the study are missing or changed: {len(changed)}, such as "
                f"{changed[0]}",
                "expected all pictures as `brewster study create` wrote them",
                "copy the study again from its original folder",
            )

    @cached_property
    def _by_name(self) -> dict[str, StudyPicture]:
        return {picture.name: picture for picture in self.description.pictures}


def write_study(folder: Path, description: StudyDescription) -> None:
    """Write the description into a folder. Raises OutputError if the file exists already or cannot
    be written.
    """
    text = json.dumps(asdict(description), indent=1, ensure_ascii=False)
    write_atomically(folder / DESCRIPTION_FILE, f"{text}\n".encode())


def read_study(folder: Path) -> Study:
    """Read the study in a folder. Raises BrewsterError if its description is missing, invalid, or
    of another format.
    """
    path = folder / DESCRIPTION_FILE
    with read_errors(
        path,
        BrewsterError,
        "expected a folder created by `brewster study create`",
        "check the path",
    ):
        data = path.read_bytes()
    try:
        description = _DESCRIPTION.validate_json(data, extra="forbid")
    except ValidationError as error:
        problem = invalid_value(error.errors()[0])
        raise BrewsterError(
            f"{path} is not a valid description of a study: {problem.happened}",
            f"{problem.expected}, as in the file that `brewster study create` has written",
            "restore the original file, or create the study again",
        ) from error
    if description.format != FORMAT_VERSION:
        raise BrewsterError(
            f"{path} has format {description.format}",
            f"expected format {FORMAT_VERSION}",
            f"use brewster {description.brewster}, which created the study",
        )
    return Study(folder, description)
