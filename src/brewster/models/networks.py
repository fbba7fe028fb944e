"""The table of compact networks: a new one is its own file and one row here.

network = NETWORKS["lite2-unet"].pretrained()

A training recipe names a row with `network = "..."`. Checkpoints and the exported model.onnx follow the recipe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

from torch import nn

from brewster.models import compact


@final
@dataclass(frozen=True)
class NetworkEntry:
    """A row of NETWORKS.

    A network takes sRGB-encoded photos (N, 3, H, W) in 0..1 and returns (N, 6, H, W): encoded transmission and encoded
    reflection, not clamped. Its attribute `encoder` is the part that learns at `encoder_learning_rate`.
    """

    build: Callable[[], nn.Module]
    """The network with fresh weights; needs no file."""
    pretrained: Callable[[], nn.Module]
    """The network as a run starts with it, with pretrained weights in its encoder; may raise MissingExtra."""
    stride: int
    """Both sides of the input are multiples of this, a divisor of LARGEST_STRIDE."""


LARGEST_STRIDE: Final = 32
"""Inference pads every tile to multiples of this, and the sides of training pictures are multiples of it."""

DEFAULT_NETWORK: Final = "lite2-unet"

NETWORKS: Final[dict[str, NetworkEntry]] = {
    DEFAULT_NETWORK: NetworkEntry(
        compact.CompactNetwork, compact.with_imagenet_features, stride=compact.STRIDE
    ),
}
"""What a training recipe can name as its `network`."""
