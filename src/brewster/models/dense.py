"""The second network: a dense U-Net that corrects the maps of the compact network.

Dense 3x3 convolutions run a hundred times faster per operation than depthwise ones on CPUs with bfloat16 units (docs/training.md),
but start from random weights, far behind ImageNet features. The compact network has these features and long training.
The dense U-Net reads its maps and features and adds corrections to its maps. The corrections of a new network are zero, so that
training starts from the scores of the compact network.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final, final

import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.models.compact import (
    FEATURE_WIDTHS,
    MAP_COUNT,
    CompactNetwork,
    in_float32,
    layers_from_maps,
    with_imagenet_features,
)

if TYPE_CHECKING:
    from jaxtyping import Float

_CELL_PX: Final = 4
"""The U-Net works on cells of 4 x 4 pixels (pixel unshuffle), which become channels."""
_WIDTHS: Final = (64, 128, 256, 384)
_BLOCKS: Final = (1, 2, 4, 2)
"""Residual blocks of the encoder and of the decoder at strides 4, 8, 16 and 32."""
_HEADS: Final = 6
_HEAD_SCALE: Final = 0.05
"""Factor of the corrections. The head adds 576 normalised features: without the factor, one step of AdamW at a learning rate of 4e-4 changes
the output by up to 0.2, so that the head only oscillated around zero, and nothing was learned (measured over 1,600 steps)."""


@final
class _ChannelNorm(nn.Module):
    """Layer normalisation over the channels of each pixel. Without it, training diverged at a learning rate of 8e-4."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)  # type: ignore[no-any-return]


@final
class _ResidualBlock(nn.Module):
    """Two dense 3x3 convolutions on normalised features. The second starts at zero, so that a new block changes nothing."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = _ChannelNorm(width)
        self.expand = nn.Conv2d(width, width, 3, padding=1)
        self.project = nn.Conv2d(width, width, 3, padding=1)
        _zero(self.project)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.project(functional.silu(self.expand(self.norm(x))))  # type: ignore[no-any-return]


@final
class _GlobalAttention(nn.Module):
    """Self-attention between all pixels at stride 32: whether an edge is mirrored depends on the whole photo."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = _ChannelNorm(width)
        self.queries_keys_values = nn.Conv2d(width, 3 * width, 1)
        self.project = nn.Conv2d(width, width, 1)
        _zero(self.project)

    def forward(self, x: Tensor) -> Tensor:
        n, width, rows, columns = x.shape
        parts = self.queries_keys_values(self.norm(x)).reshape(n, 3, _HEADS, width // _HEADS, rows * columns)
        queries, keys, values = (part.squeeze(1).transpose(2, 3) for part in parts.split(1, dim=1))
        mixed = functional.scaled_dot_product_attention(queries, keys, values)
        return x + self.project(mixed.transpose(2, 3).reshape(n, width, rows, columns))  # type: ignore[no-any-return]


@final
class DenseNetwork(nn.Module):
    """Maps sRGB-encoded photos (N, 3, H, W) in 0..1, H and W multiples of 32, to two encoded layers (N, 6, H, W).

    The layers follow from the maps as in `CompactNetwork`. `hints` are two soft masks in 0..1, (N, 2, H, W): where a person
    sees reflection, and where only the scene. Zero is no hint.
    """

    def __init__(self) -> None:
        super().__init__()
        self.encoder = CompactNetwork()
        cell = _CELL_PX**2
        self.stem = nn.Conv2d((3 + MAP_COUNT) * cell + 2, _WIDTHS[0], 3, padding=1)
        self.adapters = nn.ModuleList(
            nn.Conv2d(*sizes, 1) for sizes in zip(FEATURE_WIDTHS, _WIDTHS, strict=True)
        )
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, 2) for a, b in itertools.pairwise(_WIDTHS))
        self.ups = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in itertools.pairwise(_WIDTHS))
        self.encoders, self.decoders = (
            nn.ModuleList(
                _blocks(width, count) for width, count in zip(_WIDTHS[:depth], _BLOCKS, strict=False)
            )
            for depth in (len(_WIDTHS), len(_WIDTHS) - 1)
        )
        self.attention = _GlobalAttention(_WIDTHS[-1])
        self.head_norm = _ChannelNorm(_WIDTHS[0])
        self.head = nn.Conv2d(_WIDTHS[0], MAP_COUNT * cell, 3, padding=1)
        _zero(self.head)

    def forward(
        self, photo_encoded: Float[Tensor, "n 3 h w"], hints: Float[Tensor, "n 2 h w"] | None = None
    ) -> Float[Tensor, "n 6 h w"]:
        """Returns the encoded transmission and reflection of encoded photos, concatenated along the channels."""
        if hints is None:
            hints = torch.zeros_like(photo_encoded[:, :2])
        maps, features = self.encoder.maps(photo_encoded)
        inputs = [
            functional.pixel_unshuffle(torch.cat([photo_encoded * 2 - 1, maps], dim=1), _CELL_PX),
            functional.avg_pool2d(hints, _CELL_PX),
        ]
        corrections = functional.pixel_shuffle(self._unet(torch.cat(inputs, dim=1), features), _CELL_PX)
        return layers_from_maps(photo_encoded, maps + _HEAD_SCALE * corrections)

    def _unet(self, x: Tensor, features: list[Tensor]) -> Tensor:
        x, skips = self.stem(x), []
        for level, (blocks, adapter) in enumerate(zip(self.encoders, self.adapters, strict=True)):
            x = blocks(x + adapter(features[level]))
            if level < len(self.downs):
                skips.append(x)
                x = self.downs[level](x)
        x = self.attention(x)
        for up, blocks, skip in zip(self.ups[::-1], self.decoders[::-1], skips[::-1], strict=True):
            x = blocks(functional.pixel_shuffle(up(x), 2) + skip)
        return in_float32(self.head, self.head_norm(x))


def with_imagenet_encoder() -> DenseNetwork:
    """Returns a new network whose encoder is a new compact network with ImageNet features. May raise MissingExtra."""
    network = DenseNetwork()
    network.encoder = with_imagenet_features()
    return network


def _blocks(width: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(_ResidualBlock(width) for _ in range(count)))


def _zero(convolution: nn.Conv2d) -> None:
    nn.init.zeros_(convolution.weight)
    assert convolution.bias is not None
    nn.init.zeros_(convolution.bias)
