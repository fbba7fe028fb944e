"""Fast fake renderers for tests of executors; worker processes import them by name."""

import os
import signal
import time
from pathlib import Path
from threading import Event

import torch

from brewster.errors import DeviceError, RecipeError
from brewster.render.sample import LAYERS, LightSample


def render(scene, assets):
    """Random colours that depend on the scene only."""
    generator = torch.Generator().manual_seed(1000 * scene.seed + scene.index)
    return LightSample(scene, **{layer: torch.rand(3, 16, 24, generator=generator) for layer in LAYERS})


def slow(scene, assets):
    time.sleep(0.1)
    return render(scene, assets)


def waits(scene, assets):
    """Never finishes sample 2 if FAKE_WAIT is set."""
    if scene.index == 2 and "FAKE_WAIT" in os.environ:
        Event().wait()
    return render(scene, assets)


def deadly_once(scene, assets):
    """Kills the first worker at sample 2, as the kernel does when memory runs out."""
    mark = Path(os.environ["FAKE_MARK"])
    if scene.index == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return render(scene, assets)


def deadly(scene, assets):
    if scene.index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return render(scene, assets)


def picky(scene, assets):
    if scene.index == 1:
        raise RecipeError("sample 1 is odd", "it should be even", "count by two")
    return render(scene, assets)


def clumsy(scene, assets):
    if scene.index == 1:
        raise ZeroDivisionError("oops")
    return render(scene, assets)


def deviceless(scene, assets):
    raise DeviceError("there is no light", "a lamp; or two", "buy one")
