"""The field's benchmarks from a user's own copies: every photo with its truth, paired by name.

for benchmark in read_benchmark("sir2", Path("SIR2")):
    print(benchmark.title, len(benchmark.cases), *benchmark.remarks, *benchmark.refused)

How folders are laid out and which pictures belong together is told by `layouts`. Here they get the names that reports
print, headers are compared, counts are checked, and the paper's pictures are drawn. Nothing is guessed: what does not
fit is named in `refused`.
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
"""Seeds `paper_draw`; as good as any other number, it is how many pictures the paper averages over."""

_RENDERED: Final = ("photo.jpg", "background.jpg", "reflection.jpg")
_SCENES: Final = 20
_SCALES: Final = {"0.25": "a quarter of the scale", "0.5": "half the scale", "2": "twice the scale"}


@final
@dataclass(frozen=True)
class PictureFile:
    """A picture where it lies: a file of its own, or a span (offset, length) of a shard, in bytes."""

    path: Path
    span: tuple[int, int] | None = None

    def read(self) -> bytes:
        """Its bytes, as stored.

        Raises:
            UnreadablePhoto: the file is not there, may not be read, or ends before the span does.
        """
        try:
            return self._read()
        except OSError as error:
            raise UnreadablePhoto(
                f"{self} cannot be read ({error.strerror or error})",
                "a benchmark's pictures stay where they were found",
                "mend that and run again",
            ) from error

    def __str__(self) -> str:
        return f"{self.path}" if self.span is None else f"{self.path} from byte {self.span[0]}"

    def _read(self) -> bytes:
        offset, length = self.span or (0, -1)
        with self.path.open("rb") as file:
            file.seek(offset)
            data = file.read(length)
        if len(data) < length:
            raise OSError(f"{len(data)} of {length} bytes are there")
        return data


@final
@dataclass(frozen=True)
class Case:
    """A picture to separate, and what is true of it.

    `name` is unique within the benchmark: what a folder of predictions calls it, and what reports print. Cases of one
    `scene` show the same things, so they are not independent; it is the name where nothing is known. `place` is the
    photo's path below the folder given, without suffix, with slashes. With `rendered`, the truth is known exactly:
    transmission is the background without the glass, reflection the light that the glass adds.
    """

    benchmark: str
    name: str
    scene: str
    place: str
    photo: PictureFile
    transmission: PictureFile
    reflection: PictureFile | None = None
    rendered: bool = False


@final
@dataclass(frozen=True)
class Benchmark:
    """Cases in natural order of their names (2 before 10), the same however the folder is listed.

    `expected` are the counts that papers report, `remarks` what should be said aloud and is no failure, `refused` what
    was left out, one line each, with the reason.
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
    """A row of BENCHMARKS: its title ("" is the folder's own name), the counts that papers report, and its reader.

    Where the paper draws one case of each scene, `scene` matches the part of a repacked name that tells it.
    """

    title: str
    expected: tuple[int, ...]
    read: Callable[[str, Path], list[Benchmark]]
    scene: str = ""


def read_benchmark(name: str, folder: Path) -> list[Benchmark]:
    """The benchmark in a folder; "sir2" gives those of its three sets that are there, every other name one.

    Only headers are looked at. A copy that is not whole is read as far as it goes: see `remarks` and `refused`.

    Raises:
        PhotoError: the name is not in BENCHMARKS, or the folder is missing, empty or of another layout.
        MissingExtra: a rendered set or a kind of picture needs an extra that is not installed.
    """
    if name not in BENCHMARKS:
        close = difflib.get_close_matches(name.lower(), BENCHMARKS, 1)
        raise PhotoError(
            f"there is no benchmark {name!r}",
            f"brewster reads {', '.join(BENCHMARKS)}",
            f"did you mean {close[0]}?" if close else "for a folder of your own, say pairs=FOLDER",
        )
    return BENCHMARKS[name].read(name, folder)


def paper_draw(benchmark: Benchmark, seed: int = PAPER_SEED) -> tuple[Case, ...]:
    """The cases of the paper's protocol: one for each scene of Postcard and SolidObject, and all of other sets.

    The paper's own draw is unpublished, so this is ours: of a scene's cases, sorted by name, the one that
    Random("seed/benchmark/scene") chooses, with seed 181 (PAPER_SEED). It depends on no other scene.

    Raises:
        PhotoError: scenes cannot be told from the names.
    """
    if benchmark.name not in BENCHMARKS or not BENCHMARKS[benchmark.name].scene:
        return benchmark.cases
    scenes: dict[str, list[Case]] = defaultdict(list)
    for case in benchmark.cases:
        scenes[case.scene].append(case)
    if any(case.scene == case.name for case in benchmark.cases):
        raise PhotoError(
            f"the scenes of {benchmark.title} cannot be told from names such as {benchmark.cases[0].name!r}",
            "the paper's protocol draws one picture of each scene",
            "point at SIR2's original tree, or score the whole set",
        )
    rng = {scene: Random(f"{seed}/{benchmark.name}/{scene}") for scene in sorted(scenes, key=natural_key)}  # noqa: S311
    return tuple(rng[scene].choice(scenes[scene]) for scene in rng)


# --- the readers


def _read_pairs(name: str, folder: Path) -> list[Benchmark]:
    return [_from_listing(name, folder, read_folders(folder))]


def _read_split(name: str, folder: Path) -> list[Benchmark]:
    return [_from_listing(name, folder, read_folders(find_split(folder)))]


def _read_subset(name: str, folder: Path) -> list[Benchmark]:
    place = find_subsets(folder).get(name, folder)
    return [_from_listing(name, folder, read_folders(place) if find_roles(place) else read_tree(place, name))]


def _read_sir2(_: str, folder: Path) -> list[Benchmark]:
    subsets = find_subsets(folder)
    if not subsets:
        raise PhotoError(
            f"{folder} holds no set of SIR2",
            "folders whose names begin with Postcard, SolidObject and Wildscene",
            "name the folder above them, or say postcard=, solidobject= or wildscene= for one set alone",
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
            refused.append(f"{key} is not whole: {', '.join(_RENDERED)} are needed")
            continue
        photo, background, reflection = files
        cases.append(
            Case(benchmark_name, key, key, f"{key}/photo", photo, background, reflection, rendered=True)
        )
    return [_benchmark(name, folder, cases, FolderListing(refused=tuple(refused)))]


def _rendered_samples(folder: Path) -> list[tuple[str, list[PictureFile]]]:
    """The names of a rendered set's samples, and those of the _RENDERED files that are there."""
    try:
        from brewster.rendered.store import key, read_set  # noqa: PLC0415  (torch: only who has rendered has it)

        entries = list(read_set(folder))
    except ImportError as error:
        raise MissingExtra(
            "torch is not installed", "sets are rendered with it", "run: pip install 'brewster[render]'"
        ) from error
    except (OSError, tarfile.TarError, ValueError) as error:
        raise _not_a_rendered_set(folder, str(error)) from error
    if not entries:
        raise _not_a_rendered_set(folder, "no samples")
    return [
        (
            key(entry.index),
            [PictureFile(entry.place, entry.spans[name]) for name in _RENDERED if name in entry.spans],
        )
        if entry.spans
        else (
            key(entry.index),
            [PictureFile(entry.place / name) for name in _RENDERED if (entry.place / name).exists()],
        )
        for entry in entries
    ]


def _not_a_rendered_set(folder: Path, reason: str) -> PhotoError:
    return PhotoError(
        f"{folder} is no rendered set ({reason})",
        "000000/ and so on, or shard-000000.tar, as `brewster render` writes them",
        "name that folder",
    )


# --- from what was found to cases


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
    """A scene for each trio, and what is to be said about that: all are told by the names, or none is taken."""
    if not row.scene or any(group.scene for group in groups):
        return [group.scene or group.name for group in groups], []
    matched = [match[0] for group in groups if (match := re.match(row.scene, group.name))]
    if len(matched) == len(groups) and len(set(matched)) <= _SCENES:
        return matched, []
    return [group.name for group in groups], [
        "scenes cannot be told from the names, so the paper's draw is impossible with this form"
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
    return [f"without a reflection to compare with: {join_names(without)}"]


def _benchmark_name(name: str, folder: Path) -> str:
    """A known set's own name; else the folder's, which never passes for a known set or the average of all."""
    if BENCHMARKS[name].title:
        return name
    safe = re.sub(r"[^A-Za-z0-9_.-]+", "-", _folder_name(folder)).strip("-.") or name
    is_taken = safe == "average" or (safe in BENCHMARKS and BENCHMARKS[safe].title)
    return f"{name}-{safe}" if is_taken else safe


def _folder_name(folder: Path) -> str:
    return Path(os.path.abspath(folder)).name  # noqa: PTH100  (links keep their names)


def _mismatch(case: Case) -> str:
    """Why a case cannot be scored, by the headers of its files, or ""."""
    files = {"photo": case.photo, "truth": case.transmission, "reflection": case.reflection}
    sizes: dict[str, tuple[int, int]] = {}
    for role, file in files.items():
        try:
            sizes |= {role: read_size(file.read())} if file else {}
        except PhotoError as error:
            return f"{case.place}: the {role} cannot be used: {error}"
    return next(
        (_size_mismatch(case.place, role, sizes) for role in sizes if sizes[role] != sizes["photo"]), ""
    )


def _size_mismatch(place: str, role: str, sizes: Mapping[str, tuple[int, int]]) -> str:
    photo, truth = sizes["photo"], sizes[role]
    across, down = truth[0] / photo[0], truth[1] / photo[1]
    sizes_text = f"{place}: photo {photo[0]}x{photo[1]}, {role} {truth[0]}x{truth[1]}"
    if abs(across / down - 1) <= 0.01 < abs(across - 1):
        times = _SCALES.get(f"{across:.2g}", f"{across:.3g} times the scale")
        return f"{sizes_text}: the {role} is at {times}"
    return f"{sizes_text}: {'one of them is turned' if truth == photo[::-1] else 'they must be equal'}"


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
