"""A sample: the five linear pictures of a scene, by the paper's letters I, T, B, R and MR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from torch import Tensor

from brewster.scene.scene import Scene

LAYERS: Final = ("photo", "transmission", "background", "reflection", "mirror")
"""I, T, B, R and MR, as files and fields are called."""


@dataclass(frozen=True, eq=False)
class LightSample:
    """Five pictures (3, H, W) float32 of linear light, and the scene that is their cause.

    `photo` is I, with full glass effects; `transmission` T and `reflection` R are its two layers;
    `background` B is the view without glass; `mirror` MR is the reflection of a perfect mirror.
    """

    scene: Scene
    photo: Tensor
    transmission: Tensor
    background: Tensor
    reflection: Tensor
    mirror: Tensor

    def layers(self) -> dict[str, Tensor]:
        """The five pictures by name."""
        return {name: getattr(self, name) for name in LAYERS}

    def each(self, change: Callable[[Tensor], Tensor]) -> LightSample:
        """The same sample with every picture changed alike."""
        return LightSample(self.scene, **{name: change(layer) for name, layer in self.layers().items()})
