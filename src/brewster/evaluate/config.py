"""How it is measured: every choice that changes a number, stated once and printed in every report."""

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
    """The choices of a run."""

    metrics: tuple[str, ...] = DEFAULT_METRICS
    size: int | None = None
    """The shorter side in px to which larger pictures are reduced first; None leaves all as they are."""
    quality: Quality = "standard"
    thresholds: tuple[float, ...] = (DEFAULT_THRESHOLD,)
    """Of the reflection region; each gives a column of its own."""
    paper: bool = False
    """Whether the paper's draw of one picture a scene is reported too, and makes the average."""

    def __post_init__(self) -> None:
        """Refuses unknown metrics and impossible values."""
        for name in self.metrics:
            find_metric(name)
        if not self.metrics or len(set(self.metrics)) < len(self.metrics):
            raise BrewsterError(
                f"the metrics are {', '.join(self.metrics) or 'none'}",
                "each once",
                f"choose from {', '.join(METRICS)}",
            )
        columns = {f"{threshold:g}" for threshold in self.thresholds}
        is_possible = all(0 < threshold < 1 for threshold in self.thresholds)
        if not is_possible or not 0 < len(self.thresholds) == len(columns):
            raise BrewsterError(
                f"the region's thresholds are {self.thresholds}",
                "numbers between 0 and 1 that differ in their first six digits",
                "choose such ones",
            )
        if self.size is not None and self.size < 1:
            raise BrewsterError(f"the size is {self.size} px", "a shorter side of 1 px or more", "choose one")

    def columns(self) -> dict[str, Metric]:
        """The metrics by the name of their column: with several thresholds, a region's metric has a column for each."""
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
        """The threshold of the region that a column is measured in."""
        _, _, stated = column.partition("@")
        return next(t for t in self.thresholds if f"{t:g}" == stated) if stated else self.thresholds[0]

    def choices(self) -> list[str]:
        """Every choice as a sentence."""
        size = (
            "Pictures are compared at the ground truth's own size; nothing is resized."
            if self.size is None
            else f"Pictures whose shorter side is longer than {self.size} px are reduced to it, photo and truth alike, "
            "by area means in linear light, before any method sees them; smaller ones are left as they are."
        )
        region = _REGION.format(" or ".join(f"{threshold:g}" for threshold in self.thresholds))
        quality = f'Models run through the Separator that users use, at quality "{self.quality}".'
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
    "Metrics see 8-bit sRGB values, three channels; grey is repeated, alpha is dropped, embedded profiles are "
    "converted, and no border is cut off unless the metric says so."
)
_PAIRS: Final = (
    "Pictures are paired by name. A prediction of another size than the truth is a failure, never resized."
)
_NOTHING: Final = '"input (unprocessed)" is the photo itself as transmission, and black as reflection.'
_IDENTICAL: Final = f"The PSNR of identical pictures, which is infinite, counts as {IDENTICAL_DB:g} dB."
_REGION: Final = (
    "The reflection region is where photo and truth differ by more than {} of the full scale (the largest channel's "
    "difference, averaged over 7x7 px). Pictures without such a region do not count there."
)
_INTERVALS: Final = (
    f"Intervals are 95 %, from {RESAMPLES:,} bootstrap resamples of whole scenes within each benchmark. Differences "
    "are paired by picture. A method's mean is over the pictures that it did not fail on, and their number is printed."
)
_DRAW: Final = (
    "The paper's draw of one picture a scene of Postcard and SolidObject is unpublished; ours has the seed "
    f"{PAPER_SEED} and is listed in results.json. The average is over the paper's five sets, and what was drawn of them."
)
