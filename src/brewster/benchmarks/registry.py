"""Reads public benchmarks from the user's own copies: every photo with its ground truth, paired by name.

for benchmark in read_benchmark("sir2", Path("SIR2")):
    print(benchmark.title, len(benchmark.cases), *benchmark.remarks, *benchmark.refused)

`pairing` finds the pictures that belong together. This module names the cases, compares the sizes in the file headers,
checks the number of pictures and draws the subset of the paper. A case that does not fit is listed in `refused`.
"""

from __future__ import annotations

import difflib
import os
import re
import tarfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Final, final

from brewster.benchmarks.pairing import (
    SIR2_TREES,
    FolderListing,
    PictureGroup,
    find_roles,
    find_split,
    find_subsets,
    join_names,
    natural_key,
    read_folders,
    read_tree,
)
from brewster.errors import MissingExtra, PhotoError, UnreadablePhoto
from brewster.photo import read_size

PAPER_SEED: Final = 181
"""Seed of `paper_draw`. The value is arbitrary: the number of pictures in the paper's average."""

_RENDERED: Final = ("photo.jpg", "background.jpg", "reflection.jpg")
_SCENES: Final = 20
_SCALES: Final = {"0.25": "a quarter of the scale", "0.5": "half the scale", "2": "twice the scale"}


@final
@dataclass(frozen=True)
class PictureFile:
    """The location of a picture: a whole file, or `span` (offset, length) in bytes of a tar shard."""

    path: Path
    span: tuple[int, int] | None = None

    def read(self) -> bytes:
        """The encoded bytes of the picture.

        Raises:
            UnreadablePhoto: the file is missing, not readable, or shorter than the span requires.
        """
        try:
            return self._read()
        except OSError as error:
            raise UnreadablePhoto(
                f"{self} cannot be read ({error.strerror or error})",
                "expected the picture at the place where it was found",
                "make the file readable and run again",
            ) from error

    def __str__(self) -> str:
        return f"{self.path}" if self.span is None else f"{self.path} from byte {self.span[0]}"

    def _read(self) -> bytes:
        offset, length = self.span or (0, -1)
        with self.path.open("rb") as file:
            file.seek(offset)
            data = file.read(length)
        if len(data) < length:
            raise OSError(f"it has {len(data)} of {length} bytes")
        return data


@final
@dataclass(frozen=True)
class Case:
    """A photo to separate, with its ground truth.

    `name` is unique within the benchmark; reports and prediction folders use it. Cases of one `scene` show the same
    objects, so they are not statistically independent; `scene` equals `name` if the scene is unknown. `relative_path` is
    the photo's path relative to the benchmark folder, without suffix, with forward slashes. If `rendered`, the ground
    truth is exact: transmission is the background without the glass, reflection is the light that the glass adds.
    """

    benchmark: str
    name: str
    scene: str
    relative_path: str
    photo: PictureFile
    transmission: PictureFile
    reflection: PictureFile | None = None
    rendered: bool = False


@final
@dataclass(frozen=True)
class Benchmark:
    """Cases in natural order of their names (2 before 10); the order of the folder listing does not matter.

    `expected` are the numbers of pictures that papers report. `remarks` are notes that are not failures. `refused` has
    one line for each picture that was left out, with the reason.
    """

    name: str
    title: str
    cases: tuple[Case, ...]
    expected: tuple[int, ...] = ()
    remarks: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()


@final
@dataclass(frozen=True)
class BenchmarkLayout:
    """A row of BENCHMARKS: its title ("" means the folder's name), the counts that papers report, and its reader.

    `scene` is set where the paper draws one case of each scene: it matches the part of a repacked file name that
    identifies the scene.
    """

    title: str
    expected: tuple[int, ...]
    read: Callable[[str, Path], list[Benchmark]]
    scene: str = ""


def read_benchmark(name: str, folder: Path) -> list[Benchmark]:
    """Reads a benchmark from a folder. Only file headers are decoded.

    Returns:
        One benchmark; for "sir2", one for each of its three subsets that the folder contains. An incomplete copy is
        read as far as possible: see `remarks` and `refused`.

    Raises:
        PhotoError: the name is not in BENCHMARKS, or the folder is missing, empty or has another layout.
        MissingExtra: a rendered set or an image format needs an extra that is not installed.
    """
    if name not in BENCHMARKS:
        close = difflib.get_close_matches(name.lower(), BENCHMARKS, 1)
        raise PhotoError(
            f"there is no benchmark {name!r}",
            f"brewster reads {', '.join(BENCHMARKS)}",
            f"did you mean {close[0]}?" if close else "for a folder of your own, use pairs=FOLDER",
        )
    return BENCHMARKS[name].read(name, folder)


def paper_draw(benchmark: Benchmark, seed: int = PAPER_SEED) -> tuple[Case, ...]:
    """The cases of the paper's protocol: one random case of each scene of Postcard and SolidObject, all of other sets.

    The paper's own draw is unpublished. This one takes, from the cases of a scene sorted by name, the choice of
    Random("seed/benchmark/scene"). A scene's draw therefore does not depend on other scenes.

    Raises:
        PhotoError: the names do not identify the scenes.
    """
    if benchmark.name not in BENCHMARKS or not BENCHMARKS[benchmark.name].scene:
        return benchmark.cases
    scenes: dict[str, list[Case]] = defaultdict(list)
    for case in benchmark.cases:
        scenes[case.scene].append(case)
    if any(case.scene == case.name for case in benchmark.cases):
        raise PhotoError(
            f"names such as {benchmark.cases[0].name!r} do not identify the scenes of {benchmark.title}",
            "the paper's protocol draws one picture of each scene",
            "use SIR2's original tree, or score the whole set without --paper",
        )
    rng = {scene: Random(f"{seed}/{benchmark.name}/{scene}") for scene in sorted(scenes, key=natural_key)}  # noqa: S311
    return tuple(rng[scene].choice(scenes[scene]) for scene in rng)


# --- the readers


def _read_pairs(name: str, folder: Path) -> list[Benchmark]:
    return [_from_listing(name, folder, read_folders(folder))]


def _read_split(name: str, folder: Path) -> list[Benchmark]:
    return [_from_listing(name, folder, read_folders(find_split(folder)))]


def _read_subset(name: str, folder: Path) -> list[Benchmark]:
    root = find_subsets(folder).get(name, folder)
    return [_from_listing(name, folder, read_folders(root) if find_roles(root) else read_tree(root, name))]


def _read_sir2(_: str, folder: Path) -> list[Benchmark]:
    subsets = find_subsets(folder)
    if not subsets:
        raise PhotoError(
            f"{folder} contains no subset of SIR2",
            "expected folders whose names begin with Postcard, SolidObject and Wildscene",
            "give their parent folder, or use postcard=, solidobject= or wildscene= for one subset",
        )
    first, *others = [
        benchmark for name in SIR2_TREES if name in subsets for benchmark in _read_subset(name, folder)
    ]
    missing = [f"{BENCHMARKS[name].title} is not in {folder}" for name in SIR2_TREES if name not in subsets]
    return [replace(first, remarks=(*missing, *first.remarks)), *others]


def _read_rendered(name: str, folder: Path) -> list[Benchmark]:
    benchmark_name, cases, refused = _benchmark_name(name, folder), [], []
    for key, files in _rendered_samples(folder):
        if len(files) < len(_RENDERED):
            refused.append(f"{key} is incomplete: {', '.join(_RENDERED)} are needed")
            continue
        photo, background, reflection = files
        cases.append(
            Case(benchmark_name, key, key, f"{key}/photo", photo, background, reflection, rendered=True)
        )
    return [_benchmark(name, folder, cases, FolderListing(refused=tuple(refused)))]


def _rendered_samples(folder: Path) -> list[tuple[str, list[PictureFile]]]:
    """Name and files of each sample of a rendered set; missing files are left out."""
    try:
        from brewster.rendered.store import key, read_set  # noqa: PLC0415  (needs torch, an optional dependency)

        entries = list(read_set(folder))
    except ImportError as error:
        raise MissingExtra(
            "torch is not installed", "reading a rendered set needs it", "run: pip install 'brewster[render]'"
        ) from error
    except (OSError, tarfile.TarError, ValueError) as error:
        raise _not_a_rendered_set(folder, str(error)) from error
    if not entries:
        raise _not_a_rendered_set(folder, "no samples")
    return [
        (
            key(entry.index),
            [PictureFile(entry.path, entry.spans[name]) for name in _RENDERED if name in entry.spans],
        )
        if entry.spans
        else (
            key(entry.index),
            [PictureFile(entry.path / name) for name in _RENDERED if (entry.path / name).exists()],
        )
        for entry in entries
    ]


def _not_a_rendered_set(folder: Path, reason: str) -> PhotoError:
    return PhotoError(
        f"{folder} is not a rendered set ({reason})",
        "expected 000000/, 000001/ ... or shard-000000.tar, as `brewster render` writes them",
        "give the output folder of `brewster render`",
    )


# --- from listings to cases


def _from_listing(name: str, folder: Path, found: FolderListing) -> Benchmark:
    scenes, remarks = _scenes(BENCHMARKS[name], found.groups)
    benchmark_name = _benchmark_name(name, folder)
    cases = [
        _to_case(benchmark_name, scene, group, folder)
        for scene, group in zip(scenes, found.groups, strict=True)
    ]
    return _benchmark(name, folder, cases, replace(found, remarks=(*found.remarks, *remarks)))


def _to_case(benchmark_name: str, scene: str, group: PictureGroup, root: Path) -> Case:
    return Case(
        benchmark_name,
        group.name,
        scene,
        group.photo.relative_to(root).with_suffix("").as_posix(),
        PictureFile(group.photo),
        PictureFile(group.transmission),
        PictureFile(group.reflection) if group.reflection else None,
    )


def _scenes(row: BenchmarkLayout, groups: Sequence[PictureGroup]) -> tuple[list[str], list[str]]:
    """The scene of each group, and remarks. If one name does not identify its scene, every group is its own scene."""
    if not row.scene or any(group.scene for group in groups):
        return [group.scene or group.name for group in groups], []
    matched = [match[0] for group in groups if (match := re.match(row.scene, group.name))]
    if len(matched) == len(groups) and len(set(matched)) <= _SCENES:
        return matched, []
    return [group.name for group in groups], [
        "the names do not identify the scenes, so the paper's draw is not possible"
    ]


def _benchmark(name: str, folder: Path, cases: Sequence[Case], found: FolderListing) -> Benchmark:
    row = BENCHMARKS[name]
    mismatches = {case.name: mismatch for case in cases if (mismatch := _mismatch(case))}
    valid = tuple(
        case for case in sorted(cases, key=lambda case: natural_key(case.name)) if case.name not in mismatches
    )
    title = row.title or _folder_name(folder)
    return Benchmark(
        _benchmark_name(name, folder),
        title,
        valid,
        row.expected,
        (*_count_remark(len(valid), title, row.expected), *_missing_reflections(valid), *found.remarks),
        (*found.refused, *mismatches.values()),
    )


def _count_remark(count: int, title: str, expected: Sequence[int]) -> list[str]:
    if not expected or count in expected:
        return []
    known = " or ".join(map(str, expected))
    return [f"{count} {'picture' if count == 1 else 'pictures'}, where {title} has {known}"]


def _missing_reflections(cases: Sequence[Case]) -> list[str]:
    without = [case.name for case in cases if case.reflection is None]
    if not without or len(without) == len(cases):
        return []
    return [f"no reflection ground truth for {join_names(without)}"]


def _benchmark_name(name: str, folder: Path) -> str:
    """The benchmark's identifier: a known set's name, else the folder's, made distinct from known sets and "average"."""
    if BENCHMARKS[name].title:
        return name
    safe = re.sub(r"[^A-Za-z0-9_.-]+", "-", _folder_name(folder)).strip("-.") or name
    is_taken = safe == "average" or (safe in BENCHMARKS and BENCHMARKS[safe].title)
    return f"{name}-{safe}" if is_taken else safe


def _folder_name(folder: Path) -> str:
    return Path(os.path.abspath(folder)).name  # noqa: PTH100  (do not resolve links)


def _mismatch(case: Case) -> str:
    """Why a case cannot be scored according to the headers of its files, or ""."""
    files = {"photo": case.photo, "truth": case.transmission, "reflection": case.reflection}
    sizes: dict[str, tuple[int, int]] = {}
    for role, file in files.items():
        try:
            sizes |= {role: read_size(file.read())} if file else {}
        except PhotoError as error:
            return f"{case.relative_path}: the {role} cannot be used: {error}"
    different = (
        _size_mismatch(case.relative_path, role, sizes) for role in sizes if sizes[role] != sizes["photo"]
    )
    return next(different, "")


def _size_mismatch(path: str, role: str, sizes: Mapping[str, tuple[int, int]]) -> str:
    photo, truth = sizes["photo"], sizes[role]
    across, down = truth[0] / photo[0], truth[1] / photo[1]
    sizes_text = f"{path}: photo {photo[0]}x{photo[1]}, {role} {truth[0]}x{truth[1]}"
    if abs(across / down - 1) <= 0.01 < abs(across - 1):
        times = _SCALES.get(f"{across:.2g}", f"{across:.3g} times the scale")
        return f"{sizes_text}: the {role} is at {times}"
    return (
        f"{sizes_text}: {'one of them is rotated' if truth == photo[::-1] else 'their sizes must be equal'}"
    )


# --- the table

BENCHMARKS: Final[dict[str, BenchmarkLayout]] = {
    "real20": BenchmarkLayout("Real20", (20,), _read_pairs),
    "nature20": BenchmarkLayout("Nature20", (20,), _read_pairs),
    "sir2": BenchmarkLayout("SIR2", (), _read_sir2),
    "postcard": BenchmarkLayout("SIR2 Postcard", (199,), _read_subset, r"[A-Za-z]{2}(?=[-_])"),
    "solidobject": BenchmarkLayout("SIR2 SolidObject", (200,), _read_subset, r"\d+(?=[-_].)"),
    "wildscene": BenchmarkLayout("SIR2 Wildscene", (101, 55), _read_subset),
    "openrr": BenchmarkLayout("OpenRR", (), _read_split),
    "pairs": BenchmarkLayout("", (), _read_pairs),
    "rendered": BenchmarkLayout("", (), _read_rendered),
}
"""What `read_benchmark` reads, by name. docs/evaluation.md describes the folders."""
