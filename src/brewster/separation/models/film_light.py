"""The network that finds the smooth light that is in the wrong layer of a film, from both measured
layers and the photo.

The default compact network, unchanged, looks at each of the three as if it were a photo. A small
network compares what it finds in them, in cells of 8 px.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, final

import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.models.compact import (
    AttentionBlock,
    CompactNetwork,
    normalized,
    zeroed,
)

if TYPE_CHECKING:
    from jaxtyping import Float

CELL_PX: Final = 8
_WIDTH: Final = 112
_STATISTICS: Final = 5
"""Statistics of the light of each image in a cell, for each channel."""
_FIRST_SHARE: Final = 0.35
"""The share of what the compact network would change in T that moves before any training."""
_LARGEST_SHARE: Final = 0.5
"""The largest share of the light that moves without a change of the compact network."""
_SHADOWS: Final = 1e-3


@final
class _Block(nn.Module):
    """A residual block with a gate in place of an activation, as in NAFNet (Chen et al. 2022)."""

    def __init__(self, dilation: int = 1) -> None:
        super().__init__()
        self.expand = nn.Conv2d(_WIDTH, 2 * _WIDTH, 3, padding=dilation, dilation=dilation)
        self.project = nn.Conv2d(_WIDTH, _WIDTH, 1)
        self.scale = nn.Parameter(torch.full((_WIDTH, 1, 1), 0.2))

    def forward(self, x: Tensor) -> Tensor:
        one, other = self.expand(normalized(x)).chunk(2, dim=1)
        return x + self.scale * self.project(one * other)  # type: ignore[no-any-return]


@final
class CellNetwork(nn.Module):
    """The part that is trained: from the features of `FilmLightNetwork.cells` to moved light."""

    def __init__(self) -> None:
        super().__init__()
        self.proj = nn.ModuleList(nn.Conv2d(CompactNetwork.CELL_WIDTH, _WIDTH, 1) for _ in range(3))
        self.stats = nn.Conv2d(3 * 3 * (_STATISTICS + 1) + 6, _WIDTH, 3, padding=1)
        self.drop = nn.Dropout2d(0.1)
        self.blocks = nn.Sequential(
            _Block(), AttentionBlock(_WIDTH), _Block(2), AttentionBlock(_WIDTH), _Block()
        )
        self.head = zeroed(nn.Conv2d(_WIDTH, 12, 3, padding=1))

    def forward(
        self,
        features: Float[Tensor, "n 3 c h w"],
        statistics: Float[Tensor, "n 45 h w"],
        changes: Float[Tensor, "n 3 3 h w"],
        transmission: Float[Tensor, "n 3 h w"],
        reflection: Float[Tensor, "n 3 h w"],
    ) -> Float[Tensor, "n 3 h w"]:
        """Returns the light that moves from R to T in each cell. No layer becomes negative.

        Args:
            features: see `FilmLightNetwork.cells`, which returns all arguments.
            statistics: those of the light.
            changes: what the compact network would change, and the difference of the prior.
            transmission: T.
            reflection: R.
        """
        light = transmission + reflection + _SHADOWS
        x = self.stats(
            torch.cat(
                [
                    statistics,
                    (changes / light[:, None]).flatten(1, 2),
                    transmission / light,
                    _root(reflection) - _root(transmission),
                ],
                dim=1,
            )
        )
        for image, project in enumerate(self.proj):
            x = x + project(self.drop(features[:, image]))
        maps = self.head(self.blocks(x)).float()
        shares = torch.stack(maps[:, :9].chunk(3, dim=1), dim=1)
        moved = (
            (_FIRST_SHARE + shares[:, 0]) * changes[:, 0]
            - shares[:, 1] * changes[:, 1]
            + shares[:, 2] * changes[:, 2]
            + _LARGEST_SHARE * torch.tanh(maps[:, 9:]) * light
        )
        return torch.minimum(torch.maximum(moved, -transmission), reflection)


@final
class FilmLightNetwork(nn.Module):
    """Maps both measured layers, the photo and the prior of T to the light that moves from R to T,
    (N, 3, H / 8, W / 8). It was trained on layers of 160 px.

    Args:
        compact: the compact network. It is not trained.
    """

    def __init__(self, compact: CompactNetwork) -> None:
        super().__init__()
        self.compact = compact.eval().requires_grad_(requires_grad=False)
        self.cell_network = CellNetwork()

    def forward(
        self, transmission: Tensor, reflection: Tensor, photo: Tensor, prior: Tensor
    ) -> Tensor:
        """Returns the moved light.

        Args:
            transmission: measured T, (N, 3, H, W) linear light, H and W multiples of 32.
            reflection: measured R, of the same shape.
            photo: the photo.
            prior: its T as a network for single photos predicts it.
        """
        moved: Tensor = self.cell_network(*self.cells(transmission, reflection, photo, prior))
        return moved

    def cells(
        self, transmission: Tensor, reflection: Tensor, photo: Tensor, prior: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Returns what the cells show, without gradients, with h = H / 8 and w = W / 8: the
        features of the compact network in T, R and the photo (N, 3, c, h, w); statistics of the
        light of each (N, 45, h, w); what the compact network would change in T and in R, and the
        difference of `prior` from T (N, 3, 3, h, w); T and R (N, 3, h, w) each.

        Args:
            transmission: see the call.
            reflection: see the call.
            photo: see the call.
            prior: see the call.
        """
        with torch.no_grad():
            count = len(transmission)
            images = torch.cat([transmission, reflection, photo]).clamp(0, 1)
            features, layers = self.compact.cell_features(to_encoded(images))
            changes = _pooled(to_linear(layers[:, :3].clamp(0, 1)) - images)
            light = _pooled(transmission)
            statistics = [_statistics(image) for image in (transmission, reflection, photo)]
            return (
                features.reshape(3, count, *features.shape[1:]).transpose(0, 1),
                torch.cat(statistics, dim=1),
                torch.stack(
                    [changes[:count], changes[count : 2 * count], _pooled(prior) - light], dim=1
                ),
                light,
                _pooled(reflection),
            )


def _statistics(image: Tensor) -> Tensor:
    """Returns the mean, two measures of detail, the least and the largest root of the light in each
    cell, (N, 15, h, w).
    """
    root = _root(image)
    fine = root - functional.avg_pool2d(root, 3, 1, 1)
    coarse = root - functional.avg_pool2d(root, 9, 1, 4, count_include_pad=False)
    return torch.cat(
        [
            _pooled(root),
            10 * _pooled(fine.abs()),
            4 * _pooled(coarse.abs()),
            -functional.max_pool2d(-root, CELL_PX),
            functional.max_pool2d(root, CELL_PX),
        ],
        dim=1,
    )


def _pooled(image: Tensor) -> Tensor:
    return functional.avg_pool2d(image, CELL_PX)


def _root(light: Tensor) -> Tensor:
    return (light.clamp(min=0) + _SHADOWS).sqrt()
