"""DISTS: a distance of structure and texture between two images. It is small for two samples of the same texture.

K. Ding, K. Ma, S. Wang, E. P. Simoncelli, "Image Quality Assessment: Unifying Structure and Texture Similarity", IEEE
Trans. Pattern Anal. Mach. Intell. 44(5), 2022. The weights of the channels (dists_weights.npz) are those of the package
dists-pytorch 0.1. VGG16's convolutions are those of torchvision; see `weights.load_vgg16`. Functions import torch when they
are called; the import of this module does not.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.errors import MissingExtra
from brewster.metrics.weights import load_vgg16
from brewster.metrics.windows import Image, check_images

if TYPE_CHECKING:
    from torch import Tensor

MIN_SIDE: Final = 16
"""The minimum height and width in pixels, because each of four poolings halves the image."""

STAGES: Final = (2, 2, 3, 3, 3)
"""The number of convolutions in the stages of VGG16. DISTS compares the image and the output of each stage."""

_WEIGHTS_FILE: Final = Path(__file__).with_name("dists_weights.npz")
_CHANNELS: Final = (3, 64, 128, 256, 512, 512)
_MEAN: Final = (0.485, 0.456, 0.406)
_STD: Final = (0.229, 0.224, 0.225)
"""The mean and the standard deviation of ImageNet's values in 0..1."""
_STABILISER: Final = 1e-6
"""The constants c1 and c2 of equations 5 and 6 of the paper."""


@final
@dataclass(frozen=True, eq=False)
class DistsFeatures:
    """The image in 0..1 and the outputs of VGG16's five stages, (C, h * w) each, with the mean and variance of each channel.

    `shape` is the (height, width) of the image.
    """

    maps: tuple[Tensor, ...]
    means: tuple[Tensor, ...]
    variances: tuple[Tensor, ...]
    shape: tuple[int, int]


@final
@dataclass(frozen=True, eq=False)
class Dists:
    """DISTS with its weights. It runs on the CPU. Several threads may use one object."""

    convolutions: tuple[tuple[Tensor, Tensor], ...]
    """Weights (out, in, 3, 3) and biases (out,) of VGG16's thirteen convolutions."""
    texture: tuple[Tensor, ...]
    structure: tuple[Tensor, ...]
    """The weights of the channels of the six maps, (C,) each. Together they sum to 1."""

    @classmethod
    def load(cls) -> Dists:
        """Returns DISTS with its published weights. All calls return the same object.

        Raises:
            MissingExtra: torch is not installed.
            ModelError: the file of VGG16's weights is damaged, or is another file.
            DownloadError: VGG16's weights are not on this machine, and the download fails.
            OutputError: the download cannot be written to the cache folder.
        """
        return _load()

    def features(self, image: Image) -> DistsFeatures:
        """Returns the features of an image, uint8 (H, W, 3).

        Raises:
            ValueError: the image is not uint8 (H, W, 3), or has fewer than 16 pixels on a side.
        """
        import torch  # noqa: PLC0415 - an extra

        check_images(image)
        shape = image.shape[:2]
        if min(shape) < MIN_SIDE:
            raise ValueError(f"DISTS needs at least {MIN_SIDE}x{MIN_SIDE} pixels, not {shape[0]}x{shape[1]}")
        with torch.inference_mode():
            values = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / 255)
            maps = [values.flatten(1), *(stage.flatten(1) for stage in self._stages(values))]
            means = tuple(map_.mean(dim=1) for map_ in maps)
            variances = tuple(map_.var(dim=1, correction=0) for map_ in maps)
        return DistsFeatures(tuple(maps), means, variances, shape)

    def _stages(self, values: Tensor) -> list[Tensor]:
        import torch  # noqa: PLC0415 - an extra
        from torch.nn import functional  # noqa: PLC0415

        mean, std = (torch.tensor(numbers).view(3, 1, 1) for numbers in (_MEAN, _STD))
        activations = ((values - mean) / std)[None].contiguous(memory_format=torch.channels_last)
        convolutions = iter(self.convolutions)
        outputs: list[Tensor] = []
        for count in STAGES:
            if outputs:
                activations = _l2_pool(activations)
            for _ in range(count):
                weight, bias = next(convolutions)
                activations = functional.relu(functional.conv2d(activations, weight, bias, padding=1))
            outputs.append(activations[0])
        return outputs

    def distance(self, one: DistsFeatures, other: DistsFeatures) -> float:
        """Returns the DISTS distance of two images, given by their features (equation 7 of the paper).

        Returns:
            The distance, 0 for equal images; lower is better.

        Raises:
            ValueError: the images differ in size.
        """
        import torch  # noqa: PLC0415 - an extra

        if one.shape != other.shape:
            raise ValueError(f"the images differ in size: {one.shape} and {other.shape}")
        similarity = 0.0
        with torch.inference_mode():
            for i, (texture, structure) in enumerate(zip(self.texture, self.structure, strict=True)):
                mean, other_mean = one.means[i], other.means[i]
                covariance = (one.maps[i] * other.maps[i]).mean(dim=1) - mean * other_mean
                texture_similarity = (2 * mean * other_mean + _STABILISER) / (
                    mean.square() + other_mean.square() + _STABILISER
                )
                structure_similarity = (2 * covariance + _STABILISER) / (
                    one.variances[i] + other.variances[i] + _STABILISER
                )
                weighted = texture * texture_similarity + structure * structure_similarity
                similarity += float(weighted.double().sum())
        return 1 - similarity


def read_channel_weights() -> tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]]:
    """Returns the published weights of texture and structure: six arrays (C,) each. All are >= 0, and they sum to 1."""
    with np.load(_WEIGHTS_FILE) as file:
        parts = [file[name] for name in ("texture", "structure")]
    total = sum(float(part.sum(dtype=np.float64)) for part in parts)
    ends = np.cumsum(_CHANNELS)[:-1]
    texture, structure = (np.split((part / total).astype(np.float32), ends) for part in parts)
    return texture, structure


@functools.cache
def _load() -> Dists:
    try:
        import torch  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtra.for_extra(
            "evaluate",
            "torch is not installed",
            "expected torch, which brewster needs for DISTS",
        ) from error
    texture, structure = (tuple(map(torch.from_numpy, part)) for part in read_channel_weights())
    return Dists(_pairs(load_vgg16()), texture, structure)


def _pairs(tensors: Sequence[Tensor]) -> tuple[tuple[Tensor, Tensor], ...]:
    import torch  # noqa: PLC0415 - an extra

    weights = [weight.to(memory_format=torch.channels_last) for weight in tensors[::2]]  # faster on the CPU
    return tuple(zip(weights, tensors[1::2], strict=True))


def _l2_pool(values: Tensor) -> Tensor:
    """Returns the root of the Hann-weighted mean of squares over 3x3 pixels, with stride 2 and zeros beyond the border."""
    import torch  # noqa: PLC0415 - an extra
    from torch.nn import functional  # noqa: PLC0415

    channels = values.shape[1]
    taps = torch.tensor([0.25, 0.5, 0.25])
    kernel = torch.outer(taps, taps).expand(channels, 1, 3, 3).contiguous()
    means = functional.conv2d(values.square(), kernel, stride=2, padding=1, groups=channels)
    return (means + 1e-12).sqrt()
