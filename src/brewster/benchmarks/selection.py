"""Draws a random subset like the paper's, whose cases are unknown, or a small one for a first look. Gives the
benchmarks of a run unique names."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Final

from brewster.benchmarks.image_files import Case
from brewster.benchmarks.registry import BENCHMARKS, Benchmark, safe_name
from brewster.errors import PhotoError
from brewster.files import natural_key

PAPER_SEED: Final = 181
"""The seed of `paper_subset`. The value is arbitrary; 181 is also the number of images in the paper's average."""


def paper_subset(benchmark: Benchmark, seed: int = PAPER_SEED) -> tuple[Case, ...]:
    """Draws one case of each scene, as the paper does, which does not say which ones. Other benchmarks than Postcard
    and SolidObject keep all cases. The choice, from the cases in natural order of their names, does not depend on the
    other scenes. Raises PhotoError if the file names do not identify the scenes."""
    if benchmark.name not in BENCHMARKS or not BENCHMARKS[benchmark.name].scene_pattern:
        return benchmark.cases
    if any(case.scene == case.name for case in benchmark.cases):
        raise PhotoError(
            f"names such as {benchmark.cases[0].name!r} do not identify the scenes of {benchmark.title}",
            "expected file names that begin with the scene, because the paper's protocol draws one case of each scene",
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
    """Returns the benchmark with at most `limit` cases, evenly spread over the order of their names, and a remark."""
    count = len(benchmark.cases)
    if count <= limit:
        return benchmark
    cases = tuple(benchmark.cases[index * count // limit] for index in range(limit))
    remark = f"{limit} of {count} images {'is' if limit == 1 else 'are'} scored (--limit)"
    return replace(benchmark, cases=cases, remarks=(*benchmark.remarks, remark))


def with_unique_names(benchmarks: Sequence[tuple[Benchmark, Path]]) -> list[Benchmark]:
    """Adds names of parent folders to names of (benchmark, folder) that occur twice: the folders a/test and b/test
    become a-test and b-test. As many parent folders are added as are needed: x/a/test and y/a/test become x-a-test and
    y-a-test. Only equal folders keep equal names."""
    names = [benchmark.name for benchmark, _ in benchmarks]
    # the names of all folders above each folder; links are not resolved
    above = [Path(os.path.abspath(folder)).parts[1:-1] for _, folder in benchmarks]  # noqa: PTH100
    parents = [[name for part in parts if (name := safe_name(part))] for parts in above]
    unique = list(names)
    for name, count in Counter(names).items():
        group = [i for i in range(len(names)) if names[i] == name]
        depth = 0
        while len({unique[i] for i in group}) < count and depth < max(len(parents[i]) for i in group):
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
