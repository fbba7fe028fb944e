"""Create a study from folders of outputs: pair pictures by name and copy them under random names.

All files are checked before anything is written, and one error lists all problems. Pictures are
stored as upright 8-bit sRGB PNG without metadata, so every browser shows the same pixels, and
neither format nor EXIF reveals the method.
"""

import hashlib
import secrets
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product
from pathlib import Path
from random import Random
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

import brewster
from brewster.base.files import (
    atomic_path,
    is_image_file,
    is_unicode,
    natural_key,
    normalised,
    walk,
    write_atomically,
)
from brewster.base.image_formats import SUFFIXES
from brewster.errors import BrewsterError, OutputError, PhotoError, counted
from brewster.evaluation.study import study
from brewster.photo import Photo

DEFAULT_PAIRS: Final = 40
DEFAULT_CATCHES: Final = 4
CATCH_POOL_SIZE: Final = 24
_BLUR_RADIUS: Final = 0.02
"""The radius of the box blur of degraded pictures, as a fraction of the longer side."""
_NOISE_STD: Final = 28.0
"""Standard deviation of the noise of degraded pictures, in 8-bit code values."""
DEFAULT_CONSENT: Final = """\
In this study you compare pictures. You see a photo that was taken through glass, and two results \
of removing the reflection from it. Choose the one that looks better to you, or say that they are \
similar. There are no right or wrong answers.

Taking part is voluntary. You can stop at any time, and continue later with your personal link.

We store your choices with their times, the size and kind of your screen, and the date on which \
you agreed to take part. We store no name and no address."""

Key = tuple[str, str]
"""The dataset of a picture, and its file name without the suffix (the stem)."""
_Outputs = Mapping[str, Mapping[Key, Path]]
"""The outputs of each method, by (dataset, stem)."""


def create_study(
    out: Path,
    inputs: Path,
    methods: Mapping[str, Path],
    *,
    datasets: Sequence[str] = (),
    names: Sequence[str] = (),
    pairs: int | None = None,
    catch_trials: int | None = None,
    all_pairs: bool = False,
    seed: int | None = None,
    consent: str = DEFAULT_CONSENT,
    on_progress: Callable[[int], None] = lambda _done: None,
) -> study.Study:
    """Create a study of all pictures in the folder `inputs`.

    `out` is the folder of the new study: empty or new. `methods` has the folder of outputs by
    method name. The first method is compared with each other one; with `all_pairs`, all are.
    `datasets` and `names` ("dataset/stem", or "stem" without datasets) are those to use, by default
    all. `pairs` and `catch_trials` are the numbers for each participant, by default 40 and 4, or
    all if there are fewer. `seed` is that of the assignment, by default a random one.

    Raises BrewsterError if there are fewer than two methods, files are missing, unreadable or of
    different sizes, or more pairs or catch trials are requested than exist, and OutputError if
    `out` is not empty or cannot be written.
    """
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise OutputError(
            f"{out} is not empty", "expected an empty or new folder", "choose another folder"
        )
    photos, outputs = _pair_pictures(inputs, methods, datasets, names)
    compared = list(combinations(methods, 2))
    compared = compared if all_pairs else compared[: len(methods) - 1]
    seed = secrets.randbelow(1 << 32) if seed is None else seed
    pairs_each = _limited(pairs, DEFAULT_PAIRS, len(compared) * len(photos), "pairs")
    pool_size = min(CATCH_POOL_SIZE, len(photos))
    catch_trials = _limited(catch_trials, DEFAULT_CATCHES, pool_size, "catch trials")
    with atomic_path(out) as folder:
        copier = _Copier(folder / study.PICTURES_FOLDER, Random(f"{seed}/names"), on_progress)  # noqa: S311
        comparisons = tuple(
            study.PairedComparison(
                *key,
                (first, second),
                outputs=(copier.copy(outputs[first][key]), copier.copy(outputs[second][key])),
                photo=copier.copy(photo),
            )
            for key, photo in photos.items()
            for first, second in compared
        )
        rng = Random(f"{seed}/catch_trials")  # noqa: S311
        pool = []
        for key in rng.sample(list(photos), pool_size):
            output = outputs[rng.choice(list(outputs))][key]
            photo = copier.copy(photos[key])
            good = copier.copy(output)
            pool.append(study.CatchTrial(*key, photo, good, copier.copy(output, degraded=True)))
        description = study.StudyDescription(
            brewster=brewster.__version__,
            seed=seed,
            pairs=pairs_each,
            catch_trials=catch_trials,
            consent=consent,
            methods=tuple(methods),
            datasets=tuple(dict.fromkeys(dataset for dataset, _ in photos)),
            pictures=tuple(sorted(copier.pictures.values(), key=lambda picture: picture.name)),
            comparisons=comparisons,
            catch_pool=tuple(pool),
        )
        study.write_study(folder, description)
    return study.Study(out, description)


def _pair_pictures(
    inputs: Path, methods: Mapping[str, Path], datasets: Sequence[str], names: Sequence[str]
) -> tuple[Mapping[Key, Path], _Outputs]:
    """Returns the inputs and the outputs, after checking them. One error lists all problems."""
    if len(methods) < 2:
        happened = f"the number of methods is {len(methods)}"
        raise BrewsterError(
            happened, "expected two or more methods", "add another --method NAME=FOLDER"
        )
    photos, *found = (
        select_pictures(find_pictures(path, datasets), names, path)
        for path in (inputs, *methods.values())
    )
    outputs = dict(zip(methods, found, strict=True))
    problems = []
    for name, paths in outputs.items():
        problems += [
            f"{name} has no {methods[name].joinpath(*key)}.*" for key in photos if key not in paths
        ]
        problems += [
            f"{paths[key]} has no input in {inputs / key[0]}" for key in paths if key not in photos
        ]
    problems += [
        f"the name of {str(path)!r} is not UTF-8"
        for key, path in photos.items()
        if not is_unicode("/".join(key))
    ]
    problems += _file_problems(photos, outputs)
    if problems:
        raise BrewsterError(
            f"the pictures have {counted(len(problems), 'problem')}: {shorten_list(problems)}",
            "expected one output of each method for every input, with the size of the input",
            "fix these files and run the command again; nothing was written",
        )
    return photos, outputs


def _file_problems(photos: Mapping[Key, Path], outputs: _Outputs) -> Iterator[str]:
    """Yield a message for each file that cannot be decoded, and for each output of another size
    than its input.
    """
    sizes: dict[Path, tuple[int, int]] = {}
    for path in (path for paths in (photos, *outputs.values()) for path in paths.values()):
        try:
            sizes[path] = Photo.open(path).size
        except PhotoError as error:
            yield f"{path}: {error}".rstrip(".")
    for paths, (key, photo) in product(outputs.values(), photos.items()):
        output = paths.get(key)
        if output in sizes and photo in sizes and sizes[output] != sizes[photo]:
            (output_width, output_height), (width, height) = sizes[output], sizes[photo]
            yield (
                f"{output} has {output_width}x{output_height} pixels, but its input has "
                f"{width}x{height}"
            )


def _limited(requested: int | None, default: int, maximum: int, what: str) -> int:
    if requested is not None and requested > maximum:
        happened = f"{requested} {what} for each participant were requested"
        raise BrewsterError(happened, f"at most {maximum} are available", "request fewer")
    return min(default, maximum) if requested is None else requested


@final
@dataclass(frozen=True)
class _Copier:
    """Copies each picture once, under a random name."""

    folder: Path
    rng: Random
    on_progress: Callable[[int], None]
    pictures: dict[Path, study.StudyPicture] = field(default_factory=dict)

    def copy(self, path: Path, *, degraded: bool = False) -> str:
        """Writes a picture, or a degraded copy of it, as PNG without metadata, if it is new.
        Returns its name.
        """
        key = path / "degraded" if degraded else path  # no source file has this key
        if key not in self.pictures:
            source = path.read_bytes()
            pixels = Photo.open(source).srgb_8bit()
            if degraded:
                pixels = _degraded(pixels, self.rng.getrandbits(32))
            photo = Photo.from_array(pixels, encoding="srgb")
            name = f"{self.rng.getrandbits(64):016x}.png"
            data = photo.encode("png")
            write_atomically(self.folder / name, data)
            digests = (hashlib.sha256(file).hexdigest() for file in (data, source))
            self.pictures[key] = study.StudyPicture(name, *photo.size, *digests)
            self.on_progress(len(self.pictures))
        return self.pictures[key].name


def _degraded(picture: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """Blurs an sRGB picture (H, W, 3) twice with a box filter, which preserves large shapes, and
    adds grey noise.
    """
    radius = max(2, round(_BLUR_RADIUS * max(picture.shape[:2])))
    blurred = picture.astype(np.float32)
    # moving means over 2 radius + 1 values; edge values are repeated beyond the border
    for axis in (0, 1, 0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (radius + 1, radius)
        sums = np.cumsum(np.pad(blurred, padding, mode="edge"), axis=axis, dtype=np.float64)
        starts = np.arange(picture.shape[axis])
        sums = np.take(sums, starts + 2 * radius + 1, axis=axis) - np.take(sums, starts, axis=axis)
        blurred = (sums / (2 * radius + 1)).astype(np.float32)
    noise = np.random.default_rng(seed).normal(0, _NOISE_STD, (*picture.shape[:2], 1))
    return np.rint(blurred + noise).clip(0, 255).astype(np.uint8)


# --- finding pictures by dataset and name: real/12.png is picture 12 of the dataset real

_MAX_LISTED: Final = 8
_TRANSMISSION: Final = ".transmission"
_TRANSMISSION_FOLDERS: Final = ("transmission", "transmission_layer")


def find_pictures(folder: Path, datasets: Sequence[str] = ()) -> dict[Key, Path]:
    """Find pictures in the subfolders, one for each dataset, or in the folder itself if no
    subfolder has pictures.

    Outputs may be named as `brewster -o` names them: `name.transmission.png` counts as `name`, and
    the files `name.reflection.png` and `name.confidence.png` of the same photo are ignored. As in
    `brewster evaluate`, they may also be in `transmission/name.png` or `name/transmission.png`,
    with the folder of the dataset outside or inside; other layers are then ignored.

    Args:
        folder: the inputs, or the outputs of a method.
        datasets: the datasets to use, in this order; all of them if it is empty.

    Returns:
        The files by (dataset, stem), in natural order (2 before 10).

    Raises:
        BrewsterError: the folder contains no picture, a dataset is missing, two files have the same
            name, or pictures are both in the folder and in its subfolders, and `datasets` is empty.
    """
    if not folder.is_dir():
        raise BrewsterError(
            f"{folder} is not a folder", "expected a folder with pictures", "check the path"
        )
    layered = _list_layered(folder)
    subfolders = {
        normalised(sub.name): sub for sub in folder.iterdir() if sub.is_dir() and sub.name[0] != "."
    }
    listed = (
        (name, _list_pictures(subfolders[name])) for name in sorted(subfolders, key=natural_key)
    )
    stems_by_dataset = layered or {name: stems for name, stems in listed if stems}
    if missing := [name for name in datasets if name not in stems_by_dataset]:
        raise BrewsterError(
            f"{folder} has no dataset {missing[0]!r}",
            "expected the name of a subfolder with pictures "
            f"({', '.join(stems_by_dataset) or 'there are none'})",
            "check the name",
        )
    if not datasets and not layered and (top_level := _list_pictures(folder)):
        if stems_by_dataset:
            names = shorten_list([path.name for path in top_level])
            raise BrewsterError(
                f"{folder} contains pictures ({names}) and subfolders with pictures "
                f"({', '.join(stems_by_dataset)})",
                "expected pictures either in the folder or in subfolders, one for each dataset",
                "move the pictures into a subfolder, or choose subfolders: --dataset NAME",
            )
        stems_by_dataset = {study.UNNAMED_DATASET: top_level}
    found: defaultdict[Key, list[Path]] = defaultdict(list)
    for name in dict.fromkeys(datasets or stems_by_dataset):
        for path, stem in stems_by_dataset[name].items():
            found[name, stem].append(path)
    if not found:
        happened = f"{folder} contains no picture"
        raise BrewsterError(
            happened, "expected pictures, or subfolders with pictures", "check the path"
        )
    if duplicates := [
        " and ".join(sorted(map(str, paths))) for paths in found.values() if len(paths) > 1
    ]:
        raise BrewsterError(
            f"{shorten_list(duplicates)} have the same name",
            "expected different names without the suffix, because pictures are paired by name",
            "keep one file of each name",
        )
    return {key: paths[0] for key, paths in found.items()}


def select_pictures(
    pictures: Mapping[Key, Path], names: Sequence[str], folder: Path
) -> dict[Key, Path]:
    """The pictures with these names, in the order of `pictures`; all of them if `names` is empty. A
    name is "dataset/stem", or "stem" if there are no datasets; a suffix is allowed. Raises
    BrewsterError if one has none.
    """
    by_name = {"/".join(filter(None, key)): key for key in pictures}
    stems = {
        name: name.rpartition(".")[0] if f".{name.rpartition('.')[2]}".lower() in SUFFIXES else name
        for name in map(normalised, names)
    }
    keys = {name: by_name.get(name, by_name.get(stem)) for name, stem in stems.items()}
    if missing := [name for name, key in keys.items() if key is None]:
        raise BrewsterError(
            f"{folder} has no picture for these names: {shorten_list(missing)}",
            f"expected names such as {', '.join(list(by_name)[:3])}",
            "correct these names",
        )
    return {key: path for key, path in pictures.items() if not names or key in keys.values()}


def shorten_list(items: Sequence[str]) -> str:
    """Join the first items with semicolons, and add the number of the others."""
    remaining = len(items) - _MAX_LISTED
    return "; ".join(items[:_MAX_LISTED]) + (f"; and {remaining} more" if remaining > 0 else "")


def _list_layered(folder: Path) -> dict[str, dict[Path, str]]:
    """The stems of the transmissions by dataset and path in natural order, if they are in folders
    of their layer, or in a folder for each photo; otherwise empty.
    """
    found: defaultdict[str, dict[Path, str]] = defaultdict(dict)
    for path in filter(is_image_file, walk(folder, is_image_file)):
        *parents, stem = map(normalised, path.relative_to(folder).with_suffix("").parts)
        names = [name for name in (*parents, stem) if name not in _TRANSMISSION_FOLDERS]
        if len(names) == len(parents) and names:
            *dataset, stem = names
            found["/".join(dataset) or study.UNNAMED_DATASET][path] = stem
    return {
        name: dict(sorted(found[name].items(), key=lambda pair: (natural_key(pair[1]), pair[0])))
        for name in sorted(found, key=natural_key)
    }


def _list_pictures(folder: Path) -> dict[Path, str]:
    """The stems of the pictures in a folder, by path in natural order, without other layers than
    the transmission.
    """
    pictures = {path: normalised(path.stem) for path in folder.iterdir() if is_image_file(path)}
    names = [
        stem.removesuffix(_TRANSMISSION)
        for stem in pictures.values()
        if stem.endswith(_TRANSMISSION)
    ]
    others = {f"{name}{layer}" for name in names for layer in (".reflection", ".confidence")}
    stems = {
        path: stem.removesuffix(_TRANSMISSION)
        for path, stem in pictures.items()
        if stem not in others
    }
    return dict(sorted(stems.items(), key=lambda pair: (natural_key(pair[1]), pair[0])))
