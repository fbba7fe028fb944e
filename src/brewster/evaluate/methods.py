"""The methods to evaluate: the unprocessed input, brewster's models, and folders with predictions of other methods.

A method predicts a transmission and, optionally, a reflection for a case. Its `key` identifies everything that the
prediction depends on apart from the photo, so that a stored prediction can be reused.
"""

from __future__ import annotations

import gc
import hashlib
import time
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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

BASELINE: Final = "input (unprocessed)"
PREDICTION_FORMAT_VERSION: Final = 1
"""Increase it when the same model predicts other layers, so that stored predictions are made again; see test_house_formats."""

_STEM_SUFFIXES: Final = {"transmission": ("_t", "_l"), "reflection": ("_r",)}


@final
@dataclass(frozen=True, eq=False)
class MethodOutput:
    """The layers that a method predicts for a photo.

    `seconds` is the wall time of the prediction if it was measured, `digest` that of the files that store the layers.
    """

    transmission: Photo
    reflection: Photo | None = None
    seconds: float | None = None
    digest: str | None = None

    @classmethod
    def decode(cls, data: Mapping[str, bytes]) -> MethodOutput:
        """Decodes the encoded pictures of a prediction, by layer.

        Raises:
            PhotoError: a picture cannot be decoded.
        """
        photos = {layer: Photo.open(picture) for layer, picture in data.items()}
        return cls(photos["transmission"], photos.get("reflection"), digest=_digest(data.values()))


class Method(Protocol):
    """A method that predicts layers. It must be picklable, because worker processes run it. A failure is an exception."""

    @property
    def name(self) -> str:
        """The name in tables and results."""
        ...

    @property
    def exclusive(self) -> bool:
        """Whether it needs all memory for itself. Exclusive methods run after the others, one at a time."""
        ...

    def about(self) -> dict[str, str]:
        """A description for results.json; the first entry is its kind."""
        ...

    def key(self, case: Case) -> str:
        """Identifies everything that the prediction depends on, apart from the photo."""
        ...

    def predict(self, case: Case, photo: Photo) -> MethodOutput:
        """The predicted layers for the photo of a case."""
        ...

    def cached(self, case: Case) -> MethodOutput | None:
        """The stored prediction, or None if there is none."""
        ...


@final
@dataclass(frozen=True)
class IdentityBaseline:
    """The baseline: the photo itself as transmission, black as reflection."""

    name: str = BASELINE
    exclusive: Final = False

    def about(self) -> dict[str, str]:
        """The kind of method."""
        return {"kind": "baseline"}

    def key(self, case: Case) -> str:  # noqa: ARG002  (the same for all cases)
        """A constant."""
        return "identity"

    def predict(self, case: Case, photo: Photo) -> MethodOutput:  # noqa: ARG002
        """The photo and a black reflection."""
        return MethodOutput(photo, photo.with_pixels(np.zeros_like(photo.pixels)))

    def cached(self, case: Case) -> MethodOutput | None:  # noqa: ARG002
        """None: the baseline is not stored."""
        return None


@final
@dataclass(frozen=True)
class ModelMethod:
    """A model, run with `Separator` as users run it. Its predictions are stored as PNG files in `folder`.

    The folder has the layout that `PredictionFolder` reads.
    """

    name: str
    model: str
    folder: Path
    quality: Quality = "standard"
    device: Device = "auto"

    @property
    def exclusive(self) -> bool:
        """True for large image models: two of them do not fit on one GPU."""
        return is_large(self.model)

    def about(self) -> dict[str, str]:
        """The kind of method, the digest of the model file, and the quality."""
        return {"kind": "model", "sha256": self._sha256, "quality": self.quality}

    def key(self, case: Case) -> str:  # noqa: ARG002  (the same for all cases)
        """The model's digest, the quality, and the format of predictions."""
        return f"{self._sha256} {self.quality} {PREDICTION_FORMAT_VERSION}"

    def predict(self, case: Case, photo: Photo) -> MethodOutput:
        """Separates the photo and stores both layers.

        Returns:
            The layers as decoded from the stored bytes, so that a stored prediction has the same scores.

        Raises:
            BrewsterError: the model or the photo cannot be used, or the layers cannot be written.
        """
        separator = (_load_exclusive_separator if self.exclusive else _load_separator)(
            self.model, self.device
        )
        started = time.perf_counter()
        separation = separator(photo, quality=self.quality)
        seconds = time.perf_counter() - started
        data = {}
        for layer, path in self._files(case).items():
            data[layer] = getattr(separation, layer).encode("png", depth=8)
            write_atomically(path, data[layer], overwrite=True)
        return replace(MethodOutput.decode(data), seconds=seconds)

    def cached(self, case: Case) -> MethodOutput | None:
        """The stored layers, or None.

        Raises:
            PhotoError: a stored layer cannot be read.
        """
        files = self._files(case)
        if not all(path.is_file() for path in files.values()):
            return None
        return MethodOutput.decode({layer: _read(path) for layer, path in files.items()})

    @cached_property
    def _sha256(self) -> str:
        if not self.exclusive:
            return find_model(self.model).verify()
        from brewster.models.diffusion.pipeline import fingerprint  # noqa: PLC0415  (imports torch)

        return fingerprint(self.model, device=self.device)

    def _files(self, case: Case) -> dict[str, Path]:
        folder = self.folder / case.benchmark
        return {layer: folder / f"{case.name}.{layer}.png" for layer in ("transmission", "reflection")}


@cache
def _load_separator(model: str, device: Device) -> Separator:
    """A model, loaded once per process."""
    return Separator.load(model, device=device)


_exclusive_separators: dict[tuple[str, Device], Separator] = {}


def _load_exclusive_separator(model: str, device: Device) -> Separator:
    """A large model. The previous one is freed first, because two of them do not fit into memory."""
    if (model, device) not in _exclusive_separators:
        _exclusive_separators.clear()
        gc.collect()
        _exclusive_separators[model, device] = Separator.load(model, device=device)
    return _exclusive_separators[model, device]


@final
@dataclass(frozen=True)
class PredictionFolder:
    """A folder with the predictions of another method, found by file name; docs/evaluation.md lists the accepted names."""

    name: str
    folder: Path
    exclusive: Final = False
    _hashed: dict[Case, dict[str, bytes]] = field(default_factory=dict, init=False, repr=False, compare=False)
    """The bytes that `key` hashed last. `predict` decodes them, so that each file is read once."""

    def about(self) -> dict[str, str]:
        """The kind of method."""
        return {"kind": "predictions"}

    def key(self, case: Case) -> str:
        """The digest of the files, or the error message if they cannot be read."""
        self._hashed.clear()
        try:
            data = self._hashed[case] = self._read(case)
        except BrewsterError as error:
            return str(error)
        return _digest(data.values())

    def predict(self, case: Case, photo: Photo) -> MethodOutput:  # noqa: ARG002  (the predictions exist already)
        """Reads the pictures for a case.

        Raises:
            PhotoError: a layer has no file or several, or a file cannot be read.
        """
        return MethodOutput.decode(self._hashed.pop(case, {}) or self._read(case))

    def cached(self, case: Case) -> MethodOutput | None:
        """Same as `predict`.

        Raises:
            PhotoError: as `predict`.
        """
        return MethodOutput.decode(self._hashed.pop(case, {}) or self._read(case))

    def _read(self, case: Case) -> dict[str, bytes]:
        return {layer: _read(path) for layer, path in self.files(case).items()}

    def files(self, case: Case) -> dict[str, Path]:
        """layer -> file for a case: the transmission and, if there is one, the reflection.

        Raises:
            PhotoError: there is no transmission, or more than one file for a layer.
        """
        found = {layer: self._candidates(case, layer) for layer in ("transmission", "reflection")}
        for layer, paths in found.items():
            if len(paths) > 1:
                raise PhotoError(
                    f"{self.name} has {len(paths)} pictures for the {layer} of {case.benchmark}/{case.name}"
                    f" ({', '.join(sorted(path.name for path in paths))})",
                    "expected one",
                    "remove the others",
                )
        if not found["transmission"]:
            raise PhotoError(
                f"{self.name} has no picture for {case.benchmark}/{case.name}",
                f"expected a file such as {self.folder / case.benchmark / case.name}.png",
                "add or rename the file",
            )
        return {layer: path for layer, paths in found.items() for path in paths}

    def count_unmatched(self, cases: Iterable[Case]) -> int:
        """The number of pictures in the folder that belong to none of the cases: a hint that names differ."""
        layers = ("transmission", "reflection")
        used = {path for case in cases for layer in layers for path in self._candidates(case, layer)}
        return sum(map(len, self._pictures.values())) - len(used)

    def check_pairing(self, cases: Sequence[Case]) -> None:
        """Checks that the folder can be paired with the cases by name.

        Raises:
            PhotoError: the folder is missing, one picture fits two cases, or no picture fits any case.
        """
        if not self.folder.is_dir():
            raise PhotoError(
                f"{self.folder} is not a folder",
                f"{self.name} needs a folder with its pictures",
                "give another path",
            )
        owners: defaultdict[Path, list[Case]] = defaultdict(list)
        for case in cases:
            for path in self._candidates(case, "transmission"):
                owners[path].append(case)
        for path, claimed in owners.items():
            if len(claimed) > 1:
                first, second, *_ = (f"{case.benchmark}/{case.name}" for case in claimed)
                raise PhotoError(
                    f"{path} fits two cases of {self.name}, {first} and {second}",
                    "expected one case for each picture",
                    f"move the pictures into the folders {', '.join(sorted({str(self.folder / case.benchmark) for case in claimed}))}",
                )
        if not owners:
            example = f"{cases[0].benchmark}/{cases[0].name}" if cases else "a case"
            raise PhotoError(
                f"no picture in {self.folder} has the name of a case",
                f"{self.name} needs pictures such as {example}.png",
                "rename them, or give another folder",
            )

    def _candidates(self, case: Case, layer: str) -> set[Path]:
        """The files of a layer, under any of the accepted names."""
        root = self.folder / case.benchmark
        root = root if root.is_dir() else self.folder
        places = [root / f"{stem}.{layer}" for stem in (case.name, case.relative_path)]
        places += [root / folder / case.name for folder in (layer, f"{layer}_layer")]
        places += [root / case.name / name for name in self._suffixed_stems(root / case.name, layer)]
        if layer == "transmission":
            places += [root / case.name]
        return {path for place in places for path in self._pictures.get(_normalised(place), ())}

    def _suffixed_stems(self, folder: Path, layer: str) -> list[str]:
        """Stems such as rdnet_t or dsrnet_l, if the method wrote a folder for each picture."""
        return [stem for stem in self._stems.get(folder, ()) if stem.endswith(_STEM_SUFFIXES[layer])]

    @cached_property
    def _pictures(self) -> dict[Path, list[Path]]:
        """path without suffix -> the pictures at that path."""
        found: defaultdict[Path, list[Path]] = defaultdict(list)
        for path in filter(_is_picture, walk(self.folder, _is_picture)):
            found[_normalised(path.with_suffix(""))].append(path)
        return dict(found)

    @cached_property
    def _stems(self) -> dict[Path, list[str]]:
        stems: defaultdict[Path, list[str]] = defaultdict(list)
        for place in self._pictures:
            stems[place.parent].append(place.name)
        return dict(stems)


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _normalised(path: Path) -> Path:
    """The path in Unicode form NFC: some file systems store an accented letter as two characters."""
    return Path(unicodedata.normalize("NFC", str(path)))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PhotoError(
            f"{path} cannot be read ({error.strerror or error})",
            "expected a readable picture",
            "make the file readable and run again",
        ) from error


def _digest(data: Iterable[bytes]) -> str:
    """One SHA-256 of several files."""
    return hashlib.sha256(b"".join(hashlib.sha256(one).digest() for one in data)).hexdigest()


def check_names(methods: Sequence[Method]) -> None:
    """Checks that there is a method, and that the names are unique and valid as folder names.

    Raises:
        BrewsterError: there is no method, two methods share a name, or a name is not valid for a folder.
    """
    if not methods:
        raise BrewsterError("there is no method", "expected one or more", "start with IdentityBaseline()")
    (name, count), *_ = Counter(method.name for method in methods).most_common(1)
    if count > 1:
        raise BrewsterError(
            f"{count} methods have the name {name!r}", "expected unique names", "rename one with NAME=..."
        )
    for method in methods:
        if method.name in ("", ".", "..") or set("/\\") & set(method.name) or not method.name.isprintable():
            raise BrewsterError(
                f"a method has the name {method.name!r}",
                "names are used for folders: no slashes, no control characters, not . or ..",
                "choose another name with NAME=...",
            )
