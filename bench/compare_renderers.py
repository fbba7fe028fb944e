"""Compares the analytic renderer with Mitsuba on the same scenes: means, PSNR, and error relative to noise.

    python bench/compare_renderers.py [SAMPLES] [NAME]

Each scene is rendered twice by both, with different random numbers, to estimate the noise. If only noise separates
the renderers, mse(a - b) of the two means a and b equals mse(a1 - a2) / 4 + mse(b1 - b2) / 4: the last column is 1.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from brewster.environments.assets import Assets
from brewster.render.analytic import render
from brewster.render.mitsuba.renderer import trace
from brewster.render.rays import rough_glass
from brewster.render.sample import LAYERS, LightSample
from brewster.scene.camera import Camera
from brewster.scene.glass import Glazing, Pane
from brewster.scene.scene import Scene
from brewster.scene.world import AssetSource, EnvironmentMap, Plane, Side

STREET = EnvironmentMap(source=AssetSource(file="builtin:street:3"), heading_deg=200)
ROOM = EnvironmentMap(source=AssetSource(file="builtin:room:2"), heading_deg=70)
DOME = ROOM.model_copy(update={"radius_mm": 4000.0})
ART = Plane(source=AssetSource(file="builtin:painting:5"), distance_mm=60, width_mm=700, luminance=0.6)
PORTRAIT = Plane(source=AssetSource(file="builtin:painting:8"), distance_mm=900, width_mm=800, luminance=2.0)
CAMERA = Camera(width=128, height=96, fov_deg=36, heading_deg=4, position_mm=(-40, 0, 700), focus_mm=2500)
LENS = CAMERA.model_copy(update={"aperture_mm": 20.0})
CLEAR, THICK = Pane(), Pane(thickness_mm=20)
TINTED = Pane(thickness_mm=10, absorption_per_m=(30, 8, 14))

FAR = {"behind": Side(map=STREET), "front": Side(map=ROOM)}
NEAR = {"behind": Side(map=STREET, plane=ART), "front": Side(map=DOME, plane=PORTRAIT)}
SCENES = {
    "single, far": Scene(camera=CAMERA, **FAR),
    "single, paper orders": Scene(camera=CAMERA, orders="paper", **FAR),
    "tinted, dome": Scene(
        camera=CAMERA, glass=Glazing(panes=(TINTED,)), behind=Side(map=STREET), front=Side(map=DOME)
    ),
    "double": Scene(camera=CAMERA, glass=Glazing(panes=(CLEAR, CLEAR), gap_mm=12), **FAR),
    "double tinted, near": Scene(camera=CAMERA, glass=Glazing(panes=(TINTED, TINTED), gap_mm=12), **NEAR),
    "double, paper orders, near": Scene(
        camera=CAMERA, orders="paper", glass=Glazing(panes=(THICK, CLEAR), gap_mm=12), **NEAR
    ),
    "wedge": Scene(camera=CAMERA, samples=64, glass=Glazing(panes=(Pane(wedge_deg=0.2),)), **FAR),
    "near planes on both sides": Scene(camera=CAMERA, glass=Glazing(panes=(THICK,)), **NEAR),
    "lens, far": Scene(camera=LENS, **FAR),
    "lens, near": Scene(camera=LENS, samples=256, glass=Glazing(panes=(THICK,)), **NEAR),
    "rough 0.05": Scene(camera=CAMERA, samples=256, glass=Glazing(panes=(Pane(roughness=0.05),)), **FAR),
    "rough 0.2": Scene(camera=CAMERA, samples=256, glass=Glazing(panes=(Pane(roughness=0.2),)), **FAR),
    "45 degrees": Scene(
        camera=CAMERA.model_copy(update={"heading_deg": 45.0, "position_mm": (-700.0, 0.0, 700.0)}), **FAR
    ),
}


@contextmanager
def averaged_polarisations() -> Iterator[None]:
    """Averages s- and p-polarised light at every microfacet of our rough glass, as Mitsuba's colour variants do."""

    def averaged(cosine: Tensor, here: float, beyond: float) -> tuple[Tensor, Tensor]:
        s, p = separate(cosine, here, beyond)
        return (s + p) / 2, (s + p) / 2

    separate = rough_glass._reflectances
    rough_glass._reflectances = averaged
    try:
        yield
    finally:
        rough_glass._reflectances = separate


def compare(scene: Scene, assets: Assets, samples: int) -> list[str]:
    """One row each for I, T, B, R and MR: ratio of the means - 1, its standard error, PSNR and error over noise."""
    with averaged_polarisations():
        ours, again = render(scene, assets), render(_reseeded(scene, 1), assets)
    polarised = scene.camera.heading_deg > 30
    first, second = (
        trace(_reseeded(scene, seed), assets, noise=0, max_samples=samples, polarised=polarised)
        for seed in (2, 3)
    )
    return [_row(name, ours, again, first, second) for name in LAYERS]


def _row(name: str, ours: LightSample, again: LightSample, first: LightSample, second: LightSample) -> str:
    one, two, a, b = (getattr(sample, name).double() for sample in (ours, again, first, second))
    mine, theirs = (one + two) / 2, (a + b) / 2
    error = (mine - theirs).square().mean()
    noise = ((one - two).square().mean() + (a - b).square().mean()) / 4
    pixels = math.sqrt(a[0].numel())
    spread = math.sqrt(float(((a - b).mean(0).var() + (one - two).mean(0).var()) / 4)) / pixels
    ratio = float(mine.mean() / theirs.mean()) - 1
    psnr = 10 * math.log10(float(theirs.clamp(max=1).max() ** 2 / error.clamp(min=1e-20)))
    return f"{100 * ratio:+.3f} ({100 * spread / float(theirs.mean()):.3f}) | {psnr:.1f} | {float(error / noise):.2f}"


def _reseeded(scene: Scene, seed: int) -> Scene:
    return scene.model_copy(update={"seed": seed})


def main() -> None:
    """Prints a Markdown table of the scenes whose name contains NAME, or of all."""
    torch.set_num_threads(2)
    samples = int(sys.argv[1]) if len(sys.argv) > 1 else 1024
    assets = Assets()
    print(
        "mean, %: ours / Mitsuba - 1 (standard error) | PSNR, dB | squared error / error expected from noise"
    )
    for name, scene in SCENES.items():
        if len(sys.argv) > 2 and sys.argv[2] not in name:
            continue
        print(f"| {name} |", flush=True)
        for layer, line in zip(LAYERS, compare(scene, assets, samples), strict=True):
            print(f"|   {layer} | {line} |", flush=True)


if __name__ == "__main__":
    main()
