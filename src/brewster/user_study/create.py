"""From folders of outputs to a study: every picture paired by name, copied under a name that tells nothing.

    create(Path("out/study"), Path("inputs"), {"ours": Path("out/ours"), "RDNet": Path("out/rdnet")})

Whatever does not fit is refused, all of it named, before anything is written. Pictures are kept as PNG of 8-bit sRGB,
upright and without metadata: every browser shows them alike, and neither format nor EXIF tells where they come from.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product
from pathlib import Path
from random import Random
from typing import Final, final

import brewster
from brewster.errors import BrewsterError, PhotoError, TargetError
from brewster.files import atomic_path, write_atomically
from brewster.photo import Photo
from brewster.user_study.degrade import spoil
from brewster.user_study.folders import Key, find_pictures, listed
from brewster.user_study.study import (
    PICTURES,
    CatchTrial,
    PairedComparison,
    Study,
    StudyDescription,
    StudyPicture,
    write_study,
)

PAIRS: Final = 40
CATCHES: Final = 4
CATCH_POOL: Final = 24
CONSENT: Final = """\
In this study you compare pictures. You see a photo that was taken through glass, and two results of removing the \
reflection from it. Choose the one that looks better to you, or say that they are similar. There are no right or wrong \
answers.

Taking part is voluntary. You can stop at any time, and go on later with your personal link.

We keep your choices, how long each took, and the day on which you agreed to take part. We keep no name, no address and \
nothing else about you or your device."""


@final
@dataclass(frozen=True)
class StudyOptions:
    """What can be chosen about a study; None takes 40 pairs and 4 catch trials, or fewer where there are not so many."""

    datasets: Sequence[str] = ()
    pairs: int | None = None
    catches: int | None = None
    all_pairs: bool = False
    seed: int | None = None
    consent: str = CONSENT


@final
@dataclass(frozen=True)
class _StudyFiles:
    """The files of a study, by photo: the inputs, and each method's outputs."""

    inputs: Mapping[Key, Path]
    outputs: Mapping[str, Mapping[Key, Path]]


def create(
    out: Path,
    inputs: Path,
    methods: Mapping[str, Path],
    choices: StudyOptions = StudyOptions(),
    on_progress: Callable[[int], None] = lambda _done: None,
) -> Study:
    """Makes a study of all pictures in the folder of inputs; the first method is compared with each other one.

    `on_progress` is called with how many pictures are copied, after each.

    Raises:
        BrewsterError: fewer than two methods; names, sizes or files do not fit; more pairs than there are.
        TargetError: `out` is not empty, or cannot be written.
    """
    _refuse_taken(out)
    found = _found(inputs, methods, choices.datasets)
    every = list(combinations(methods, 2))
    pairs = every if choices.all_pairs else every[: len(methods) - 1]
    seed = secrets.randbelow(1 << 32) if choices.seed is None else choices.seed
    shown = _fitting(choices.pairs, PAIRS, len(pairs) * len(found.inputs), "pairs")
    catches = _fitting(choices.catches, CATCHES, min(CATCH_POOL, len(found.inputs)), "catch trials")
    with atomic_path(out) as part:
        copier = _Copier(part / PICTURES, Random(f"{seed}/names"), on_progress)  # noqa: S311  (a published seed)
        comparisons = tuple(_comparisons(found, pairs, copier))
        pool = tuple(_catch_pool(found, copier, Random(f"{seed}/catches")))  # noqa: S311
        description = StudyDescription(
            brewster=brewster.__version__,
            seed=seed,
            pairs=shown,
            catches=catches,
            consent=choices.consent,
            methods=tuple(methods),
            datasets=tuple(dict.fromkeys(dataset for dataset, _ in found.inputs)),
            pictures=tuple(sorted(copier.pictures.values(), key=lambda picture: picture.name)),
            comparisons=comparisons,
            catch_pool=pool,
        )
        write_study(part, description)
    return Study(out, description)


# --- what is there, and whether it fits


def _found(inputs: Path, methods: Mapping[str, Path], datasets: Sequence[str]) -> _StudyFiles:
    if len(methods) < 2:
        raise BrewsterError(
            f"{len(methods)} method was named",
            "a study compares two or more",
            "add another --method NAME=DIR",
        )
    found = _StudyFiles(
        find_pictures(inputs, datasets),
        {name: find_pictures(path, datasets) for name, path in methods.items()},
    )
    misfits = [*_missing(found, inputs, methods), *_unequal(found)]
    if misfits:
        raise BrewsterError(
            f"{len(misfits)} {'picture does' if len(misfits) == 1 else 'pictures do'} not fit: {listed(misfits)}",
            "every input has one output of each method, of its own size",
            "mend these and run again; nothing was written",
        )
    return found


def _missing(found: _StudyFiles, inputs: Path, methods: Mapping[str, Path]) -> Iterator[str]:
    for name, outputs in found.outputs.items():
        for dataset, stem in found.inputs.keys() - outputs.keys():
            yield f"{name} has no {methods[name] / dataset / stem}.*"
        for key in outputs.keys() - found.inputs.keys():
            yield f"{outputs[key]} has no input in {inputs / key[0]}"


def _unequal(found: _StudyFiles) -> Iterator[str]:
    """What cannot be read whole, and outputs of another size than their input."""
    sizes: dict[Path, tuple[int, int]] = {}
    for path in [
        *found.inputs.values(),
        *(path for paths in found.outputs.values() for path in paths.values()),
    ]:
        try:
            sizes[path] = Photo.open(path).size
        except PhotoError as error:
            yield f"{path}: {error}".rstrip(".")
    for outputs, (key, photo) in product(found.outputs.values(), found.inputs.items()):
        output = outputs.get(key)
        if output in sizes and photo in sizes and sizes[output] != sizes[photo]:
            (wide, high), (width, height) = sizes[output], sizes[photo]
            yield f"{output} is {wide}x{high}, its input {width}x{height}"


def _fitting(asked: int | None, usual: int, most: int, what: str) -> int:
    if asked is not None and asked > most:
        raise BrewsterError(
            f"{asked} {what} a participant were asked for",
            f"there are {most} at most",
            "ask for fewer",
        )
    return min(usual, most) if asked is None else asked


def _refuse_taken(out: Path) -> None:
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise TargetError(
            f"{out} is not empty", "a study is made once, in a folder of its own", "name another"
        )


# --- the pictures under their new names


@final
@dataclass(frozen=True)
class _Copier:
    """Copies pictures, each once, under names drawn by the rng."""

    folder: Path
    rng: Random
    on_progress: Callable[[int], None]
    pictures: dict[Path, StudyPicture] = field(default_factory=dict)

    def copy(self, path: Path) -> str:
        """The new name of a picture."""
        if path not in self.pictures:
            data = path.read_bytes()
            self.pictures[path] = self.write(Photo.open(data), hashlib.sha256(data).hexdigest())
            self.on_progress(len(self.pictures))
        return self.pictures[path].name

    def copy_spoilt(self, path: Path) -> str:
        """The new name of a picture, spoilt."""
        place = path / "spoilt"  # no file, but a name of its own
        data = path.read_bytes()
        spoilt = Photo.from_array(
            spoil(Photo.open(data).srgb_8bit(), self.rng.getrandbits(32)), encoding="srgb"
        )
        self.pictures[place] = self.write(spoilt, hashlib.sha256(data).hexdigest())
        return self.pictures[place].name

    def write(self, photo: Photo, source: str) -> StudyPicture:
        """Writes a picture without anything that tells where it comes from."""
        name = f"{self.rng.getrandbits(64):016x}.png"
        data = Photo.from_array(photo.srgb_8bit(), encoding="srgb").encode("png")
        write_atomically(self.folder / name, data)
        return StudyPicture(name, *photo.size, hashlib.sha256(data).hexdigest(), source)


def _comparisons(
    found: _StudyFiles, pairs: Sequence[tuple[str, str]], copier: _Copier
) -> Iterator[PairedComparison]:
    for key, photo in found.inputs.items():
        for first, second in pairs:
            outputs = (copier.copy(found.outputs[first][key]), copier.copy(found.outputs[second][key]))
            yield PairedComparison(*key, (first, second), copier.copy(photo), outputs)


def _catch_pool(found: _StudyFiles, copier: _Copier, rng: Random) -> Iterator[CatchTrial]:
    """Photos for catch trials, at most CATCH_POOL, each with an output of some method and that output spoilt."""
    for key in rng.sample(list(found.inputs), min(CATCH_POOL, len(found.inputs))):
        output = found.outputs[rng.choice(list(found.outputs))][key]
        yield CatchTrial(
            *key, copier.copy(found.inputs[key]), copier.copy(output), copier.copy_spoilt(output)
        )
