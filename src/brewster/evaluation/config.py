"""The settings of an evaluation, and protocols: the choices of papers and contests that change the
scores.

A published score can be compared with a measured score only if both use the same protocol. Reports
list the choices.
"""

import tomllib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, final

from brewster.base.bootstrap import RESAMPLES
from brewster.errors import BrewsterError
from brewster.evaluation.benchmarks.registry import PAPER_SEED
from brewster.metrics import DEFAULT_THRESHOLD, IDENTICAL_DB, METRICS, Metric, find_metric
from brewster.options import Quality

_ON_REQUEST: Final = ("ssim_gaussian", "ssim_clipped", "psnr_channels")
DEFAULT_METRICS: Final = tuple(
    name for name, metric in METRICS.items() if name not in _ON_REQUEST and not metric.prepare
)
"""All metrics but other definitions of PSNR and SSIM, those of single contests, and LPIPS, which
needs a download.
"""
PAPER_METRICS: Final = (*DEFAULT_METRICS, "lpips", "lpips_region")
"""For the tables of the paper."""


@final
@dataclass(frozen=True)
class EvaluationConfig:
    """The settings of an evaluation run."""

    metrics: tuple[str, ...] = DEFAULT_METRICS
    short_side_px: int | None = None
    """Larger images are downscaled to this shorter side in px before the methods run. None: the
    original size.
    """
    quality: Quality = "standard"
    threshold: float = DEFAULT_THRESHOLD
    """The threshold of the reflection region, as a fraction of full scale, between 0 and 1."""
    size_divisor: int = 1
    """Photo and ground truth are resized so that their sides are multiples of this number of px."""
    border: int = 0
    """The width in px of the border that is not scored."""
    protocol: str = "brewster"
    """The name of a protocol, a key of PROTOCOLS. It selects what reports say about it."""
    paper_subset: bool = False
    """Whether to report the paper's subset (one case of each scene) too, and to average over it."""

    def __post_init__(self) -> None:
        """Raises BrewsterError if a metric is unknown or a value is invalid."""
        for name in self.metrics:
            find_metric(name)
        if not self.metrics or len(set(self.metrics)) < len(self.metrics):
            raise BrewsterError(
                f"the metrics are {', '.join(self.metrics) or 'none'}",
                "expected at least one metric, each of them once",
                f"choose from {', '.join(METRICS)}",
            )
        if not 0 < self.threshold < 1:
            happened = f"the threshold of the reflection region is {self.threshold}"
            raise BrewsterError(
                happened, "expected a number between 0 and 1", "choose another number"
            )
        if self.short_side_px is not None and self.short_side_px < 1:
            happened = f"the size is {self.short_side_px} px"
            raise BrewsterError(
                happened, "expected a shorter side of 1 px or more", "choose a larger number"
            )

    @property
    def resizes(self) -> bool:
        """Whether photo and ground truth may be resized."""
        return self.short_side_px is not None or self.size_divisor > 1

    def columns(self) -> dict[str, Metric]:
        """Returns the metrics by name."""
        return {name: METRICS[name] for name in self.metrics}

    def describe(self) -> list[str]:
        """Returns one or more sentences for each setting."""
        size = (
            "Images are compared at the size of the ground "
            f"truth{'' if self.resizes else '; nothing is resized'}."
            if self.short_side_px is None
            else f"If the shorter side is longer than {self.short_side_px} px, photo and ground "
            "truth are downscaled to it before any method runs, by area means in linear light. "
            "Smaller images keep their size."
        )
        rounded = (
            "Photo and ground truth are resized to sides that are multiples of "
            f"{self.size_divisor} px, by bicubic interpolation of the 8-bit values."
        )
        border = f"The outermost {self.border} pixels of all images are not scored."
        subset = (
            "The paper uses one image of each scene of Postcard and SolidObject, and does not say "
            f"which. These subsets are drawn with the seed {PAPER_SEED} and listed in "
            "results.json. The average is over the paper's five benchmarks, with these subsets."
        )
        return [
            size,
            *([rounded] if self.size_divisor > 1 else []),
            *([border] if self.border else []),
            (
                "Metrics are computed on 8-bit sRGB values with three channels. Grey images are "
                "repeated in all channels, alpha is dropped, and embedded profiles are converted. "
                "The border is included unless the definition of the metric says otherwise."
            ),
            (
                "Images are paired by name. A prediction is never resized: it fails without the "
                "size of the ground truth."
            ),
            (
                '"input (unprocessed)" is the baseline: its transmission is the photo itself, its '
                "reflection is black."
            ),
            f'Models run as in the command "brewster PHOTO", at quality "{self.quality}".',
            f"The PSNR of identical images, which is infinite, counts as {IDENTICAL_DB:g} dB.",
            (
                "The reflection region contains the pixels where photo and ground truth differ by "
                f"more than {self.threshold:g} of full scale (the largest difference of the "
                "channels, averaged over 7x7 px). Images without such pixels have no score in the "
                "region."
            ),
            (
                f"Confidence intervals are 95 %, from {RESAMPLES:,} bootstrap resamples of whole "
                "scenes within each benchmark. Differences are paired by image. The mean of a "
                "method is over the images on which it did not fail. The tables show their number."
            ),
            *([subset] if self.paper_subset else []),
        ]


@final
@dataclass(frozen=True)
class ProtocolPreset:
    """A row of PROTOCOLS: the choices of a protocol, as (choice, source), and its settings."""

    title: str
    choices: tuple[tuple[str, str], ...]
    config: EvaluationConfig


def protocol_config(name: str, **changes: Any) -> EvaluationConfig:  # noqa: ANN401  (the fields of EvaluationConfig)
    """Returns the settings of a protocol. `changes` are fields of `EvaluationConfig` that replace
    or complete them. Raises BrewsterError if there is no protocol of this name, or a value is
    invalid.
    """
    if name not in PROTOCOLS:
        raise BrewsterError(
            f"there is no protocol {name!r}",
            f"expected one of {', '.join(PROTOCOLS)}",
            "choose one of them",
        )
    return replace(PROTOCOLS[name].config, protocol=name, **changes)


def describe_protocol(config: EvaluationConfig) -> list[str]:
    """Returns sentences: the name of the protocol, its choices with their sources, and what differs
    from it.
    """
    preset = PROTOCOLS[config.protocol]
    names = [field.name for field in fields(config) if field.name not in _NOT_IN_PROTOCOLS]
    changed = [name for name in names if getattr(config, name) != getattr(preset.config, name)]
    lines = [f"Protocol {config.protocol}: {preset.title}."]
    lines += [f"{choice} (source: {source})." for choice, source in preset.choices]
    if changed:
        lines.append(
            f"This run differs from the protocol {config.protocol} in: {', '.join(changed)}."
        )
    return lines


_NOT_IN_PROTOCOLS: Final = ("protocol", "quality", "threshold")
"""The fields of `EvaluationConfig` about which a protocol says nothing."""

_FILE: Final = Path(__file__).with_name("protocols.toml")


def _read_protocols() -> dict[str, ProtocolPreset]:
    protocols = {}
    for name, table in tomllib.loads(_FILE.read_text("utf-8")).items():
        title = table.pop("title")
        choices = tuple(map(tuple, table.pop("choices")))
        metrics = (*table.pop("metrics", DEFAULT_METRICS), *table.pop("additional_metrics", ()))
        protocols[name] = ProtocolPreset(title, choices, EvaluationConfig(metrics=metrics, **table))
    return protocols


PROTOCOLS: Final = _read_protocols()
"""name -> protocol, for `brewster evaluate --protocol`; the content of protocols.toml."""
