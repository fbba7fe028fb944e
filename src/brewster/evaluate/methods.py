"""What is measured: the unprocessed input, our models, and folders of pictures that any other method has left.

Every method answers a case with a transmission and perhaps a reflection. `key` says all that the answer depends on
beside the photo, so that an answer made once need not be made again.
"""

from __future__ import annotations

import gc
import hashlib
import time
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Final, Protocol, final

import numpy as np

from brewster.benchmarks.registry import Case
from brewster.errors import BrewsterError, PhotoError
from brewster.files import walk, write_atomically
from brewster.image_formats import SUFFIXES
from brewster.inference import Separator
from brewster.models.zoo import find_model, is_large
from brewster.options import Device, Quality
from brewster.photo import Photo

NOTHING: Final = "input (unprocessed)"
ANSWER_FORMAT: Final = 1
"""Raised when the same model comes to answer differently, so that kept answers are made again; see test_house_formats."""

_ENDINGS: Final = {"transmission": ("_t", "_l"), "reflection": ("_r",)}


@final
@dataclass(frozen=True, eq=False)
class MethodOutput:
    """The layers that a method gives for a photo.

    `seconds` is the wall time that this took it, if it was seen; `digest` the digest of the files that keep the answer.
    """

    transmission: Photo
    reflection: Photo | None = None
    seconds: float | None = None
    digest: str | None = None

    @classmethod
    def read(cls, files: Mapping[str, Path]) -> MethodOutput:
        """The answer in these files, by layer.

        Raises:
            PhotoError: one cannot be read.
        """
        data = {layer: _read(path) for layer, path in files.items()}
        photos = {layer: Photo.open(picture) for layer, picture in data.items()}
        return cls(photos["transmission"], photos.get("reflection"), digest=_digest(data.values()))


class Method(Protocol):
    """Anything that answers cases. It is sent to other processes, so it is data; a failure is an exception."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def exclusive(self) -> bool:
        """Whether it needs the memory for itself, and so answers after the others."""
        ...

    def about(self) -> dict[str, str]:
        """What it is, in plain values for results.json; the first is its kind."""
        ...

    def key(self, case: Case) -> str:
        """All that its answer depends on, beside the photo."""
        ...

    def answer(self, case: Case, photo: Photo) -> MethodOutput:
        """Its layers for the photo of this case."""
        ...

    def cached(self, case: Case) -> MethodOutput | None:
        """The answer as it lies on the disk, if it does."""
        ...


@final
@dataclass(frozen=True)
class IdentityBaseline:
    """The photo itself as transmission and black as reflection: what every method must beat."""

    name: str = NOTHING
    exclusive: Final = False

    def about(self) -> dict[str, str]:
        """Its kind."""
        return {"kind": "baseline"}

    def key(self, case: Case) -> str:  # noqa: ARG002  (it is the same for all)
        """Nothing."""
        return "nothing"

    def answer(self, case: Case, photo: Photo) -> MethodOutput:  # noqa: ARG002
        """The photo and black."""
        return MethodOutput(photo, photo.with_pixels(np.zeros_like(photo.pixels)))

    def cached(self, case: Case) -> MethodOutput | None:  # noqa: ARG002
        """Nothing is kept: it costs nothing."""
        return None


@final
@dataclass(frozen=True)
class ModelMethod:
    """A model, run through the `Separator` that users use; its answers are kept as PNG in `folder`.

    `folder` takes the form of a folder of predictions, and can be measured as one later.
    """

    name: str
    model: str
    folder: Path
    quality: Quality = "standard"
    device: Device = "auto"

    @property
    def exclusive(self) -> bool:
        """Large image models: two of them fill any card."""
        return is_large(self.model)

    def about(self) -> dict[str, str]:
        """Its kind, the digest of its file, and how closely it looks."""
        return {"kind": "model", "sha256": self._sha256, "quality": self.quality}

    def key(self, case: Case) -> str:  # noqa: ARG002  (it is the same for all)
        """The model's digest, its quality, and the format of the answers."""
        return f"{self._sha256} {self.quality} {ANSWER_FORMAT}"

    def answer(self, case: Case, photo: Photo) -> MethodOutput:
        """Separates the photo and keeps both layers.

        Raises:
            BrewsterError: the model or the photo cannot be used, or the layers cannot be written.
        """
        separator = (_large if self.exclusive else _small)(self.model, self.device)
        started = time.perf_counter()
        separation = separator(photo, quality=self.quality)
        seconds = time.perf_counter() - started
        files = self._files(case)
        for layer, path in files.items():
            data = getattr(separation, layer).encode("png", depth=8)
            write_atomically(path, data, overwrite=True)
        return replace(MethodOutput.read(files), seconds=seconds)  # what is kept is what is scored

    def cached(self, case: Case) -> MethodOutput | None:
        """The layers that were kept.

        Raises:
            PhotoError: they cannot be read.
        """
        files = self._files(case)
        return MethodOutput.read(files) if all(path.is_file() for path in files.values()) else None

    @cached_property
    def _sha256(self) -> str:
        if not self.exclusive:
            return find_model(self.model).verify()
        from brewster.models.diffusion.pipeline import fingerprint  # noqa: PLC0415  (wakes torch)

        return fingerprint(self.model, device=self.device)

    def _files(self, case: Case) -> dict[str, Path]:
        folder = self.folder / case.benchmark
        return {layer: folder / f"{case.name}.{layer}.png" for layer in ("transmission", "reflection")}


@cache
def _small(model: str, device: Device) -> Separator:
    """A model, loaded once a process."""
    return Separator.load(model, device=device)


_held: dict[tuple[str, Device], Separator] = {}


def _large(model: str, device: Device) -> Separator:
    """A model that makes room for the next one before that is loaded."""
    if (model, device) not in _held:
        _held.clear()
        gc.collect()
        _held[model, device] = Separator.load(model, device=device)
    return _held[model, device]


@final
@dataclass(frozen=True)
class PredictionFolder:
    """A folder with another method's pictures, found by name; README and docs say how they may be called."""

    name: str
    folder: Path
    exclusive: Final = False

    def about(self) -> dict[str, str]:
        """Its kind."""
        return {"kind": "predictions"}

    def key(self, case: Case) -> str:
        """The digest of the files, or what is wrong with them."""
        try:
            return _digest(_read(path) for path in self.files(case).values())
        except BrewsterError as error:
            return str(error)

    def answer(self, case: Case, photo: Photo) -> MethodOutput:  # noqa: ARG002  (it is answered already)
        """Reads its pictures for this case.

        Raises:
            PhotoError: there is none, there are several, or they cannot be read.
        """
        return MethodOutput.read(self.files(case))

    def cached(self, case: Case) -> MethodOutput | None:
        """What `answer` gives, and raises."""
        return MethodOutput.read(self.files(case))

    def files(self, case: Case) -> dict[str, Path]:
        """layer -> file for this case, transmission and perhaps reflection.

        Raises:
            PhotoError: there is no transmission, or more than one file for a layer.
        """
        found = {layer: self._candidates(case, layer) for layer in ("transmission", "reflection")}
        for layer, paths in found.items():
            if len(paths) > 1:
                raise PhotoError(
                    f"{self.name} has {len(paths)} pictures for the {layer} of {case.benchmark}/{case.name}"
                    f" ({', '.join(sorted(path.name for path in paths))})",
                    "one is needed",
                    "remove the others",
                )
        if not found["transmission"]:
            raise PhotoError(
                f"{self.name} has no picture for {case.benchmark}/{case.name}",
                f"such as {self.folder / case.benchmark / case.name}.png",
                "add it, or rename it",
            )
        return {layer: path for layer, paths in found.items() for path in paths}

    def unused(self, cases: Iterable[Case]) -> int:
        """How many of the folder's pictures answer none of these cases: a hint that names differ."""
        layers = ("transmission", "reflection")
        used = {path for case in cases for layer in layers for path in self._candidates(case, layer)}
        return sum(map(len, self._pictures.values())) - len(used)

    def refuse_wrong_pairing(self, cases: Sequence[Case]) -> None:
        """Refuses a folder in which one picture would answer two cases, or none any.

        Raises:
            PhotoError: so it is.
        """
        if not self.folder.is_dir():
            raise PhotoError(
                f"{self.folder} is no folder", f"{self.name} needs one with its pictures", "name another"
            )
        owners: defaultdict[Path, list[Case]] = defaultdict(list)
        for case in cases:
            for path in self._candidates(case, "transmission"):
                owners[path].append(case)
        for path, claimed in owners.items():
            if len(claimed) > 1:
                first, second, *_ = (f"{case.benchmark}/{case.name}" for case in claimed)
                raise PhotoError(
                    f"{path} could be {self.name}'s answer to {first} and to {second}",
                    "a picture answers one case",
                    f"sort the pictures into {', '.join(sorted({str(self.folder / case.benchmark) for case in claimed}))}",
                )
        if not owners:
            example = f"{cases[0].benchmark}/{cases[0].name}" if cases else "a case"
            raise PhotoError(
                f"no picture in {self.folder} is called like a case",
                f"{self.name} needs pictures such as {example}.png",
                "rename them, or name another folder",
            )

    def _candidates(self, case: Case, layer: str) -> set[Path]:
        """The files that could be this layer, under any of the names that are understood."""
        root = self.folder / case.benchmark
        root = root if root.is_dir() else self.folder
        places = [root / f"{stem}.{layer}" for stem in (case.name, case.place)]
        places += [root / folder / case.name for folder in (layer, f"{layer}_layer")]
        places += [root / case.name / name for name in self._own_names(root / case.name, layer)]
        if layer == "transmission":
            places += [root / case.name]
        return {path for place in places for path in self._pictures.get(_plain(place), ())}

    def _own_names(self, folder: Path, layer: str) -> list[str]:
        """Stems such as rdnet_t or dsrnet_l, where a method has left a folder for each picture."""
        return [stem for stem in self._stems.get(folder, ()) if stem.endswith(_ENDINGS[layer])]

    @cached_property
    def _pictures(self) -> dict[Path, list[Path]]:
        """The folder's pictures by their paths without suffix."""
        found: defaultdict[Path, list[Path]] = defaultdict(list)
        for path in filter(_is_picture, walk(self.folder, _is_picture)):
            found[_plain(path.with_suffix(""))].append(path)
        return dict(found)

    @cached_property
    def _stems(self) -> dict[Path, list[str]]:
        stems: defaultdict[Path, list[str]] = defaultdict(list)
        for place in self._pictures:
            stems[place.parent].append(place.name)
        return dict(stems)


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _plain(path: Path) -> Path:
    """A path in one spelling: some systems write an accented letter as two characters."""
    return Path(unicodedata.normalize("NFC", str(path)))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PhotoError(
            f"{path} cannot be read ({error.strerror or error})",
            "an answer's file",
            "mend that and run again",
        ) from error


def _digest(data: Iterable[bytes]) -> str:
    """One digest of several files."""
    return hashlib.sha256(b"".join(hashlib.sha256(one).digest() for one in data)).hexdigest()


def refuse_names(methods: Sequence[Method]) -> None:
    """Refuses no method at all, two of one name, since tables could not tell them apart, and names that are no names of folders.

    Raises:
        BrewsterError: so it is.
    """
    if not methods:
        raise BrewsterError("there is no method", "one or more to measure", "begin with Nothing()")
    (name, count), *_ = Counter(method.name for method in methods).most_common(1)
    if count > 1:
        raise BrewsterError(
            f"{count} methods are called {name!r}", "each needs a name of its own", "write NAME=... for one"
        )
    for method in methods:
        if method.name in ("", ".", "..") or set("/\\") & set(method.name) or not method.name.isprintable():
            raise BrewsterError(
                f"a method is called {method.name!r}",
                "names become folders: no slashes, no control letters, not . or ..",
                "choose another with NAME=...",
            )
