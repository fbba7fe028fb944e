"""The table of compact networks. To add a network, write a module and add one row here.

    network = NETWORKS["lite2-unet"].pretrained()

A training recipe selects a row with `network = "..."`. Checkpoints and the exported model.onnx hold
that network.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from torch import nn


@final
@dataclass(frozen=True)
class NetworkEntry:
    """A row of NETWORKS.

    A network takes sRGB-encoded photos (N, 3, H, W) in 0..1 and returns (N, 6, H, W): encoded
    transmission and encoded reflection, not clamped. Its attribute `encoder` is the part that is
    trained with `encoder_learning_rate`.
    """

    build: Callable[[], nn.Module]
    """Returns the network with random weights; needs no file."""
    pretrained: Callable[[], nn.Module]
    """Returns the network from which training starts: its encoder has pretrained weights. May raise
    MissingExtra.
    """
    takes_hints: bool = False
    """Whether the network has a second input: hints of a person (N, 2, H, W), see
    `brewster.training.data.hints`.
    """


MAX_STRIDE: Final = 32
"""The sides of the inputs of a network are multiples of this. In inference, tiles are padded."""

DEFAULT_NETWORK: Final = "lite2-unet"


def _compact(function: str, *, refined: bool = False) -> nn.Module:
    """Calls a function of `compact`, which is imported only now, because the names of networks need
    no torch.
    """
    network: nn.Module = pkgutil.resolve_name(f"brewster.separation.models.compact:{function}")(
        refined=refined
    )
    return network


NETWORKS: Final[dict[str, NetworkEntry]] = {
    DEFAULT_NETWORK: NetworkEntry(
        partial(_compact, "CompactNetwork"),
        partial(_compact, "with_imagenet_features"),
        takes_hints=True,
    ),
    "lite2-refined": NetworkEntry(
        partial(_compact, "CompactNetwork", refined=True),
        partial(_compact, "with_imagenet_features", refined=True),
        takes_hints=True,
    ),
}
"""The networks by name."""
