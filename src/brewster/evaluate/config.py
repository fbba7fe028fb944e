"""The settings of an evaluation. Every setting that changes a number is printed in every report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

from brewster.benchmarks.registry import PAPER_SEED
from brewster.errors import BrewsterError
from brewster.evaluate.statistics import RESAMPLES
from brewster.metrics import DEFAULT_THRESHOLD, IDENTICAL_DB, METRICS, Metric, find_metric
from brewster.options import Quality

DEFAULT_METRICS: Final = tuple(name for name in METRICS if name != "ssim_gaussian")


@final
@dataclass(frozen=True)
class EvaluationConfig:
    """The settings of an evaluation run."""

    metrics: tuple[str, ...] = DEFAULT_METRICS
    size: int | None = None
    """The shorter side in px to which larger pictures are downscaled first; None keeps the original size."""
    quality: Quality = "standard"
    thresholds: tuple[float, ...] = (DEFAULT_THRESHOLD,)
    """Thresholds of the reflection region, between 0 and 1. Each one gives its own columns."""
    paper: bool = False
    """Whether to report the paper's subset too (one picture of each scene), and to average over it."""

    def __post_init__(self) -> None:
        """Raises BrewsterError for unknown metrics and invalid values."""
        for name in self.metrics:
            find_metric(name)
        if not self.metrics or len(set(self.metrics)) < len(self.metrics):
            raise BrewsterError(
                f"the metrics are {', '.join(self.metrics) or 'none'}",
                "expected each metric once",
                f"choose from {', '.join(METRICS)}",
            )
        columns = {f"{threshold:g}" for threshold in self.thresholds}
        is_possible = all(0 < threshold < 1 for threshold in self.thresholds)
        if not is_possible or not 0 < len(self.thresholds) == len(columns):
            raise BrewsterError(
                f"the region's thresholds are {self.thresholds}",
                "expected numbers between 0 and 1 that differ in their first six digits",
                "choose other numbers",
            )
        if self.size is not None and self.size < 1:
            raise BrewsterError(
                f"the size is {self.size} px",
                "expected a shorter side of 1 px or more",
                "choose a larger number",
            )

    def columns(self) -> dict[str, Metric]:
        """column -> metric. With several thresholds, a metric of the region has one column per threshold."""
        columns = {}
        for name in self.metrics:
            metric = METRICS[name]
            if metric.where == "picture" or len(self.thresholds) == 1:
                columns[name] = metric
                continue
            for threshold in self.thresholds:
                title = f"{metric.title} > {threshold:g}"
                columns[f"{name}@{threshold:g}"] = replace(metric, title=title)
        return columns

    def threshold(self, column: str) -> float:
        """The threshold of the reflection region that a column uses."""
        _, _, stated = column.partition("@")
        return next(t for t in self.thresholds if f"{t:g}" == stated) if stated else self.thresholds[0]

    def choices(self) -> list[str]:
        """Every setting as a sentence."""
        size = (
            "Pictures are compared at the size of the ground truth; nothing is resized."
            if self.size is None
            else f"Pictures with a shorter side of more than {self.size} px are downscaled to it, photo and ground truth alike, "
            "by area means in linear light, before any method runs. Smaller pictures keep their size."
        )
        region = _REGION.format(" or ".join(f"{threshold:g}" for threshold in self.thresholds))
        quality = f'Models run with the same Separator as for users, at quality "{self.quality}".'
        return [
            size,
            _VALUES,
            _PAIRS,
            _NOTHING,
            quality,
            _IDENTICAL,
            region,
            _INTERVALS,
            *([_DRAW] if self.paper else []),
        ]


_VALUES: Final = (
    "Metrics are computed on 8-bit sRGB values with three channels. Grey is repeated, alpha is dropped, embedded profiles "
    "are converted. No border is cropped unless the metric says so."
)
_PAIRS: Final = "Pictures are paired by name. A prediction of another size than the ground truth is a failure; it is not resized."
_NOTHING: Final = '"input (unprocessed)" is the photo itself as transmission, and black as reflection.'
_IDENTICAL: Final = f"The PSNR of identical pictures, which is infinite, counts as {IDENTICAL_DB:g} dB."
_REGION: Final = (
    "The reflection region is where photo and ground truth differ by more than {} of full scale (the largest difference of "
    "the channels, averaged over 7x7 px). Pictures without such a region have no score there."
)
_INTERVALS: Final = (
    f"Intervals are 95 %, from {RESAMPLES:,} bootstrap resamples of whole scenes within each benchmark. Differences "
    "are paired by picture. The mean of a method is over the pictures on which it did not fail; their number is printed."
)
_DRAW: Final = (
    "The paper draws one picture of each scene of Postcard and SolidObject; its draw is unpublished. Ours uses the seed "
    f"{PAPER_SEED} and is listed in results.json. The average is over the paper's five sets, with the drawn pictures."
)
