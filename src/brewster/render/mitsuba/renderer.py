"""The judge: the five pictures of any scene, path-traced by stock Mitsuba 3, which knows nothing of our formulas.

    sample = trace(scene, Assets([Path("hdri")]), noise=0.01)

Every picture is lit from one side of the glass alone, the other side's objects standing there in black: light adds
up, so that I is the sum of what comes from behind and what comes from the front, and each map keeps its own grid.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Final, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brewster.environments.assets import Assets
from brewster.errors import DeviceError, MissingExtra
from brewster.render.mitsuba.scene_builder import Glass, MitsubaSceneBuilder
from brewster.render.mitsuba.variant import COMPILED, INSTALL_LLVM, load, probe
from brewster.render.sample import LightSample
from brewster.scene.scene import Scene

_POLARISED: Final = "llvm_ad_mono_polarized"
_FEWEST_PASSES: Final = 4
_MOST_RAYS: Final = 1 << 22
"""Of one pass: about 1 GB."""
_DARKNESS: Final = 0.01
"""This share of a picture's mean light is added to each pixel's before its relative error is taken."""


def trace(
    scene: Scene,
    assets: Assets,
    *,
    noise: float = 0.02,
    most_samples: int = 4096,
    denoise: bool = False,
    polarised: bool = False,
) -> LightSample:
    """The five pictures of a scene, (3, H, W) float32 linear light, in equal passes until they are good enough.

    A picture's error is the mean over its pixels of standard error / (light + 1 % of the mean light), where the
    standard error comes from the passes themselves. Each picture stops as soon as its error is below `noise`, or
    after `most_samples` rays a pixel. T and R are measured against I, whose parts they are: of the two, the one
    that disturbs I more gets the next pass. The paper's T and R are pictures of their own.

    Mitsuba's colour variants average s- and p-polarised light at every surface. Nature averages at the end:
    `polarised` traces each colour so, at several times the cost; rough surfaces depolarise, in Mitsuba.

    Raises:
        MissingExtra: mitsuba is not installed or cannot be imported, or mitsuba-oidn is not installed, for `denoise`.
        DeviceError: polarised light is asked for, and no LLVM works here.
        RecipeError: a wedge or lens has no thickness left somewhere in the view, or a file is missing.
        PhotoError: a file cannot be read or is no map.
    """
    mi = load()
    with _rendering_by(mi, _variant(polarised)):
        studios = [
            MitsubaSceneBuilder(mi, scene, assets, colour) for colour in (range(3) if polarised else (None,))
        ]
        return _pictures(studios, noise, most_samples, denoise)


@contextmanager
def _rendering_by(mi: ModuleType, name: str) -> Iterator[None]:
    """The variant is one for the whole process: another that was chosen before comes back."""
    before = mi.variant()
    mi.set_variant(name)
    try:
        yield
    finally:
        if before:
            mi.set_variant(before)


def _variant(polarised: bool) -> str:
    name = probe().variant
    if polarised and name != COMPILED:
        raise DeviceError(
            "polarised light cannot be traced",
            "it needs an LLVM that works",
            f"install LLVM 17 or newer: {INSTALL_LLVM}",
        )
    return _POLARISED if polarised else name


def _pictures(
    studios: Sequence[MitsubaSceneBuilder], noise: float, most_samples: int, denoise: bool
) -> LightSample:
    scene = studios[0].scene

    def take(*shots: tuple[bool, Glass]) -> list[_RunningEstimate]:
        estimates = [_RunningEstimate(studios, behind, glass, most_samples) for behind, glass in shots]
        _converge(estimates, noise, most_samples)
        return estimates

    through, back = take((True, "full"), (False, "full"))
    parts = {"transmission": through, "reflection": back}
    if scene.orders == "paper":
        [parts["transmission"]] = take((True, "unreflected"))
        [parts["reflection"]] = take((False, "unentered"))
    [background] = take((True, "none"))
    [mirror] = take((False, "mirror"))
    layers = {name: estimate.light for name, estimate in parts.items()}
    layers |= {"photo": through.light + back.light, "background": background.light, "mirror": mirror.light}
    return LightSample(scene, **{name: _finished(light, denoise) for name, light in layers.items()})


def _finished(light: NDArray[np.float64], denoise: bool) -> Tensor:
    picture = np.ascontiguousarray(light, np.float32)
    if denoise:
        picture = np.array(_denoiser().denoise(picture, hdr=True), np.float32)
    return torch.from_numpy(picture).permute(2, 0, 1).contiguous()


def _denoiser() -> ModuleType:
    try:
        return importlib.import_module("mitsuba_oidn")
    except ImportError as error:
        raise MissingExtra(
            "mitsuba_oidn is not installed", "it denoises pictures", "run: pip install 'brewster[render]'"
        ) from error


class _RunningEstimate:
    """A picture's light from the passes so far, and how far its pixels may be off."""

    def __init__(
        self, studios: Sequence[MitsubaSceneBuilder], behind: bool, glass: Glass, most_samples: int
    ) -> None:
        scene = studios[0].scene
        self._mi = studios[0].mi
        self._rooms = [self._mi.load_dict(studio.room(behind=behind, glass=glass)) for studio in studios]
        self._name = scene.seed, scene.index, int(behind), get_args(Glass).index(glass)
        self.samples = _rays_a_pass(scene.camera.width * scene.camera.height, most_samples)
        self.passes = 0
        self._sum = np.zeros((scene.camera.height, scene.camera.width, 3))
        self._squares = np.zeros(self._sum.shape[:2])

    def add(self) -> None:
        """One more pass, with random numbers of its own."""
        seed = int(np.random.SeedSequence((*self._name, self.passes)).generate_state(1)[0])
        rendered = [np.array(self._mi.render(room, spp=self.samples, seed=seed)) for room in self._rooms]
        picture = rendered[0] if len(rendered) == 1 else np.stack([one[..., 0] for one in rendered], axis=2)
        self._sum += picture
        self._squares += picture.mean(axis=2, dtype=np.float64) ** 2
        self.passes += 1

    @property
    def light(self) -> NDArray[np.float64]:
        """The mean of all passes, (H, W, 3)."""
        return self._sum / self.passes

    @property
    def variance(self) -> NDArray[np.float64]:
        """Of the light's mean over the colours, (H, W)."""
        spread = self._squares / self.passes - self.light.mean(axis=2) ** 2
        variance: NDArray[np.float64] = spread.clip(min=0) / (self.passes - 1)
        return variance


def _rays_a_pass(pixels: int, most_samples: int) -> int:
    """A square number, which the sampler spreads evenly over a pixel, small enough for memory and four passes."""
    most = min(most_samples // _FEWEST_PASSES, _MOST_RAYS // pixels)
    return next((samples for samples in (64, 16, 4) if samples <= most), 1)


def _converge(estimates: Sequence[_RunningEstimate], noise: float, most_samples: int) -> None:
    """Passes for pictures that add up to one, each to the one that disturbs it most, until it is good enough."""
    for estimate in estimates:
        for _ in range(_FEWEST_PASSES):
            estimate.add()
    while waiting := [one for one in estimates if (one.passes + 1) * one.samples <= most_samples]:
        light = np.sum([one.light.mean(axis=2) for one in estimates], axis=0)
        scale = light + _DARKNESS * light.mean() + np.finfo(np.float32).tiny
        variances = [one.variance for one in estimates]
        if (np.sqrt(np.sum(variances, axis=0)) / scale).mean() <= noise:
            return
        max(waiting, key=lambda one: float((np.sqrt(one.variance) / scale).mean())).add()
