"""Reads rendered bursts: the frames of each scene, and the exact motion of both layers between them.

A dataset of `brewster render --burst` has one sample for each frame. The frames of a burst follow each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from brewster.errors import RecipeError
from brewster.rendered.store import StoredSample, read_dataset, read_scene_of
from brewster.scene.burst import LayerMotion, layer_motion
from brewster.scene.scene import Scene


@dataclass(frozen=True)
class StoredBurst:
    """A rendered burst. `index` is the number of the burst in its dataset. `frames` are in the order of the camera's
    path."""

    index: int
    frames: tuple[StoredSample, ...]
    scenes: tuple[Scene, ...]
    """The scenes of the frames."""

    @property
    def reference(self) -> int:
        """The position of the reference frame in `frames`: the middle."""
        return len(self.frames) // 2

    def motion(self, frame: int) -> LayerMotion:
        """Computes the motion of both layers from the reference frame to another frame (see `layer_motion`)."""
        return layer_motion(self.scenes[self.reference], self.scenes[frame])


def read_bursts(out: Path) -> Iterator[StoredBurst]:
    """Yields the complete bursts of a dataset in order. A burst of which a frame failed or is not yet rendered is left
    out.
    Raises RecipeError if a sample is not a frame of a burst."""
    frames = ((entry, read_scene_of(entry)) for entry in read_dataset(out))
    for (index, count), group in groupby(frames, key=lambda frame: _burst_of(*frame)):
        entries, scenes = zip(*group, strict=True)
        if len(entries) == count:
            yield StoredBurst(index, entries, scenes)


def _burst_of(entry: StoredSample, scene: Scene) -> tuple[int, int]:
    """Returns the number of the burst of a frame, and the number of its frames."""
    if scene.burst is None:
        raise RecipeError(
            f"sample {entry.index} of {entry.path.parent} is a single photo",
            "expected the frames of bursts",
            "choose a dataset of `brewster render --burst`",
        )
    return entry.index // scene.burst.frames, scene.burst.frames
