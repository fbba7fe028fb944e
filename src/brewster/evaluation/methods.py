"""The methods to evaluate: the unprocessed input, brewster's models, and folders with predictions
of other methods.

A method predicts a transmission and, optionally, a reflection for a case. Its `key` identifies all
inputs of the prediction except the photo. If the key and the photo are unchanged, a stored
prediction is reused.
"""

from __future__ import annotations

import gc
import hashlib
import time
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Final, final

import numpy as np

from brewster.base.files import is_image_file, normalised, walk, write_atomically
from brewster.base.remote_path import read_image
from brewster.errors import BrewsterError, PhotoError
from brewster.evaluation.benchmarks.image_files import Case
from brewster.options import Device, Quality
from brewster.photo import Photo
from brewster.separation import Separator, registry

BASELINE: Final = "input (unprocessed)"
PREDICTION_FORMAT_VERSION: Final = 2
"""Increase this version when the predictions of a model change. Those of other versions are not
reused. test_conventions_formats checks it.
"""

_STEM_SUFFIXES: Final = {"transmission": ("_t", "_l"), "reflection": ("_r",)}
"""Ends of the file stems that published code writes: rdnet_t (RDNet), dsrnet_l (DSRNet)."""


@final
@dataclass(frozen=True, eq=False)
class MethodOutput:
    """The layers that a method predicts for a photo. `seconds`: its wall time, if measured.
    `digest`: of its files, if stored."""

    transmission: Photo
    reflection: Photo | None = None
    seconds: float | None = None
    digest: str | None = None

    @classmethod
    def decode(cls, data: Mapping[str, bytes]) -> MethodOutput:
        """Decodes a prediction from layer -> encoded bytes. Raises PhotoError if a layer cannot be
        decoded.
        """
        photos = {layer: Photo.open(encoded) for layer, encoded in data.items()}
        return cls(photos["transmission"], photos.get("reflection"), digest=_digest(data.values()))


class Method(ABC):
    """A method that predicts the layers of photos. It must be picklable, because worker processes
    run it.
    """

    name: str
    """The name in tables and results."""
    kind: ClassVar[str]
    """The kind of method, for results.json."""

    @property
    def exclusive(self) -> bool:
        """Whether the method needs the whole memory. Exclusive methods run after the others, one at
        a time.
        """
        return False

    def about(self) -> dict[str, str]:
        """Returns a description for results.json."""
        return {"kind": self.kind}

    @abstractmethod
    def key(self, case: Case) -> str:
        """Returns a text that identifies all inputs of the prediction except the photo."""

    @abstractmethod
    def predict(self, case: Case, photo: Photo) -> MethodOutput:
        """Returns the predicted layers for the photo of a case. Any exception counts as a failure
        of the method.
        """

    def files(self, case: Case) -> dict[str, Path]:  # noqa: ARG002
        """Returns layer -> file of the stored prediction; empty if the method stores none."""
        return {}

    def cached(self, case: Case) -> MethodOutput | None:
        """Returns the stored prediction, or None if a file is missing or damaged."""
        try:
            data = {layer: read_image(path) for layer, path in self.files(case).items()}
            return MethodOutput.decode(data) if data else None
        except PhotoError:
            return None


@final
@dataclass(frozen=True)
class IdentityBaseline(Method):
    """The baseline: the transmission is the photo itself, the reflection is black. It is not
    stored.
    """

    name: str = BASELINE
    kind: ClassVar[str] = "baseline"

    def key(self, case: Case) -> str:  # noqa: ARG002
        """See `Method.key`."""
        return "identity"

    def predict(self, case: Case, photo: Photo) -> MethodOutput:  # noqa: ARG002
        """See `Method.predict`."""
        return MethodOutput(photo, photo.with_pixels(np.zeros_like(photo.pixels)))


_separators: dict[tuple[str, Device], Separator] = {}
"""The models that this process has loaded. Each is loaded once, but a diffusion model replaces the
one before it.
"""


@final
@dataclass(frozen=True)
class ModelMethod(Method):
    """A model, run by `Separator`. Its predictions are stored as PNG files in `folder`, which
    `PredictionFolder` can read.
    """

    name: str
    model: str
    folder: Path
    quality: Quality = "standard"
    device: Device = "auto"
    burst: bool = False
    """Whether all photos of a burst are used. Single photos are separated as before."""

    @property
    def exclusive(self) -> bool:
        """Whether there is memory for only one such model, as for diffusion models and published
        networks.
        """
        return registry.find(self.model).is_exclusive

    def about(self) -> dict[str, str]:
        """Returns the kind of method, the digest of the model file, and the quality."""
        return {
            "kind": "burst" if self.burst else "model",
            "sha256": self._sha256,
            "quality": self.quality,
        }

    def key(self, case: Case) -> str:
        """Returns the digest of the model, quality, version of predictions, and digest of the
        frames of a burst.
        """
        frames = (
            f" {_digest(frame.read() for frame in case.frames)}"
            if self.burst and case.frames
            else ""
        )
        return f"{self._sha256} {self.quality} {PREDICTION_FORMAT_VERSION}{frames}"

    def predict(self, case: Case, photo: Photo) -> MethodOutput:
        """Separates the photo and stores both layers. Returns the layers decoded from the stored
        bytes, so that new and stored predictions have the same scores. Raises BrewsterError.
        """
        if (key := (self.model, self.device)) not in _separators:
            if self.exclusive:  # memory is limited: the previous model is freed first
                _separators.clear()
                gc.collect()
            _separators[key] = Separator.load(self.model, device=self.device)
        separator = _separators[key]
        started = time.perf_counter()
        if self.burst and case.frames:
            from brewster.film import separate_burst  # noqa: PLC0415  (imports numba)

            frames = [Photo.open(file.read()) for file in case.frames]
            for i, frame in enumerate(frames):
                if frame.size != photo.size:  # the photo was resized
                    frames[i] = Photo.from_array(frame.resized(*photo.size), encoding="linear")
            separation = separate_burst(frames, separator=separator, quality=self.quality)
        else:
            separation = separator(photo, quality=self.quality)
        seconds = time.perf_counter() - started
        data = {}
        for layer, path in self.files(case).items():
            data[layer] = getattr(separation, layer).encode("png", depth=8)
            write_atomically(path, data[layer], overwrite=True)
        return replace(MethodOutput.decode(data), seconds=seconds)

    @cached_property
    def _sha256(self) -> str:
        return registry.find(self.model).fingerprint(self.device)

    def files(self, case: Case) -> dict[str, Path]:
        """Returns layer -> file in which the prediction for a case is stored."""
        folder = self.folder / case.benchmark
        return {
            layer: folder / f"{case.name}.{layer}.png" for layer in ("transmission", "reflection")
        }


@final
@dataclass(frozen=True)
class PredictionFolder(Method):
    """A folder with the predictions of another method. docs/evaluation.md lists the accepted file
    names.
    """

    name: str
    folder: Path
    kind: ClassVar[str] = "predictions"

    def key(self, case: Case) -> str:
        """Returns the digest of the files. If they cannot be read, returns the error message;
        `predict` then fails.
        """
        try:
            return _digest(map(read_image, self.files(case).values()))
        except BrewsterError as error:
            return str(error)

    def predict(self, case: Case, photo: Photo) -> MethodOutput:  # noqa: ARG002  (the predictions exist already)
        """Returns the stored prediction. Raises PhotoError if a layer has no, several or an
        unreadable file.
        """
        return MethodOutput.decode(
            {layer: read_image(path) for layer, path in self.files(case).items()}
        )

    def files(self, case: Case) -> dict[str, Path]:
        """Returns layer -> file for a case: the transmission and, if there is one, the reflection.
        Raises PhotoError if there is no transmission, or there are several files for a layer.
        """
        found = {layer: self._candidates(case, layer) for layer in ("transmission", "reflection")}
        for layer, paths in found.items():
            if len(paths) > 1:
                raise PhotoError(
                    f"{self.name} has {len(paths)} files for the {layer} of "
                    f"{case.benchmark}/{case.name}"
                    f" ({', '.join(sorted(path.name for path in paths))})",
                    "expected one file",
                    "remove the others",
                )
        if not found["transmission"]:
            raise PhotoError(
                f"{self.name} has no prediction for {case.benchmark}/{case.name}",
                f"expected a file such as {self.folder / case.benchmark / case.name}.png",
                "add or rename the file",
            )
        return {layer: path for layer, paths in found.items() for path in paths}

    def count_unmatched(self, cases: Iterable[Case]) -> int:
        """Returns the number of images in the folder that belong to no case. Not 0: names may be
        wrong.
        """
        layers = ("transmission", "reflection")
        used = {
            path for case in cases for layer in layers for path in self._candidates(case, layer)
        }
        return sum(map(len, self._images.values())) - len(used)

    def check_pairing(self, cases: Sequence[Case]) -> None:
        """Checks that the folder can be paired with the cases by name. Raises PhotoError if the
        folder is missing, one image matches two cases, or no image matches a case.
        """
        if not self.folder.is_dir():
            raise PhotoError(
                f"{self.folder} is not a folder",
                f"expected a folder with the predictions of {self.name}",
                "choose another folder",
            )
        cases_by_path: defaultdict[Path, list[Case]] = defaultdict(list)
        for case in cases:
            for path in self._candidates(case, "transmission"):
                cases_by_path[path].append(case)
        for path, matches in cases_by_path.items():
            if len(matches) > 1:
                first, second, *_ = (f"{case.benchmark}/{case.name}" for case in matches)
                raise PhotoError(
                    f"{path} matches two cases, {first} and {second}",
                    "expected one case for each image",
                    "move the images into folders with the names of the benchmarks in "
                    + str(self.folder),
                )
        if not cases_by_path:
            example = f"{cases[0].benchmark}/{cases[0].name}" if cases else "a case"
            raise PhotoError(
                f"no image in {self.folder} has the name of a case",
                f"expected images such as {example}.png",
                "rename the images, or choose another folder",
            )

    def _candidates(self, case: Case, layer: str) -> set[Path]:
        root = self.folder / case.benchmark
        root = root if root.is_dir() else self.folder
        paths = [root / f"{stem}.{layer}" for stem in (case.name, case.relative_path)]
        folders = (layer, f"{layer}_layer")
        paths += [root / folder / case.name for folder in folders]
        paths += [self.folder / folder / case.benchmark / case.name for folder in folders]
        paths += [root / case.name / folder for folder in folders]
        # some methods write one folder for each photo, with files such as rdnet_t or dsrnet_l
        stems = self._stems.get(root / case.name, ())
        paths += [root / case.name / stem for stem in stems if stem.endswith(_STEM_SUFFIXES[layer])]
        if layer == "transmission":
            paths += [root / case.name]
        return {file for path in paths for file in self._images.get(normalised(str(path)), ())}

    @cached_property
    def _images(self) -> dict[str, list[Path]]:
        """path without suffix -> image files with this path."""
        found: defaultdict[str, list[Path]] = defaultdict(list)
        for path in filter(is_image_file, walk(self.folder, is_image_file)):
            found[normalised(str(path.with_suffix("")))].append(path)
        return dict(found)

    @cached_property
    def _stems(self) -> dict[Path, list[str]]:
        """folder -> stems of its image files."""
        stems: defaultdict[Path, list[str]] = defaultdict(list)
        for path in map(Path, self._images):
            stems[path.parent].append(path.name)
        return dict(stems)


def _digest(data: Iterable[bytes]) -> str:
    return hashlib.sha256(
        b"".join(hashlib.sha256(content).digest() for content in data)
    ).hexdigest()


def check_names(methods: Sequence[Method]) -> None:
    """Raises BrewsterError unless there is a method, and the names are unique and valid as folder
    names.
    """
    if not methods:
        raise BrewsterError(
            "there is no method",
            "expected at least one method",
            "add a method such as IdentityBaseline()",
        )
    (name, count), *_ = Counter(method.name for method in methods).most_common(1)
    if count > 1:
        happened = f"{count} methods have the name {name!r}"
        raise BrewsterError(happened, "expected unique names", "rename one method with NAME=...")
    for method in methods:
        if (
            method.name in ("", ".", "..")
            or set("/\\") & set(method.name)
            or not method.name.isprintable()
        ):
            raise BrewsterError(
                f"a method has the name {method.name!r}",
                "expected a valid folder name, without slashes and control characters, and not . "
                "or ..",
                "choose another name with NAME=...",
            )
