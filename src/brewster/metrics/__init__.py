"""Metrics that compare a prediction with its ground truth. All images are uint8 sRGB, (H, W, 3).

    from brewster.metrics import METRICS, psnr, reflection_region
    psnr(prediction, truth, region=reflection_region(photo, truth))

    fidelity     PSNR, SSIM and the error in linear light
    perceptual   LPIPS; imports torch at its first use
    region       the reflection region: pixels that the glass has visibly changed
    bright       loss of clipped light and of white
    failures     removed content and remaining reflection, for rendered samples

`METRICS` is the table of all metrics, with the definition of each."""

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
from brewster.metrics.perceptual import DifferenceMaps, Features, Lpips, lpips
from brewster.metrics.windows import DEFAULT_THRESHOLD, Image, Region, reflection_region

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
    "psnr",
    "psnr_of_channels",
    "reflection_region",
    "removed_content",
    "removed_white",
    "ssim",
]


def _psnr(comparison: Comparison) -> float:
    counts = (
        comparison.shared(_pair_counts) if comparison.region is None else _pair_counts(comparison)
    )
    return min(psnr_of_counts(counts), IDENTICAL_DB)


def _pair_counts(comparison: Comparison) -> PairCounts:
    prediction = comparison.prediction.pixels
    truth = comparison.truth.pixels
    return count_pairs(prediction, truth, region=comparison.region)


def _gaussian_map(comparison: Comparison) -> NDArray[np.float64]:
    return ssim_map(comparison.prediction.pixels, comparison.truth.pixels, window="gaussian")


def _uniform_map(comparison: Comparison) -> NDArray[np.float64]:
    return ssim_map(comparison.prediction.pixels, comparison.truth.pixels)


def _lpips_difference(comparison: Comparison) -> DifferenceMaps:
    prediction, truth = (
        each.features(_lpips_features) for each in (comparison.prediction, comparison.truth)
    )
    return Lpips.load().difference(prediction, truth)


@functools.lru_cache(maxsize=4)
def _lpips_features_of_black(shape: tuple[int, ...]) -> Features:
    return Lpips.load().features(np.zeros(shape, np.uint8))


def _lpips_features(image: Image) -> Features:
    # The baseline, the unprocessed input, has a black reflection in every case. Its features are
    # cached to save time.
    return Lpips.load().features(image) if image.any() else _lpips_features_of_black(image.shape)


IDENTICAL_DB: Final = 100.0
"""The PSNR that METRICS reports for identical images and channels. Their true PSNR, and means of
it, are infinite.
"""

_PSNR: Final = "10 log10(255^2 / MSE) over the three channels of 8-bit sRGB"
_SSIM: Final = "per RGB channel of 8-bit sRGB, K1 0.01, K2 0.03, range 255"
_UNIFORM: Final = f"uniform 7x7 window, sample covariance, {_SSIM}, without the outermost 3 pixels"
_LPIPS: Final = "LPIPS 0.1 of AlexNet, 8-bit sRGB scaled to -1..1, at the size of the ground truth"
_REGION: Final = (
    "the reflection region, where the maximum of |photo - truth| / 255 over the channels, "
    "averaged over 7x7 pixels,"
    f" is above {DEFAULT_THRESHOLD} unless the report states another threshold"
)
_LINEAR: Final = (
    "Root mean squared error of linear light (the inverse sRGB curve of the 8-bit values, in "
    "0..1) over the three"
    " channels of all pixels"
)
_GAIN: Final = (
    "The prediction is first multiplied by one gain: the median of background / prediction in "
    "linear luminance where"
    " there is no reflection."
)

_NEAR_WHITE: Final = (
    "of the pixels above 200 in all channels of photo and ground truth, in 8-bit levels"
)
_GAUSSIAN: Final = (
    f"Gaussian 11x11 window of sigma 1.5, population covariance, {_SSIM}, without "
    "the outermost 5 pixels"
)
_WHITE: Final = "the background is white (encoded channels above 0.75 and less than 0.12 apart)"
_LOST: Final = (
    "Fraction of the background's light that the prediction lacks where the "
    "reflection is < 2 % of the photo"
)
_KEPT: Final = (
    "Fraction of the reflection's light that the prediction still has above the background, "
    "where the reflection is at"
    " least 10 % of the photo and the photo is not clipped."
)
_CHANNELS: Final = (
    "The mean of 10 log10(255^2 / MSE) of red, green and blue of 8-bit sRGB, over all pixels, as "
    "in the code of ERRNet"
    " and XReflection."
)
_CLIPPED: Final = (
    "Share of the channel values >= 250 in photo and ground truth that are below "
    "240 in the prediction."
)


def _row(
    name: str, title: str, digits: int, definition: str, score: Callable[[Comparison], float]
) -> Metric:
    """Returns a metric of the transmission, over the whole image. Only PSNR has a unit; PSNR and
    SSIM rise.
    """
    unit = "dB" if name.startswith("psnr") else ""
    is_higher_better = name.startswith(("psnr", "ssim"))
    return Metric(name, title, unit, is_higher_better, digits, definition, "transmission", score)


def _in_region(metric: Metric, definition: str) -> Metric:
    name = f"{metric.name}_region"
    title = f"{metric.title} in region"
    return replace(
        metric, name=name, title=title, definition=f"{definition} {_REGION}.", area="region"
    )


def _of_reflection(metric: Metric, title: str) -> Metric:
    return replace(metric, name=f"{metric.name}_reflection", title=title, ground_truth="reflection")


def _of_photo(
    name: str,
    title: str,
    digits: int,
    definition: str,
    score: Callable[[Image, Image, Image], float],
) -> Metric:
    """Returns a metric whose function takes prediction, truth and photo."""
    return _row(
        name,
        title,
        digits,
        definition,
        lambda c: score(c.prediction.pixels, c.truth.pixels, c.photo),
    )


def _on_rendered(
    name: str, title: str, definition: str, score: Callable[[Image, Image, Image, Image], float]
) -> Metric:
    """Returns a metric whose function takes prediction, background, photo and reflection."""

    def score_comparison(c: Comparison) -> float:
        assert c.reflection is not None
        return score(c.prediction.pixels, c.truth.pixels, c.photo, c.reflection)

    return replace(
        _row(name, title, 3, f"{definition} {_GAIN}", score_comparison), ground_truth="rendered"
    )


_PSNR_ROW: Final = _row("psnr", "PSNR", 2, f"{_PSNR} of all pixels.", _psnr)
_SSIM_ROW: Final = _row(
    "ssim",
    "SSIM",
    3,
    f"Mean local SSIM, {_UNIFORM}.",
    lambda c: mean_ssim(c.shared(_uniform_map), region=c.region),
)
_LPIPS_ROW: Final = replace(
    _row(
        "lpips",
        "LPIPS",
        3,
        f"{_LPIPS}, each layer averaged over its map.",
        lambda c: c.shared(_lpips_difference).mean(region=c.region),
    ),
    prepare=Lpips.load,
)
_RMSE_ROW: Final = _row(
    "linear_rmse",
    "RMSE (linear light)",
    4,
    f"{_LINEAR}.",
    lambda c: linear_rmse_of_counts(c.shared(_pair_counts)),
)

_ROWS: Final = (
    _PSNR_ROW,
    _SSIM_ROW,
    _row(
        "ssim_gaussian",
        "SSIM (Gaussian)",
        3,
        f"Mean local SSIM, {_GAUSSIAN}.",
        lambda c: mean_ssim(c.shared(_gaussian_map)),
    ),
    _LPIPS_ROW,
    _in_region(_PSNR_ROW, f"{_PSNR} of"),
    _in_region(_SSIM_ROW, f"Mean local SSIM, {_UNIFORM}, over"),
    _in_region(
        _LPIPS_ROW,
        f"{_LPIPS}, each layer's map enlarged to the image (bilinear), averaged over",
    ),
    _RMSE_ROW,
    _row(
        "psnr_channels",
        "PSNR (channel mean)",
        2,
        _CHANNELS,
        lambda c: psnr_of_channels(c.prediction.pixels, c.truth.pixels, limit_db=IDENTICAL_DB),
    ),
    _row(
        "ssim_clipped",
        "SSIM (clipped)",
        3,
        "As SSIM (Gaussian), but negative local values count as 0, as in pyiqa.",
        lambda c: mean_ssim(np.maximum(c.shared(_gaussian_map), 0)),
    ),
    _of_photo("lost_clipped", "Lost clipped light", 3, _CLIPPED, lost_clipped),
    _of_photo(
        "lost_near_white",
        "Lost near white",
        1,
        f"Mean of truth - prediction {_NEAR_WHITE}.",
        lost_near_white,
    ),
    _of_photo(
        "near_white_cast",
        "Cast of near white",
        1,
        f"Largest - smallest channel of the mean truth - prediction {_NEAR_WHITE}.",
        near_white_cast,
    ),
    _of_reflection(_PSNR_ROW, "PSNR of R"),
    _of_reflection(_SSIM_ROW, "SSIM of R"),
    _of_reflection(_LPIPS_ROW, "LPIPS of R"),
    _of_reflection(_RMSE_ROW, "RMSE of R (linear light)"),
    _on_rendered("removed_content", "Removed content", f"{_LOST}.", removed_content),
    _on_rendered("removed_white", "Removed white", f"{_LOST} and {_WHITE}.", removed_white),
    _on_rendered("kept_reflection", "Kept reflection", _KEPT, kept_reflection),
)

METRICS: Final = {metric.name: metric for metric in _ROWS}
"""All metrics by name, in the order in which reports list them."""


def find_metric(name: str) -> Metric:
    """Returns the metric with this name.

    Args:
        name: a key of METRICS, such as "psnr".

    Raises:
        BrewsterError: there is no metric of this name. The error suggests the closest name.
    """
    if name in METRICS:
        return METRICS[name]
    close = difflib.get_close_matches(name.lower(), METRICS, n=1)
    cure = f"did you mean {close[0]}?" if close else "choose one of these names"
    raise BrewsterError(
        f"there is no metric {name!r}", f"expected one of {', '.join(METRICS)}", cure
    )
