"""The reference renderer: path-traces the five images of any scene with an unmodified Mitsuba 3.

The two renderers share no code for the optics, so that each validates the other. Each image is lit
from one side of the glass only; objects on the other side are black. Light is additive, so I is the
sum of the image lit from behind and the image lit from the front.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Final, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from brewster.errors import DeviceError, RecipeError
from brewster.render.environments.assets import Assets
from brewster.render.mitsuba.scene_builder import GlassMode, MitsubaSceneBuilder
from brewster.render.mitsuba.variant import COMPILED, INSTALL_LLVM, load, probe
from brewster.render.sample import LinearSample
from brewster.render.scene.scene import Scene

_POLARISED: Final = "llvm_ad_mono_polarized"
_MIN_PASSES: Final = 4
"""Fewer passes give no useful estimate of the variance."""
_MAX_RAYS_PER_PASS: Final = 1 << 22
"""A pass with this number of rays (pixels x samples per pixel) needs about 1 GB of memory."""
_RELATIVE_FLOOR: Final = 0.01
"""This fraction of the mean light is added to each pixel before its relative error is computed,
because the relative error of a black pixel is not defined.
"""


def trace(
    scene: Scene,
    assets: Assets,
    *,
    noise_threshold: float = 0.02,
    max_samples: int = 4096,
    polarised: bool = False,
) -> LinearSample:
    """Path-traces the five images of a scene in equal passes, until their noise is low enough.

    The error of an image is the mean over its pixels of standard error / (light + 1 % of the mean
    light). The standard error is computed from the variance between passes. An image is finished
    when its error is at most `noise_threshold`, or after `max_samples` samples per pixel (spp). The
    light from behind and the light from the front are measured together, relative to their sum I:
    the next pass is for the side that adds more error to I. With truncated orders, T and R are
    rendered separately.

    Mitsuba's colour variants average s- and p-polarised light at every surface, which is wrong for
    glass with several surfaces. `polarised` traces each colour with the polarised variant, at
    several times the cost. In Mitsuba, light is unpolarised after a rough surface.

    Raises MissingExtra if mitsuba cannot be imported; DeviceError if `polarised` is set and Mitsuba
    works with no LLVM of this machine; RecipeError if the scene has a polariser or a cloth, a wedge
    or lens has no thickness somewhere in the view, two surfaces meet, or a file is missing;
    PhotoError if a file cannot be decoded, or is not an environment map.
    """
    if scene.camera.polariser_deg is not None or scene.cloth:
        raise RecipeError(
            "the scene has a polariser or a cloth",
            "expected a scene without, because only the analytic renderer has them",
            "use --renderer analytic",
        )
    mi = load()
    with _active_variant(mi, polarised=polarised):
        channels = range(3) if polarised else (None,)
        builders = [MitsubaSceneBuilder(mi, scene, assets, channel) for channel in channels]
        return _render_layers(builders, noise_threshold, max_samples)


@contextmanager
def _active_variant(mi: ModuleType, *, polarised: bool) -> Iterator[None]:
    """Selects a variant of Mitsuba for the whole process, and restores the previous variant
    afterwards.
    """
    previous = mi.variant()
    name = probe().variant
    if polarised and name != COMPILED:
        happened = "polarised light cannot be traced"
        raise DeviceError(
            happened, "expected a working LLVM", f"install LLVM 17 or newer: {INSTALL_LLVM}"
        )
    mi.set_variant(_POLARISED if polarised else name)
    try:
        yield
    finally:
        if previous:
            mi.set_variant(previous)


def _render_layers(
    builders: Sequence[MitsubaSceneBuilder], noise_threshold: float, max_samples: int
) -> LinearSample:
    scene = builders[0].scene

    def estimate(*images: tuple[bool, GlassMode]) -> list[_RunningEstimate]:
        estimates = [
            _RunningEstimate(builders, behind, mode, max_samples) for behind, mode in images
        ]
        _converge(estimates, noise_threshold, max_samples)
        return estimates

    transmission, reflection = lit_from_behind, lit_from_front = estimate(
        (True, "full"), (False, "full")
    )
    if scene.orders == "truncated":
        [transmission] = estimate((True, "truncated_transmission"))
        [reflection] = estimate((False, "truncated_reflection"))
    [background] = estimate((True, "none"))
    [mirror] = estimate((False, "mirror"))
    layers = [image.light for image in (transmission, background, reflection, mirror)]
    layers.insert(0, lit_from_behind.light + lit_from_front.light)
    return LinearSample(
        scene,
        *(torch.from_numpy(np.float32(light)).permute(2, 0, 1).contiguous() for light in layers),
    )


class _RunningEstimate:
    """An image that is rendered in passes: the mean of the passes so far, and the variance of this
    mean per pixel.
    """

    def __init__(
        self,
        builders: Sequence[MitsubaSceneBuilder],
        behind: bool,
        glass_mode: GlassMode,
        max_samples: int,
    ) -> None:
        scene = builders[0].scene
        self._mi = builders[0].mi
        self._scenes = [
            self._mi.load_dict(builder.scene_dict(lit_from_behind=behind, glass_mode=glass_mode))
            for builder in builders
        ]
        self._seed_key = scene.seed, scene.index, int(behind), get_args(GlassMode).index(glass_mode)
        # 64, 16, 4 or 1 samples per pixel, because square numbers are stratified evenly.
        pixels = scene.camera.width * scene.camera.height
        limit = min(max_samples // _MIN_PASSES, _MAX_RAYS_PER_PASS // pixels)
        self.samples_per_pass = next((samples for samples in (64, 16, 4) if samples <= limit), 1)
        self.pass_count = 0
        self._sum = np.zeros((scene.camera.height, scene.camera.width, 3))
        self._sum_of_squares = np.zeros(self._sum.shape[:2])

    def add_pass(self) -> None:
        """Renders one more pass with independent random numbers."""
        seed = int(np.random.SeedSequence((*self._seed_key, self.pass_count)).generate_state(1)[0])
        rendered = [
            np.array(self._mi.render(scene, spp=self.samples_per_pass, seed=seed))
            for scene in self._scenes
        ]
        # With polarisation, there is one grey image per colour.
        image = (
            rendered[0]
            if len(rendered) == 1
            else np.stack([one[..., 0] for one in rendered], axis=2)
        )
        self._sum += image
        self._sum_of_squares += image.mean(axis=2, dtype=np.float64) ** 2
        self.pass_count += 1

    @property
    def light(self) -> NDArray[np.float64]:
        """The mean of all passes, (H, W, 3)."""
        return self._sum / self.pass_count

    @property
    def variance(self) -> NDArray[np.float64]:
        """The variance of the mean of the colours of `light`, (H, W)."""
        spread = self._sum_of_squares / self.pass_count - self.light.mean(axis=2) ** 2
        variance: NDArray[np.float64] = spread.clip(min=0) / (self.pass_count - 1)
        return variance


def _converge(
    estimates: Sequence[_RunningEstimate], noise_threshold: float, max_samples: int
) -> None:
    """Adds a pass to the image with the largest error, until their sum is good enough, or all have
    `max_samples`.
    """
    for estimate in estimates:
        for _ in range(_MIN_PASSES):
            estimate.add_pass()
    while pending := [
        image
        for image in estimates
        if (image.pass_count + 1) * image.samples_per_pass <= max_samples
    ]:
        light = np.sum([image.light.mean(axis=2) for image in estimates], axis=0)
        scale = light + _RELATIVE_FLOOR * light.mean() + np.finfo(np.float32).tiny
        variances = [image.variance for image in estimates]
        if (np.sqrt(np.sum(variances, axis=0)) / scale).mean() <= noise_threshold:
            return
        max(pending, key=lambda image: float((np.sqrt(image.variance) / scale).mean())).add_pass()
