"""Fast fake renderers for tests of executors; worker processes import them by name."""

import os
import signal
import time
from pathlib import Path
from threading import Event

import torch

from brewster.errors import DeviceError, RecipeError
from brewster.render.sample import SAMPLE_IMAGES, LinearSample


def render(scene, assets):
    """Random colours that depend on the scene only."""
    generator = torch.Generator().manual_seed(1000 * scene.seed + scene.index)
    return LinearSample(
        scene, **{layer: torch.rand(3, 16, 24, generator=generator) for layer in SAMPLE_IMAGES}
    )


def slow(scene, assets):
    """Takes 0.1 s for each sample."""
    time.sleep(0.1)
    return render(scene, assets)


def blocking(scene, assets):
    """Never finishes sample 2 if the environment variable FAKE_WAIT is set."""
    if scene.index == 2 and "FAKE_WAIT" in os.environ:
        Event().wait()
    return render(scene, assets)


def crashing_once(scene, assets):
    """Kills the first process that renders sample 2, as the kernel does if memory is exhausted."""
    marker = Path(os.environ["FAKE_MARKER"])
    if scene.index == 2 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return render(scene, assets)


def crashing(scene, assets):
    """Kills every process that renders sample 2."""
    if scene.index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return render(scene, assets)


def rejecting(scene, assets):
    """Raises a RecipeError for sample 1."""
    if scene.index == 1:
        raise RecipeError(
            "sample 1 cannot be rendered", "expected another sample", "choose another index"
        )
    return render(scene, assets)


def buggy(scene, assets):
    """Raises an unexpected exception for sample 1."""
    if scene.index == 1:
        raise ZeroDivisionError("division by zero")
    return render(scene, assets)


def without_device(scene, assets):
    """Raises the error of a missing device for every sample."""
    raise DeviceError("there is no GPU", "expected a GPU; or a CPU", "use another computer")
