"""A network between sRGB encoding and decoding. The script xreflection/converter.py loads this file
where brewster is not installed, so that it imports nothing of brewster.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, final

from torch import Tensor, nn

if TYPE_CHECKING:
    from jaxtyping import Float


@final
class LinearSeparator(nn.Module):
    """The network between sRGB encoding and decoding: input and output are linear light.

    Args:
        network: maps encoded photos, (N, 3, H, W), to encoded layers, (N, 6, H, W).
        to_encoded: the curve from linear light to encoded values, `brewster.photo.srgb.to_encoded`.
        to_linear: the curve back.
    """

    def __init__(
        self,
        network: nn.Module,
        to_encoded: Callable[[Tensor], Tensor],
        to_linear: Callable[[Tensor], Tensor],
    ) -> None:
        super().__init__()
        self.network = network
        self._to_encoded = to_encoded
        self._to_linear = to_linear

    def forward(
        self, photo: Float[Tensor, "n 3 h w"], hints: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Returns the linear transmission and reflection of linear photos, both (N, 3, H, W) in
        0..1.
        """
        photo_encoded = self._to_encoded(photo.clamp(0, 1))
        layers = (
            self.network(photo_encoded) if hints is None else self.network(photo_encoded, hints)
        )
        layers = layers.clamp(0, 1)
        return self._to_linear(layers[:, :3]), self._to_linear(layers[:, 3:])
