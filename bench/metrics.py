"""Compares the speed of our LPIPS with the `lpips` package, and of our SSIM with scikit-image, on
540x400 images.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/metrics.py

Both use one thread. The calls alternate, and the median of 11 rounds is printed. Our LPIPS computes
the features of a ground truth once for all its predictions, so each further prediction takes less
time. The package computes the features of both images every time. The package is not imported:
`ReferenceLpips` repeats its operations.
"""

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from skimage.metrics import structural_similarity
from torch.nn import functional

from brewster import Photo
from brewster.metrics import Lpips, psnr, reflection_region, ssim
from brewster.metrics.weights import ALEXNET_TENSORS, load_alexnet, read_lpips_channel_weights

HEIGHT = 400
WIDTH = 540
ROUNDS = 11
STRIDES_AND_PADDINGS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))  # of AlexNet's convolutions
GAUSSIAN = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "use_sample_covariance": False,
    "data_range": 255,
}


def main(data: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    prediction, truth = read_pair(data)
    measure_lpips(prediction, truth)
    for window, options in (("uniform", {}), ("gaussian", GAUSSIAN)):
        ours_ms, reference_ms = median_ms(
            lambda window=window: ssim(prediction, truth, window=window),
            lambda options=options: structural_similarity(
                truth, prediction, channel_axis=2, **options
            ),
        )
        print(
            f"SSIM {window} of 540x400: {ours_ms:.1f} ms; scikit-image {reference_ms:.1f} ms; "
            f"{reference_ms / ours_ms:.2f} times as fast"
        )
    psnr_ms, region_ms = median_ms(
        lambda: psnr(prediction, truth), lambda: reflection_region(prediction, truth)
    )
    print(f"PSNR: {psnr_ms:.1f} ms; reflection region: {region_ms:.1f} ms")
    torch.set_num_threads(threads)


def measure_lpips(prediction: np.ndarray, truth: np.ndarray) -> None:
    metric = Lpips.load()
    reference = ReferenceLpips()
    truth_features = metric.features(truth)
    first_ms, reference_ms = median_ms(
        lambda: metric.difference(metric.features(prediction), metric.features(truth)).mean(),
        lambda: reference(prediction, truth),
    )
    (further_ms,) = median_ms(
        lambda: metric.difference(metric.features(prediction), truth_features).mean()
    )
    ours = float(metric.difference(metric.features(prediction), truth_features).mean())
    difference = abs(ours - reference(prediction, truth))
    print(
        f"LPIPS of 540x400: {first_ms:.0f} ms, each further prediction {further_ms:.0f} ms; "
        f"the operations of the lpips package {reference_ms:.0f} ms; "
        f"{reference_ms / first_ms:.2f} and {reference_ms / further_ms:.2f} times as fast; "
        f"difference {difference:.1e}"
    )


class ReferenceLpips:
    """LPIPS with the operations of the lpips package, in the same order."""

    def __init__(self) -> None:
        tensors = [load_alexnet()[name] for name in ALEXNET_TENSORS]
        self.convolutions = list(zip(tensors[::2], tensors[1::2], strict=True))
        self.channel_weights = [
            torch.from_numpy(weights).view(1, -1, 1, 1) for weights in read_lpips_channel_weights()
        ]
        self.shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
        self.scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, prediction: np.ndarray, truth: np.ndarray) -> float:
        features = [self.features(self.tensor(prediction)), self.features(self.tensor(truth))]
        value = 0
        for one, other, weights in zip(*features, self.channel_weights, strict=True):
            difference = (unit_length(one) - unit_length(other)) ** 2
            value = value + functional.conv2d(difference, weights).mean([2, 3], keepdim=True)
        return value.item()

    @staticmethod
    def tensor(image: np.ndarray) -> torch.Tensor:
        return torch.Tensor((image / 127.5 - 1)[:, :, :, np.newaxis].transpose((3, 2, 0, 1)))

    def features(self, values: torch.Tensor) -> list[torch.Tensor]:
        values = (values - self.shift) / self.scale
        features = []
        for layer, ((stride, padding), (weight, bias)) in enumerate(
            zip(STRIDES_AND_PADDINGS, self.convolutions, strict=True)
        ):
            if layer in (1, 2):
                values = functional.max_pool2d(values, 3, 2)
            values = functional.relu(
                functional.conv2d(values, weight, bias, stride, padding), inplace=True
            )
            features.append(values)
        return features


def unit_length(values: torch.Tensor) -> torch.Tensor:
    """Returns features (1, C, H, W) scaled to length 1 over the channels."""
    return values / (torch.sqrt(torch.sum(values**2, dim=1, keepdim=True)) + 1e-10)


def read_pair(data: Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns a real photo and its ground truth, cropped to 540x400."""
    photo = min((data / "real/dev/nature/blended").iterdir())
    (truth,) = (data / "real/dev/nature/transmission").glob(f"{photo.stem}.*")
    return tuple(Photo.open(path).pixels[:HEIGHT, :WIDTH] for path in (photo, truth))


def median_ms(*runs: Callable[[], object]) -> list[float]:
    """The median milliseconds of each function. Calls alternate: other processes affect all
    functions equally.
    """
    times = [[] for _ in runs]
    for _ in range(ROUNDS + 1):
        for run, run_times in zip(runs, times, strict=True):
            started = time.perf_counter()
            run()
            run_times.append(1e3 * (time.perf_counter() - started))
    return [statistics.median(run_times[1:]) for run_times in times]  # the first call is a warm-up


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
