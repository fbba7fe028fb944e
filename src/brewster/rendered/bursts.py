"""Reads rendered bursts: the frames of each scene, and the exact motion of both layers between them.

    for burst in read_bursts(Path("out/burst")):
        light, _ = open_sample(burst.frames[burst.reference])
        motion = burst.motion(4)

A dataset of `brewster render --burst` has one sample for each frame. The frames of a burst follow each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path

from brewster.errors import RecipeError
from brewster.rendered.store import StoredSample, read_dataset, read_scene_of
from brewster.scene.burst import LayerMotion, layer_motion
from brewster.scene.scene import Scene


@dataclass(frozen=True)
class StoredBurst:
    """A rendered burst. `index` is the number of the burst in its dataset. `frames` are in the order of the camera's path."""

    index: int
    frames: tuple[StoredSample, ...]

    @property
    def reference(self) -> int:
        """The position of the reference frame in `frames`: the middle."""
        return len(self.frames) // 2

    @cached_property
    def scenes(self) -> tuple[Scene, ...]:
        """The scenes of the frames.

        Raises:
            RecipeError: a scene file is damaged.
        """
        return tuple(read_scene_of(frame) for frame in self.frames)

    def motion(self, frame: int) -> LayerMotion:
        """Computes the motion of both layers from the reference frame to another frame.

        Raises:
            RecipeError: a scene file is damaged, or the motion cannot be computed (see `layer_motion`).
        """
        return layer_motion(self.scenes[self.reference], self.scenes[frame])


def read_bursts(out: Path) -> Iterator[StoredBurst]:
    """Yields the complete bursts of a dataset in order. A burst of which a frame failed or is not yet rendered is left out.

    Raises:
        RecipeError: the dataset has a sample that is not a frame of a burst, or a scene file is damaged.
    """
    frames = ((_frames_of(entry), entry) for entry in read_dataset(out))
    for (index, count), group in groupby(frames, key=lambda item: (item[1].index // item[0], item[0])):
        entries = tuple(entry for _, entry in group)
        if len(entries) == count:
            yield StoredBurst(index, entries)


def _frames_of(entry: StoredSample) -> int:
    burst = read_scene_of(entry).burst
    if burst is None:
        raise RecipeError(
            f"sample {entry.index} of {entry.path.parent} is a single photo",
            "expected the frames of bursts",
            "choose a dataset of `brewster render --burst`",
        )
    return burst.frames
