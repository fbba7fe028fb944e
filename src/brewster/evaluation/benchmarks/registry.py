"""Reads public benchmarks from downloaded folders. Pairs each photo with its ground truth by file
name.

The module `pairing` groups the files by name. This module creates a `Case` for each group, compares
the image sizes in the file headers, and checks the number of cases. `excluded` lists the files that
cannot be used.
"""

import difflib
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from random import Random
from typing import Final, final

from brewster.base.files import natural_key
from brewster.errors import PhotoError, counted
from brewster.evaluation.benchmarks import pairing
from brewster.evaluation.benchmarks.bursts import find_bursts
from brewster.evaluation.benchmarks.image_files import Case, ImageFile, files_of, read_samples
from brewster.evaluation.benchmarks.pairing import FolderListing, ImageGroup
from brewster.photo import read_size

_RENDERED_FILES: Final = ("photo.jpg", "background.jpg", "reflection.jpg")
_MAX_SCENES: Final = 20
"""Postcard and SolidObject have 20 scenes each. If a pattern finds more, the names do not identify
them.
"""


@final
@dataclass(frozen=True)
class Benchmark:
    """The cases of a benchmark, in natural order of their names (2 before 10). `expected_counts`
    are the numbers of images that papers report. `remarks` are notes for the user. `excluded` has a
    line with the reason for each unused file or case.
    """

    name: str
    title: str
    cases: tuple[Case, ...]
    expected_counts: tuple[int, ...] = ()
    remarks: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()


@final
@dataclass(frozen=True)
class BenchmarkLayout:
    """A row of BENCHMARKS: title ("" means the name of the folder), counts that papers report, and
    reader. `scene_pattern` is a regular expression that matches the part of a file name that
    identifies the scene. It is set only for the benchmarks from which the paper draws one case per
    scene.
    """

    title: str
    expected_counts: tuple[int, ...]
    read: Callable[[str, Path], list[Benchmark]]
    scene_pattern: str = ""


def read_benchmark(name: str, folder: Path) -> list[Benchmark]:
    """Reads a benchmark from a folder; decodes only the file headers. "sir2" gives one benchmark
    for each of its subsets in the folder. `remarks` and `excluded` list missing files. Raises
    PhotoError if the name is not in BENCHMARKS, or the folder is missing, empty or of another
    layout, and MissingExtra if a reader is not installed.
    """
    if name not in BENCHMARKS:
        close = difflib.get_close_matches(name.lower(), BENCHMARKS, 1)
        raise PhotoError(
            f"there is no benchmark {name!r}",
            f"expected one of {', '.join(BENCHMARKS)}",
            f"did you mean {close[0]}?" if close else "use pairs=FOLDER for a folder of your own",
        )
    return BENCHMARKS[name].read(name, folder)


def _read_pairs(name: str, folder: Path) -> list[Benchmark]:
    return [_from_listing(name, folder, pairing.read_folders(folder))]


def _read_sets(name: str, folder: Path) -> list[Benchmark]:
    folders = [] if "photo" in pairing.find_roles(folder) else pairing.list_folder(folder)[0]
    sets = [
        path for path in folders if {"photo", "transmission"} <= pairing.find_roles(path).keys()
    ]
    return [part for path in sets or [folder] for part in _read_pairs(name, path)]


def _read_split(name: str, folder: Path) -> list[Benchmark]:
    complete = [
        roles
        for name, roles in pairing.find_numbered_splits(folder).items()
        if "transmission" in roles and not name.startswith("train")
    ]
    found = (folder, complete[0]) if len(complete) == 1 else (pairing.find_split(folder),)
    return [_from_listing(name, folder, pairing.read_folders(*found))]


def _read_subset(name: str, folder: Path) -> list[Benchmark]:
    root = pairing.find_subsets(folder).get(name, folder)
    is_repacked = pairing.find_roles(root)
    listing = pairing.read_folders(root) if is_repacked else pairing.read_tree(root, name)
    return [_from_listing(name, folder, listing)]


def _read_sir2(_: str, folder: Path) -> list[Benchmark]:
    subsets = pairing.find_subsets(folder)
    if not subsets:
        raise PhotoError(
            f"{folder} contains no subset of SIR2",
            "expected folders whose names begin with Postcard, SolidObject and Wildscene",
            "give the path of their parent folder, or use postcard=, solidobject= or wildscene= "
            "for one subset",
        )
    parts = []
    missing = []
    for name in pairing.SIR2_TREES:
        if name in subsets:
            parts += _read_subset(name, folder)
        else:
            missing.append(f"{BENCHMARKS[name].title} is not in {folder}")
    return [replace(parts[0], remarks=(*missing, *parts[0].remarks)), *parts[1:]]


def _read_rendered(name: str, folder: Path) -> list[Benchmark]:
    benchmark_name = _benchmark_name(name, folder)
    cases = []
    excluded = []
    for sample in read_samples(folder):
        key = sample.name
        files = files_of(sample, _RENDERED_FILES)
        if len(files) == len(_RENDERED_FILES):
            photo, background, reflection = files
            path = f"{key}/photo"
            cases.append(
                Case(benchmark_name, key, key, path, photo, background, reflection, rendered=True)
            )
        else:
            excluded.append(f"{key} is incomplete: expected {', '.join(_RENDERED_FILES)}")
    return [_make_benchmark(name, folder, cases, FolderListing(folder, excluded=excluded))]


def _read_bursts(name: str, folder: Path) -> list[Benchmark]:
    return [_make_benchmark(name, folder, *find_bursts(folder, _benchmark_name(name, folder)))]


def _from_listing(name: str, folder: Path, listing: FolderListing) -> Benchmark:
    scenes, remarks = _find_scenes(BENCHMARKS[name], listing.groups)
    listing.remarks += remarks
    benchmark_name = _benchmark_name(name, folder)
    cases = [
        Case(
            benchmark_name,
            group.name,
            scene,
            group.photo.relative_to(folder).with_suffix("").as_posix(),
            ImageFile(group.photo),
            ImageFile(group.transmission),
            ImageFile(group.reflection) if group.reflection else None,
        )
        for scene, group in zip(scenes, listing.groups, strict=True)
    ]
    return _make_benchmark(name, folder, cases, listing)


def _find_scenes(
    layout: BenchmarkLayout, groups: Sequence[ImageGroup]
) -> tuple[list[str], list[str]]:
    """Returns the scene of each group, and remarks. If one scene is unknown, the name of each group
    is its scene.
    """
    if not layout.scene_pattern or any(group.scene for group in groups):
        return [group.scene or group.name for group in groups], []
    matched = [
        match[0] for group in groups if (match := re.match(layout.scene_pattern, group.name))
    ]
    if len(matched) == len(groups) and len(set(matched)) <= _MAX_SCENES:
        return matched, []
    note = (
        "the file names do not identify the scenes, so the subset of the paper (one case of each "
        "scene) cannot be drawn"
    )
    return [group.name for group in groups], [note]


def _make_benchmark(
    name: str, folder: Path, cases: Sequence[Case], listing: FolderListing
) -> Benchmark:
    """Returns the benchmark without the cases whose images cannot be read or differ in size."""
    layout = BENCHMARKS[name]
    expected = BENCHMARKS[name].expected_counts
    unusable = {case.name: reason for case in cases if (reason := _unusable_reason(case))}
    ordered = sorted(cases, key=lambda case: natural_key(case.name))
    valid = [case for case in ordered if case.name not in unusable]
    remarks = []
    if expected and len(valid) not in expected:
        remarks.append(
            f"found {counted(len(valid), 'image')}, expected {' or '.join(map(str, expected))}"
        )
    missing = [case.name for case in valid if case.reflection is None]
    if 0 < len(missing) < len(valid):
        remarks.append(
            f"there is no ground truth of the reflection for {pairing.join_names(missing)}"
        )
    return Benchmark(
        _benchmark_name(name, folder),
        layout.title or folder_name(folder),
        tuple(valid),
        expected,
        (*remarks, *listing.remarks),
        (*listing.excluded, *unusable.values()),
    )


def _benchmark_name(name: str, folder: Path) -> str:
    """Returns the name of the benchmark in results: `name` if its row has a title, else the name of
    the folder. If the folder has the name "average" or that of a benchmark with a title, the result
    is the unique "{name}-{folder}".
    """
    if BENCHMARKS[name].title:
        return name
    safe = safe_name(folder_name(folder)) or name
    is_taken = safe == "average" or (safe in BENCHMARKS and BENCHMARKS[safe].title)
    return f"{name}-{safe}" if is_taken else safe


def safe_name(text: str) -> str:
    """Returns the text with "-" in place of each sequence of other characters than letters, digits,
    ".", "_", "-".
    """
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("-.")


def folder_name(folder: Path) -> str:
    """Returns the name of a folder, which may be given as ".". Links are not resolved."""
    return Path(os.path.abspath(folder)).name  # noqa: PTH100  (do not resolve links)


def _unusable_reason(case: Case) -> str:
    """Compares the sizes in the file headers. Returns why the case cannot be scored, or "" if it
    can.
    """
    files = {"photo": case.photo, "ground truth": case.ground_truth, "reflection": case.reflection}
    files |= {f"frame {number}": file for number, file in enumerate(case.frames, 1)}
    sizes: dict[str, tuple[int, int]] = {}
    for role, file in files.items():
        try:
            sizes |= {role: read_size(file.read())} if file else {}
        except PhotoError as error:
            return f"{case.relative_path}: the {role} cannot be read: {error}"
    for role, (width, height) in sizes.items():
        photo = sizes["photo"]
        if (width, height) != photo:
            scale_x = width / photo[0]
            scale_y = height / photo[1]
            if abs(scale_x / scale_y - 1) <= 0.01 < abs(scale_x - 1):
                why = f"the {role} is resized by the factor {scale_x:.3g}"
            else:
                why = (
                    "one of them is rotated" if photo == (height, width) else "expected equal sizes"
                )
            return (
                f"{case.relative_path}: the photo is {photo[0]}x{photo[1]}, the {role} is "
                f"{width}x{height}: {why}"
            )
    return ""


BENCHMARKS: Final[dict[str, BenchmarkLayout]] = {
    "real20": BenchmarkLayout("Real20", (20,), _read_pairs),
    "nature20": BenchmarkLayout("Nature20", (20,), _read_pairs),
    "sir2": BenchmarkLayout("SIR2", (), _read_sir2),
    "postcard": BenchmarkLayout("SIR2 Postcard", (199,), _read_subset, r"[A-Za-z]{2}(?=[-_])"),
    "solidobject": BenchmarkLayout("SIR2 SolidObject", (200,), _read_subset, r"\d+(?=[-_].)"),
    "wildscene": BenchmarkLayout("SIR2 Wildscene", (101, 55), _read_subset),
    "openrr": BenchmarkLayout("OpenRR", (), _read_split),
    "pairs": BenchmarkLayout("", (), _read_sets),
    "rendered": BenchmarkLayout("", (), _read_rendered),
    "bursts": BenchmarkLayout("", (), _read_bursts),
}
"""The layouts of the benchmarks that `read_benchmark` supports, by name. docs/evaluation.md
describes the folders.
"""


# --- subsets (random like that of the paper, or small for a first look), and unique names


PAPER_SEED: Final = 181
"""The seed of `paper_subset`. The value is arbitrary; 181 is also the number of images in the
paper's average.
"""


def paper_subset(benchmark: Benchmark, seed: int = PAPER_SEED) -> tuple[Case, ...]:
    """Draws one case of each scene, as the paper does, which does not say which ones. Other
    benchmarks than Postcard and SolidObject keep all cases. The choice, from the cases in natural
    order of their names, does not depend on the other scenes. Raises PhotoError if the file names
    do not identify the scenes.
    """
    if benchmark.name not in BENCHMARKS or not BENCHMARKS[benchmark.name].scene_pattern:
        return benchmark.cases
    if any(case.scene == case.name for case in benchmark.cases):
        raise PhotoError(
            f"names such as {benchmark.cases[0].name!r} do not identify the scenes of "
            f"{benchmark.title}",
            "expected file names that begin with the scene, because the paper's protocol draws "
            "one case of each scene",
            "use the original folders of SIR2, or another --protocol",
        )
    scenes: dict[str, list[Case]] = defaultdict(list)
    for case in benchmark.cases:
        scenes[case.scene].append(case)
    return tuple(
        Random(f"{seed}/{benchmark.name}/{scene}").choice(scenes[scene])  # noqa: S311
        for scene in sorted(scenes, key=natural_key)
    )


def spread(benchmark: Benchmark, limit: int) -> Benchmark:
    """Returns the benchmark with at most `limit` cases, evenly spread over the order of their
    names, and a remark.
    """
    count = len(benchmark.cases)
    if count <= limit:
        return benchmark
    cases = tuple(benchmark.cases[index * count // limit] for index in range(limit))
    remark = f"{limit} of {count} images {'is' if limit == 1 else 'are'} scored (--limit)"
    return replace(benchmark, cases=cases, remarks=(*benchmark.remarks, remark))


def named(benchmarks: Sequence[Benchmark], patterns: Sequence[str]) -> list[Benchmark]:
    """Returns the benchmarks with only the cases that have one of these names: "case" or
    "benchmark/case", where * stands for any text. Benchmarks without such a case are left out.
    Raises PhotoError if no case has one of the names.
    """
    names = {
        (benchmark.name, case.name): (case.name, f"{benchmark.name}/{case.name}")
        for benchmark in benchmarks
        for case in benchmark.cases
    }
    unknown = [
        pattern
        for pattern in patterns
        if not any(fnmatchcase(name, pattern) for pair in names.values() for name in pair)
    ]
    if unknown:
        example = "/".join(next(iter(names), ("real20", "12")))
        raise PhotoError(
            f"no image has the name {', '.join(unknown)}",
            f"expected names such as {example}, or a part of a name and *",
            "print all names with --dry-run",
        )
    found = []
    for benchmark in benchmarks:
        cases = tuple(
            case
            for case in benchmark.cases
            if any(
                fnmatchcase(name, pattern)
                for name in names[benchmark.name, case.name]
                for pattern in patterns
            )
        )
        count = len(benchmark.cases)
        remark = (
            f"{len(cases)} of {count} images {'is' if len(cases) == 1 else 'are'} scored (--only)"
        )
        if cases:
            remarks = benchmark.remarks if len(cases) == count else (*benchmark.remarks, remark)
            found.append(replace(benchmark, cases=cases, remarks=remarks))
    return found


def with_unique_names(benchmarks: Sequence[tuple[Benchmark, Path]]) -> list[Benchmark]:
    """Adds names of parent folders to names of (benchmark, folder) that occur twice: the folders
    a/test and b/test become a-test and b-test. As many are added as are needed: x/a/test becomes
    x-a-test. Only equal folders keep equal names.
    """
    names = [benchmark.name for benchmark, _ in benchmarks]
    # the names of all folders above each folder; links are not resolved
    above = [Path(os.path.abspath(folder)).parts[1:-1] for _, folder in benchmarks]  # noqa: PTH100
    parents = [[name for part in parts if (name := safe_name(part))] for parts in above]
    unique = list(names)
    for name, count in Counter(names).items():
        group = [i for i in range(len(names)) if names[i] == name]
        depth = 0
        while len({unique[i] for i in group}) < count and depth < max(
            len(parents[i]) for i in group
        ):
            depth += 1
            for i in group:
                unique[i] = "-".join([*parents[i][-depth:], name])
    return [
        benchmark if name == benchmark.name else _renamed(benchmark, name)
        for (benchmark, _), name in zip(benchmarks, unique, strict=True)
    ]


def _renamed(benchmark: Benchmark, name: str) -> Benchmark:
    cases = tuple(replace(case, benchmark=name) for case in benchmark.cases)
    return replace(benchmark, name=name, title=f"{benchmark.title} ({name})", cases=cases)
