"""A rendered sample: the five linear images of a scene, which the paper calls I, T, B, R and MR."""

from dataclasses import dataclass
from typing import Final

from torch import Tensor

from brewster.render.scene.scene import Scene

SAMPLE_IMAGES: Final = ("photo", "transmission", "background", "reflection", "mirror")
"""The names of I, T, B, R and MR in files and fields."""


@dataclass(frozen=True, eq=False)
class LinearSample:
    """Five images of linear light, float32 (3, H, W), and the scene from which they were rendered.

    `photo` is I, the view with all glass effects; `transmission` T and `reflection` R are its two
    layers; `background` B is the view without glass; `mirror` MR is the reflection in a perfect
    mirror.
    """

    scene: Scene
    photo: Tensor
    transmission: Tensor
    background: Tensor
    reflection: Tensor
    mirror: Tensor

    def images(self) -> dict[str, Tensor]:
        """Returns the five images by name."""
        return {name: getattr(self, name) for name in SAMPLE_IMAGES}
