"""Metrics that compare a prediction with its ground truth. All images are uint8 sRGB, (H, W, 3).

    from brewster.metrics import METRICS, psnr, reflection_region
    psnr(prediction, truth, region=reflection_region(photo, truth))

    fidelity     PSNR, SSIM and the error in linear light
    perceptual   LPIPS; imports torch at its first use
    naturalness  NIQE, without ground truth
    region       the reflection region: pixels that the glass has visibly changed
    bright       loss of clipped light and of white
    failures     removed content and remaining reflection, for rendered samples

`METRICS` is the table of all metrics, with the definition of each.
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from brewster.errors import BrewsterError
from brewster.metrics.bright import lost_clipped, lost_near_white, near_white_cast
from brewster.metrics.failures import kept_reflection, removed_content, removed_white
from brewster.metrics.fidelity import (
    PairCounts,
    Window,
    count_pairs,
    linear_rmse,
    linear_rmse_of_counts,
    mean_ssim,
    psnr,
    psnr_of_channels,
    psnr_of_counts,
    ssim,
    ssim_map,
)
from brewster.metrics.metric import CachedImage, Comparison, Metric
from brewster.metrics.naturalness import niqe
from brewster.metrics.perceptual import DifferenceMaps, Features, Lpips, lpips
from brewster.metrics.region import DEFAULT_THRESHOLD, reflection_region
from brewster.metrics.windows import Image, Region

__all__ = [
    "DEFAULT_THRESHOLD",
    "IDENTICAL_DB",
    "METRICS",
    "CachedImage",
    "Comparison",
    "DifferenceMaps",
    "Features",
    "Image",
    "Lpips",
    "Metric",
    "Region",
    "Window",
    "find_metric",
    "kept_reflection",
    "linear_rmse",
    "lost_clipped",
    "lost_near_white",
    "lpips",
    "near_white_cast",
    "niqe",
    "psnr",
    "psnr_of_channels",
    "reflection_region",
    "removed_content",
    "removed_white",
    "ssim",
]


def _psnr(comparison: Comparison) -> float:
    if comparison.region is None:
        return min(psnr_of_counts(comparison.shared(_pair_counts)), IDENTICAL_DB)
    return min(
        psnr(comparison.prediction.pixels, comparison.truth.pixels, region=comparison.region), IDENTICAL_DB
    )


def _psnr_of_channels(comparison: Comparison) -> float:
    return min(psnr_of_channels(comparison.prediction.pixels, comparison.truth.pixels), IDENTICAL_DB)


def _linear_rmse(comparison: Comparison) -> float:
    return linear_rmse_of_counts(comparison.shared(_pair_counts))


def _pair_counts(comparison: Comparison) -> PairCounts:
    return count_pairs(comparison.prediction.pixels, comparison.truth.pixels)


def _uniform_map(comparison: Comparison) -> NDArray[np.float64]:
    return ssim_map(comparison.prediction.pixels, comparison.truth.pixels)


def _gaussian_map(comparison: Comparison) -> NDArray[np.float64]:
    return ssim_map(comparison.prediction.pixels, comparison.truth.pixels, window="gaussian")


def _ssim(comparison: Comparison) -> float:
    return mean_ssim(comparison.shared(_uniform_map), region=comparison.region)


def _ssim_gaussian(comparison: Comparison) -> float:
    return mean_ssim(comparison.shared(_gaussian_map), region=comparison.region)


def _ssim_clipped(comparison: Comparison) -> float:
    return mean_ssim(np.maximum(comparison.shared(_gaussian_map), 0), region=comparison.region)


def _lpips(comparison: Comparison) -> float:
    return comparison.shared(_lpips_difference).mean(region=comparison.region)


def _lpips_difference(comparison: Comparison) -> DifferenceMaps:
    prediction, truth = (
        image.features(_lpips_features) for image in (comparison.prediction, comparison.truth)
    )
    return Lpips.load().difference(prediction, truth)


def _lpips_features(image: Image) -> Features:
    # The baseline, the unprocessed input, has a black reflection in every case. Its features are cached to save time.
    return Lpips.load().features(image) if image.any() else _lpips_features_of_black(image.shape)


@functools.lru_cache(maxsize=4)
def _lpips_features_of_black(shape: tuple[int, ...]) -> Features:
    return Lpips.load().features(np.zeros(shape, np.uint8))


def _niqe(comparison: Comparison) -> float:
    return niqe(comparison.prediction.pixels)


def _bright_score(score: Callable[[Image, Image, Image], float]) -> Callable[[Comparison], float]:
    """Converts a function of prediction, truth and photo to the `score` function of a metric."""
    return lambda comparison: score(comparison.prediction.pixels, comparison.truth.pixels, comparison.photo)


def _rendered_score(
    score: Callable[[Image, Image, Image, Image], float],
) -> Callable[[Comparison], float]:
    """Converts a function of prediction, background, photo and reflection to the `score` function of a metric."""

    def score_comparison(comparison: Comparison) -> float:
        assert comparison.reflection is not None
        return score(
            comparison.prediction.pixels, comparison.truth.pixels, comparison.photo, comparison.reflection
        )

    return score_comparison


IDENTICAL_DB: Final = 100.0
"""The PSNR that METRICS reports for identical images. Their true PSNR is infinite, which makes means infinite, too."""

_PSNR: Final = "10 log10(255^2 / MSE) over the three channels of 8-bit sRGB"
_SSIM: Final = "per RGB channel of 8-bit sRGB, K1 0.01, K2 0.03, range 255"
_UNIFORM: Final = f"uniform 7x7 window, sample covariance, {_SSIM}, without the outermost 3 pixels"
_LPIPS: Final = "LPIPS 0.1 of AlexNet, 8-bit sRGB scaled to -1..1, at the size of the ground truth"
_REGION: Final = (
    "the reflection region, where the maximum of |photo - truth| / 255 over the channels, averaged over 7x7 pixels,"
    f" is above {DEFAULT_THRESHOLD} unless the report states another threshold"
)
_LINEAR: Final = (
    "Root mean squared error of linear light (the inverse sRGB curve of the 8-bit values, in 0..1) over the three"
    " channels of all pixels"
)
_GAIN: Final = (
    "The prediction is first multiplied by one gain: the median of background / prediction in linear luminance where there"
    " is no reflection."
)

_PSNR_ROW: Final = Metric("psnr", "PSNR", "dB", True, 2, f"{_PSNR} of all pixels.", "transmission", _psnr)
_SSIM_ROW: Final = Metric("ssim", "SSIM", "", True, 3, f"Mean local SSIM, {_UNIFORM}.", "transmission", _ssim)
_LPIPS_ROW: Final = Metric(
    "lpips",
    "LPIPS",
    "",
    False,
    3,
    f"{_LPIPS}, each layer averaged over its map.",
    "transmission",
    _lpips,
    prepare=Lpips.load,
)
_RMSE_ROW: Final = Metric(
    "linear_rmse", "RMSE (linear light)", "", False, 4, f"{_LINEAR}.", "transmission", _linear_rmse
)


def _in_region(metric: Metric, definition: str) -> Metric:
    name, title = f"{metric.name}_region", f"{metric.title} in region"
    return replace(metric, name=name, title=title, definition=f"{definition} {_REGION}.", area="region")


def _of_reflection(metric: Metric, title: str) -> Metric:
    return replace(metric, name=f"{metric.name}_reflection", title=title, ground_truth="reflection")


def _on_rendered(name: str, title: str, definition: str, score: Callable[..., float]) -> Metric:
    return Metric(name, title, "", False, 3, f"{definition} {_GAIN}", "rendered", _rendered_score(score))


_NEAR_WHITE: Final = "of the pixels above 200 in all channels of photo and ground truth, in 8-bit levels"
_BRIGHT_ROWS: Final = (
    ("lost_clipped", "Lost clipped light", 3, "Share of the 8-bit channel values of at least 250 in photo and ground truth that are below 240 in the prediction.", lost_clipped),
    ("lost_near_white", "Lost near white", 1, f"Mean of truth - prediction {_NEAR_WHITE}.", lost_near_white),
    ("near_white_cast", "Cast of near white", 1, f"Largest - smallest channel of the mean truth - prediction {_NEAR_WHITE}.", near_white_cast),
)  # fmt: skip

_ROWS: Final = (
    _PSNR_ROW,
    _SSIM_ROW,
    Metric(
        "ssim_gaussian",
        "SSIM (Gaussian)",
        "",
        True,
        3,
        f"Mean local SSIM, Gaussian 11x11 window of sigma 1.5, population covariance, {_SSIM},"
        " without the outermost 5 pixels.",
        "transmission",
        _ssim_gaussian,
    ),
    _LPIPS_ROW,
    _in_region(_PSNR_ROW, f"{_PSNR} of"),
    _in_region(_SSIM_ROW, f"Mean local SSIM, {_UNIFORM}, over"),
    _in_region(_LPIPS_ROW, f"{_LPIPS}, each layer's map enlarged to the image (bilinear), averaged over"),
    _RMSE_ROW,
    Metric(
        "niqe",
        "NIQE",
        "",
        False,
        2,
        "NIQE (Mittal 2013): distance between the local statistics of the prediction and of undistorted photographs, in"
        " blocks of 96x96 pixels of the luma 0.299 R + 0.587 G + 0.114 B; the ground truth is not used.",
        "transmission",
        _niqe,
    ),
    Metric(
        "psnr_channels",
        "PSNR (channel mean)",
        "dB",
        True,
        2,
        "The mean of 10 log10(255^2 / MSE) of red, green and blue of 8-bit sRGB, over all pixels, as in the code of ERRNet"
        " and XReflection.",
        "transmission",
        _psnr_of_channels,
    ),
    Metric(
        "ssim_clipped",
        "SSIM (clipped)",
        "",
        True,
        3,
        "As SSIM (Gaussian), but negative local values count as 0, as in the package pyiqa.",
        "transmission",
        _ssim_clipped,
    ),
    *(
        Metric(name, title, "", False, digits, definition, "transmission", _bright_score(score))
        for name, title, digits, definition, score in _BRIGHT_ROWS
    ),
    _of_reflection(_PSNR_ROW, "PSNR of R"),
    _of_reflection(_SSIM_ROW, "SSIM of R"),
    _of_reflection(_LPIPS_ROW, "LPIPS of R"),
    _of_reflection(_RMSE_ROW, "RMSE of R (linear light)"),
    _on_rendered(
        "removed_content",
        "Removed content",
        "Fraction of the background's light that the prediction lacks where the reflection is below 2 % of the photo.",
        removed_content,
    ),
    _on_rendered(
        "removed_white",
        "Removed white",
        "Fraction of the background's light that the prediction lacks where the reflection is below 2 % of the photo and"
        " the background is white (encoded channels above 0.75 and less than 0.12 apart).",
        removed_white,
    ),
    _on_rendered(
        "kept_reflection",
        "Kept reflection",
        "Fraction of the reflection's light that the prediction still has above the background, where the reflection is at"
        " least 10 % of the photo and the photo is not clipped.",
        kept_reflection,
    ),
)

METRICS: Final = {metric.name: metric for metric in _ROWS}
"""All metrics by name, in the order in which reports list them."""


def find_metric(name: str) -> Metric:
    """Returns the metric with this name.

    Raises:
        BrewsterError: there is no metric with this name. The message suggests the closest name.
    """
    if name in METRICS:
        return METRICS[name]
    close = difflib.get_close_matches(name.lower(), METRICS, n=1)
    cure = f"did you mean {close[0]}?" if close else "choose one of these names"
    raise BrewsterError(f"there is no metric {name!r}", f"expected one of {', '.join(METRICS)}", cure)
