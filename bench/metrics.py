"""Time per 540x400 image of our LPIPS and the arithmetic of the `lpips` package, and of our SSIM and scikit-image's.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/metrics.py

One thread each, alternating, medians of 11 rounds. Our LPIPS computes the features of a ground truth once for all
predictions, so a further prediction costs less; the package computes both images every time.
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
from brewster.metrics.weights import TENSOR_NAMES, load_alexnet, read_heads

HEIGHT, WIDTH = 400, 540
ROUNDS = 11
STEPS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))
GAUSSIAN = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}


def main(data: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    picture, truth = pair(data)
    perceptual(picture, truth)
    for window, how in (("uniform", {}), ("gaussian", GAUSSIAN)):
        ours_ms, reference_ms = median_ms(
            lambda window=window: ssim(picture, truth, window=window),
            lambda how=how: structural_similarity(truth, picture, channel_axis=2, **how),
        )
        print(
            f"SSIM {window} of 540x400: {ours_ms:.1f} ms; scikit-image {reference_ms:.1f} ms; {reference_ms / ours_ms:.2f} times as fast"
        )
    fast, region = median_ms(lambda: psnr(picture, truth), lambda: reflection_region(picture, truth))
    print(f"PSNR: {fast:.1f} ms; reflection region: {region:.1f} ms")
    torch.set_num_threads(threads)


def perceptual(picture: np.ndarray, truth: np.ndarray) -> None:
    metric, package = Lpips.load(), Package()
    known = metric.features(truth)
    first, reference_ms = median_ms(
        lambda: metric.distance(metric.features(picture), metric.features(truth)),
        lambda: package(picture, truth),
    )
    (further,) = median_ms(lambda: metric.distance(metric.features(picture), known))
    difference = abs(metric.distance(metric.features(picture), known) - package(picture, truth))
    print(
        f"LPIPS of 540x400: {first:.0f} ms, each further prediction {further:.0f} ms; the lpips package's arithmetic "
        f"{reference_ms:.0f} ms; {reference_ms / first:.2f} and {reference_ms / further:.2f} times as fast; difference {difference:.1e}"
    )


class Package:
    """LPIPS with the operations of the lpips package, in its order."""

    def __init__(self) -> None:
        tensors = [load_alexnet()[name] for name in TENSOR_NAMES]
        self.convolutions = list(zip(tensors[::2], tensors[1::2], strict=True))
        self.heads = [torch.from_numpy(head).view(1, -1, 1, 1) for head in read_heads()]
        self.shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
        self.scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, picture: np.ndarray, truth: np.ndarray) -> float:
        seen = [self.maps(self.tensor(picture)), self.maps(self.tensor(truth))]
        value = 0
        for one, other, head in zip(*seen, self.heads, strict=True):
            difference = (normal(one) - normal(other)) ** 2
            value = value + functional.conv2d(difference, head).mean([2, 3], keepdim=True)
        return value.item()

    @staticmethod
    def tensor(picture: np.ndarray) -> torch.Tensor:
        return torch.Tensor((picture / 127.5 - 1)[:, :, :, np.newaxis].transpose((3, 2, 0, 1)))

    def maps(self, values: torch.Tensor) -> list[torch.Tensor]:
        values, maps = (values - self.shift) / self.scale, []
        for layer, ((stride, padding), (weight, bias)) in enumerate(
            zip(STEPS, self.convolutions, strict=True)
        ):
            if layer in (1, 2):
                values = functional.max_pool2d(values, 3, 2)
            values = functional.relu(functional.conv2d(values, weight, bias, stride, padding), inplace=True)
            maps.append(values)
        return maps


def normal(values: torch.Tensor) -> torch.Tensor:
    return values / (torch.sqrt(torch.sum(values**2, dim=1, keepdim=True)) + 1e-10)


def pair(data: Path) -> tuple[np.ndarray, np.ndarray]:
    """A real photo and its ground truth, cropped to 540x400."""
    photo = min((data / "real/dev/nature/blended").iterdir())
    (truth,) = (data / "real/dev/nature/transmission").glob(f"{photo.stem}.*")
    return tuple(Photo.open(path).pixels[:HEIGHT, :WIDTH] for path in (photo, truth))


def median_ms(*runs: Callable[[], object]) -> list[float]:
    """The median milliseconds of each function; they alternate, so that other load slows all of them alike."""
    times = [[] for _ in runs]
    for _ in range(ROUNDS + 1):
        for run, spent in zip(runs, times, strict=True):
            started = time.perf_counter()
            run()
            spent.append(1e3 * (time.perf_counter() - started))
    return [statistics.median(spent[1:]) for spent in times]


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
