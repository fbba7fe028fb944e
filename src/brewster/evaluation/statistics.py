"""Means with bootstrap confidence intervals, and paired differences between methods.

Images of one scene, such as ten shots of a postcard, are not independent. So the bootstrap
resamples whole scenes.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.base.bootstrap import cluster_draws

if TYPE_CHECKING:
    from jaxtyping import Float64

SEED: Final = 20_260_725
_PERCENTILES: Final = (2.5, 97.5)


@final
@dataclass(frozen=True)
class Estimate:
    """A mean of `count` values and its 95 % interval. `low` and `high` are None without two scenes
    in a benchmark.
    """

    mean: float
    low: float | None
    high: float | None
    count: int


@final
@dataclass(frozen=True, eq=False)
class Stratum:
    """The scores of a benchmark: `values` (n, s) for n images and s series, and the scene of each
    image. A missing score is NaN. `name` seeds the bootstrap, so that the intervals of a benchmark
    do not depend on the other benchmarks of the run.
    """

    name: str
    scenes: Sequence[str]
    values: Float64[NDArray[np.float64], "n s"]


def estimate(strata: Sequence[Stratum]) -> list[Estimate | None]:
    """Computes the mean of each series over all images of all strata, and its 95 % interval.
    Stratified cluster bootstrap with percentile intervals (Efron and Tibshirani 1993, chapter 13),
    10,000 resamples and a fixed seed. For a stratum of k scenes, each resample draws k scenes with
    replacement, and all images of these scenes. A series without values has no estimate.
    """
    resampled = [_resample(stratum) for stratum in strata]
    sums, counts = (np.sum([part[i] for part in resampled], axis=0) for i in range(2))
    values = np.concatenate([stratum.values for stratum in strata])
    has_interval = [
        any(len({*np.array(part.scenes)[np.isfinite(part.values[:, i])]}) > 1 for part in strata)
        for i in range(values.shape[1])
    ]
    return [
        _estimate(values[:, i], sums[:, i], counts[:, i], has_interval=has_interval[i])
        for i in range(values.shape[1])
    ]


def _resample(stratum: Stratum) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the sums and the counts of the values in each resample, (10,000, s) each."""
    index_of = {scene: i for i, scene in enumerate(sorted(set(stratum.scenes)))}
    scene_index = np.array([index_of[scene] for scene in stratum.scenes], int)
    sums, counts = (np.zeros((len(index_of), stratum.values.shape[1])) for _ in range(2))
    np.add.at(sums, scene_index, np.nan_to_num(stratum.values))
    np.add.at(counts, scene_index, np.isfinite(stratum.values))
    draws = cluster_draws(len(index_of), [SEED, zlib.crc32(stratum.name.encode())])
    return draws @ sums, draws @ counts


def _estimate(
    values: NDArray[np.float64],
    sums: NDArray[np.float64],
    counts: NDArray[np.float64],
    *,
    has_interval: bool,
) -> Estimate | None:
    valid = values[np.isfinite(values)]
    if not valid.size:
        return None
    mean = math.fsum(valid) / valid.size
    if not has_interval:
        return Estimate(mean, None, None, valid.size)
    low, high = np.percentile(sums[counts > 0] / counts[counts > 0], _PERCENTILES)
    return Estimate(mean, float(low), float(high), valid.size)


@final
@dataclass(frozen=True)
class Difference:
    """The mean of score(method) - score(reference) in one metric, over the images with both scores,
    with its interval. `improved_count` is the number of images on which `method` has a better score
    than `reference`.
    """

    method: str
    reference: str
    metric: str
    estimate: Estimate
    improved_count: int


def differences(
    strata: Sequence[Stratum], series: Sequence[tuple[str, str]], directions: Mapping[str, bool]
) -> list[Difference]:
    """Compares each method with all methods before it, in every metric, paired by image, if an
    image has both scores.

    `series` has (method, metric) of each column of the values of `strata`; `directions`: metric ->
    is higher better?
    """
    column_of = {name: i for i, name in enumerate(series)}
    methods = list(dict.fromkeys(method for method, _ in series))
    comparisons = [
        (method, reference, metric)
        for i, method in enumerate(methods)
        for reference in methods[:i]
        for metric in directions
    ]
    if not comparisons:
        return []
    columns, other_columns = ([column_of[row[i], row[2]] for row in comparisons] for i in range(2))
    paired = [
        replace(stratum, values=stratum.values[:, columns] - stratum.values[:, other_columns])
        for stratum in strata
    ]
    signs = [1 if directions[metric] else -1 for *_, metric in comparisons]
    better = sum((stratum.values * signs > 0).sum(axis=0) for stratum in paired)
    return [
        Difference(*row, estimated, int(count))
        for row, estimated, count in zip(comparisons, estimate(paired), better, strict=True)
        if estimated
    ]
