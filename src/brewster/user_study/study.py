"""A study as it is frozen: its pictures, what is compared with what, and how much of that a participant sees.

    study = read_study(Path("out/study"))
    study.picture(study.comparisons[0].photo)    # where that picture lies

`create` writes it, once; nothing changes it afterwards. It alone knows which method made which picture.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, final

from pydantic import TypeAdapter, ValidationError

from brewster.errors import BrewsterError
from brewster.files import write_atomically

DESCRIPTION_FILE: Final = "study.json"
PICTURES: Final = "pictures"
ANSWERS_FILE: Final = "answers.sqlite"
FORMAT: Final = 1
UNNAMED_DATASET: Final = ""
"""What the only dataset is called where the folders have no folders in them."""


@final
@dataclass(frozen=True)
class StudyPicture:
    """A picture of the study: a PNG of 8-bit sRGB under a name that tells nothing.

    `sha256` is the digest of that file, `source_sha256` that of the file it was made from.
    """

    name: str
    width: int
    height: int
    sha256: str
    source_sha256: str


@final
@dataclass(frozen=True)
class PairedComparison:
    """Two methods on one photo, with the names of the three pictures."""

    dataset: str
    name: str
    methods: tuple[str, str]
    photo: str
    outputs: tuple[str, str]


@final
@dataclass(frozen=True)
class CatchTrial:
    """What tells whether somebody looks: an output that is shown beside itself, or beside what we spoilt of it."""

    dataset: str
    name: str
    photo: str
    good: str
    spoilt: str


@final
@dataclass(frozen=True)
class StudyDescription:
    """All that is decided before the first answer.

    `pairs` and `catches` are a participant's; `consent` is what they agree to, paragraphs with an empty line between.
    """

    brewster: str
    seed: int
    pairs: int
    catches: int
    consent: str
    methods: tuple[str, ...]
    datasets: tuple[str, ...]
    pictures: tuple[StudyPicture, ...]
    comparisons: tuple[PairedComparison, ...]
    catch_pool: tuple[CatchTrial, ...]
    format: int = FORMAT


_DESCRIPTION: Final = TypeAdapter(StudyDescription)


@final
@dataclass(frozen=True)
class Study:
    """A description and the folder where it lies."""

    folder: Path
    description: StudyDescription

    def picture_file(self, picture: str) -> Path:
        """Where a picture lies."""
        return self.folder / PICTURES / picture

    def picture(self, name: str) -> StudyPicture:
        """A picture by its name."""
        return self._by_name[name]

    @property
    def answers_file(self) -> Path:
        """Where the answers are kept."""
        return self.folder / ANSWERS_FILE

    @property
    def pairs_of_methods(self) -> tuple[tuple[str, str], ...]:
        """The methods that are compared with each other, in the order of the tables."""
        return tuple(dict.fromkeys(comparison.methods for comparison in self.description.comparisons))

    def changed_pictures(self) -> Iterator[str]:
        """The names of pictures that are missing or are not what they were."""
        for picture in self.description.pictures:
            path = self.picture_file(picture.name)
            if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != picture.sha256:
                yield picture.name

    def verify_pictures(self) -> None:
        """Refuses a study whose pictures are not those that it was made with.

        Raises:
            BrewsterError: so it is.
        """
        changed = list(self.changed_pictures())
        if changed:
            raise BrewsterError(
                f"{self.folder / PICTURES / changed[0]} is missing or changed, as are {len(changed) - 1} others",
                "everybody in a study sees the same pictures",
                "copy the study again from where it was made",
            )

    @cached_property
    def _by_name(self) -> dict[str, StudyPicture]:
        return {picture.name: picture for picture in self.description.pictures}


def write_study(folder: Path, description: StudyDescription) -> None:
    """Writes the description.

    Raises:
        TargetError: it is there already, or cannot be written.
    """
    text = json.dumps(asdict(description), indent=1, ensure_ascii=False)
    write_atomically(folder / DESCRIPTION_FILE, f"{text}\n".encode())


def read_study(folder: Path) -> Study:
    """The study in a folder.

    Raises:
        BrewsterError: there is none, or its description is not one that this version understands.
    """
    path = folder / DESCRIPTION_FILE
    try:
        description = _DESCRIPTION.validate_json(path.read_bytes(), extra="forbid")
    except OSError as error:
        raise BrewsterError(
            f"{path} cannot be read ({error.strerror or error})",
            "a folder that `brewster study create` has written",
            "name that folder",
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        raise BrewsterError(
            f"{path} is no description of a study ({'.'.join(map(str, first['loc']))}: {first['msg']})",
            "it stays as `brewster study create` has written it",
            "create the study again",
        ) from error
    if description.format != FORMAT:
        raise BrewsterError(
            f"{path} has format {description.format}",
            f"this version reads format {FORMAT}",
            f"use brewster {description.brewster}",
        )
    return Study(folder, description)
