"""LPIPS 0.1 with AlexNet: the perceptual distance between two images.

    metric = Lpips.load()
    truth = metric.features(image)  # once for many predictions
    for prediction in predictions:
        print(metric.difference(metric.features(prediction), truth).mean())

R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR
2018. The definition and the weights are those of version 0.1 of the `lpips` package. Functions
import torch when they are called; the import of this module does not.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.errors import MissingExtra
from brewster.metrics.weights import load_alexnet, read_lpips_channel_weights
from brewster.metrics.windows import Image, Region, check_images, check_region

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    Map = Float[Tensor, "_c _h _w"]
    """The five maps of an image differ in all dimensions. The underscores disable their comparison.
    """

MIN_SIDE: Final = 31
"""The minimum height and width in pixels. AlexNet's last map of a smaller image is empty."""

_SHIFT: Final = np.array([-0.030, -0.088, -0.188])
_SCALE: Final = np.array([0.458, 0.448, 0.450])
"""The mean and the standard deviation of ImageNet's values in -1..1, rounded as in LPIPS 0.1."""

_STRIDES_AND_PADDINGS: Final = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))
"""Of AlexNet's convolutions. A 3x3 max pooling with stride 2 precedes those of _POOLED."""
_POOLED: Final = (1, 2)


@final
@dataclass(frozen=True, eq=False)
class Features:
    """AlexNet's features of an image: five float32 maps (C, h, w), normalised to unit length over
    C. `shape` is the (height, width) of the image.
    """

    maps: tuple[Map, ...]
    shape: tuple[int, int]


@final
@dataclass(frozen=True, eq=False)
class DifferenceMaps:
    """The weighted squared differences of the features of two images: five float32 maps (h, w).
    `shape` is the (height, width) of the images.
    """

    maps: tuple[Tensor, ...]
    shape: tuple[int, int]

    def mean(self, *, region: Region | None = None) -> float:
        """Returns the distance, averaged over the whole maps or over a region; see
        `Lpips.difference`. Raises ValueError if the region is empty or of another shape.
        """
        import torch  # noqa: PLC0415 - an extra

        if region is None:
            return float(sum(_mean(map_.numpy()) for map_ in self.maps))
        check_region(region, self.shape)
        upsample = functools.partial(
            torch.nn.functional.interpolate, size=self.shape, mode="bilinear", align_corners=False
        )
        with torch.inference_mode():
            full = [upsample(map_[None, None])[0, 0] for map_ in self.maps]
            return _mean(sum(full[1:], start=full[0]).numpy()[region])


@final
@dataclass(frozen=True, eq=False)
class Lpips:
    """LPIPS with its weights. It runs on the CPU. Several threads may use one object."""

    convolutions: tuple[tuple[Tensor, Tensor], ...]
    """Weights (out, in, k, k) and biases (out,) of AlexNet's five convolutions."""
    channel_weights: tuple[Tensor, ...]
    """The weight of each channel of the five maps, (C,): the linear layers of LPIPS."""

    @classmethod
    @functools.cache
    def load(cls) -> Lpips:
        """Returns LPIPS with its published weights, always the same object. Raises MissingExtra if
        torch is not installed, ModelError if the file of AlexNet's weights is damaged,
        DownloadError if it is missing and the download fails, and OutputError if it cannot be
        stored.
        """
        try:
            import torch  # noqa: PLC0415 - an extra
        except ImportError as error:
            expected = "expected torch, which brewster needs for LPIPS"
            raise MissingExtra.for_extra("evaluate", "torch is not installed", expected) from error
        tensors = [*load_alexnet().values()]
        # The memory format is faster on the CPU.
        weights = [weight.to(memory_format=torch.channels_last) for weight in tensors[::2]]
        channel_weights = tuple(map(torch.from_numpy, read_lpips_channel_weights()))
        return cls(tuple(zip(weights, tensors[1::2], strict=True)), channel_weights)

    def features(self, image: Image) -> Features:
        """Returns the features of an image, uint8 (H, W, 3). Raises ValueError if the image is not
        uint8 (H, W, 3), or has fewer than 31 pixels on a side.
        """
        import torch  # noqa: PLC0415 - an extra
        from torch.nn import functional  # noqa: PLC0415

        check_images(image)
        shape = image.shape[:2]
        if min(shape) < MIN_SIDE:
            raise ValueError(
                f"LPIPS needs at least {MIN_SIDE}x{MIN_SIDE} pixels, not {shape[0]}x{shape[1]}"
            )
        maps = []
        with torch.inference_mode():
            activations = torch.from_numpy(_normalised(image)).permute(2, 0, 1)[None]
            layers = zip(self.convolutions, _STRIDES_AND_PADDINGS, strict=True)
            for i, ((weight, bias), how) in enumerate(layers):
                if i in _POOLED:
                    activations = functional.max_pool2d(activations, 3, 2)
                activations = functional.conv2d(activations, weight, bias, *how).relu_()
                maps.append(
                    activations[0] / (torch.linalg.vector_norm(activations[0], dim=0) + 1e-10)
                )
        return Features(tuple(maps), shape)

    def difference(self, one: Features, other: Features) -> DifferenceMaps:
        """Returns the five maps of the LPIPS distance between two images of equal size, given by
        their features. Its `mean` is the distance: 0 for equal images; lower is better.

        The squared differences of the features are weighted by channel, averaged over each map, and
        summed over the five maps. With a `region`, bool (H, W), each map is first upsampled to the
        size of the image (bilinear, align_corners=False; `spatial=True` in `lpips`), so that even a
        region of the whole image gives a slightly different value. Raises ValueError if the images
        differ in size.
        """
        import torch  # noqa: PLC0415 - an extra

        if one.shape != other.shape:
            raise ValueError(f"the images differ in size: {one.shape} and {other.shape}")
        with torch.inference_mode():
            maps = [
                torch.einsum("c,chw->hw", weights, (a - b).square_())
                for weights, a, b in zip(self.channel_weights, one.maps, other.maps, strict=True)
            ]
        return DifferenceMaps(tuple(maps), one.shape)


def lpips(prediction: Image, truth: Image, *, region: Region | None = None) -> float:
    """Returns the LPIPS 0.1 (AlexNet) distance between two images, with weights from `Lpips.load`;
    see `Lpips.difference`.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        region: the pixels to score, bool (H, W); None is all of them.

    Raises:
        ValueError: as `psnr`; or the images have fewer than 31x31 pixels.
        BrewsterError: as `Lpips.load`.
    """
    check_images(prediction, truth)
    metric = Lpips.load()
    return metric.difference(metric.features(prediction), metric.features(truth)).mean(
        region=region
    )


def _normalised(image: Image) -> NDArray[np.float32]:
    """Returns (value / 127.5 - 1 - shift) / scale, (H, W, 3). The channels stay last in memory,
    because convolutions on a CPU are fastest in this layout. It computes whole rows: numpy is slow
    along an axis of length 3.
    """
    height, width, _ = image.shape
    values = image.reshape(height, -1).astype(np.float32, order="C")
    values *= np.tile(1 / (127.5 * _SCALE), width).astype(np.float32)
    values -= np.tile((1 + _SHIFT) / _SCALE, width).astype(np.float32)
    return values.reshape(image.shape)


def _mean(values: NDArray[np.float32]) -> float:
    """Returns the mean. It is computed by numpy, because the order of torch's sums depends on the
    number of threads.
    """
    return float(values.mean(dtype=np.float64))
