"""Compares the analytic renderer with Mitsuba on the same scenes: means, PSNR, and error relative
to noise.

    python bench/compare_renderers.py [SAMPLES] [NAME]

SAMPLES is the number of Mitsuba's rays per pixel (default 1024). NAME selects the scenes whose
names contain this text.

Each renderer renders each scene twice, with different random numbers: a1 and a2 with the analytic
renderer, b1 and b2 with Mitsuba. With the means a and b, the last column is mse(a - b) / (mse(a1 -
a2) / 4 + mse(b1 - b2) / 4). The value is 1 if the renderers differ only by noise.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from brewster.render.analytic import render
from brewster.render.environments.assets import Assets
from brewster.render.mitsuba.renderer import trace
from brewster.render.rays import rough_glass
from brewster.render.sample import SAMPLE_IMAGES, LinearSample
from brewster.render.scene.camera import Camera
from brewster.render.scene.glass import Glazing, Pane
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import AssetSource, EnvironmentMap, Plane, Side

STREET = EnvironmentMap(source=AssetSource(file="potsdamer_platz.exr"), heading_deg=200)
ROOM = EnvironmentMap(source=AssetSource(file="vestibule.exr"), heading_deg=70)
DOME = ROOM.model_copy(update={"radius_mm": 4000.0})
NEAR_PAINTING = Plane(
    source=AssetSource(file="cathedral_roof.jpg"), distance_mm=60, width_mm=700, luminance=0.6
)
FAR_PAINTING = Plane(
    source=AssetSource(file="tiger.jpg"), distance_mm=900, width_mm=800, luminance=2.0
)
CAMERA = Camera(
    width=128, height=96, fov_deg=36, heading_deg=4, position_mm=(-40, 0, 700), focus_mm=2500
)
LENS = CAMERA.model_copy(update={"aperture_mm": 20.0})
CLEAR = Pane()
THICK = Pane(thickness_mm=20)
TINTED = Pane(thickness_mm=10, absorption_per_m=(30, 8, 14))

FAR = {"behind": Side(map=STREET), "front": Side(map=ROOM)}
NEAR = {
    "behind": Side(map=STREET, plane=NEAR_PAINTING),
    "front": Side(map=DOME, plane=FAR_PAINTING),
}
SCENES = {
    "single, far": Scene(camera=CAMERA, **FAR),
    "single, truncated orders": Scene(camera=CAMERA, orders="truncated", **FAR),
    "tinted, dome": Scene(
        camera=CAMERA, glass=Glazing(panes=(TINTED,)), behind=Side(map=STREET), front=Side(map=DOME)
    ),
    "double": Scene(camera=CAMERA, glass=Glazing(panes=(CLEAR, CLEAR), gap_mm=12), **FAR),
    "double tinted, near": Scene(
        camera=CAMERA, glass=Glazing(panes=(TINTED, TINTED), gap_mm=12), **NEAR
    ),
    "double, truncated orders, near": Scene(
        camera=CAMERA, orders="truncated", glass=Glazing(panes=(THICK, CLEAR), gap_mm=12), **NEAR
    ),
    "wedge": Scene(
        camera=CAMERA, samples_per_pixel=64, glass=Glazing(panes=(Pane(wedge_deg=0.2),)), **FAR
    ),
    "near planes on both sides": Scene(camera=CAMERA, glass=Glazing(panes=(THICK,)), **NEAR),
    "lens, far": Scene(camera=LENS, **FAR),
    "lens, near": Scene(camera=LENS, samples_per_pixel=256, glass=Glazing(panes=(THICK,)), **NEAR),
    "rough 0.05": Scene(
        camera=CAMERA, samples_per_pixel=256, glass=Glazing(panes=(Pane(roughness=0.05),)), **FAR
    ),
    "rough 0.2": Scene(
        camera=CAMERA, samples_per_pixel=256, glass=Glazing(panes=(Pane(roughness=0.2),)), **FAR
    ),
    "45 degrees": Scene(
        camera=CAMERA.model_copy(update={"heading_deg": 45.0, "position_mm": (-700.0, 0.0, 700.0)}),
        **FAR,
    ),
}


@contextmanager
def averaged_polarisations() -> Iterator[None]:
    """Averages s- and p-polarised light at every microfacet in `rough_glass`, as Mitsuba's colour
    variants do.
    """

    def averaged(cosine: Tensor, index_in: float, index_out: float) -> tuple[Tensor, Tensor]:
        s, p = original_reflectances(cosine, index_in, index_out)
        return (s + p) / 2, (s + p) / 2

    original_reflectances = rough_glass._reflectances
    rough_glass._reflectances = averaged
    try:
        yield
    finally:
        rough_glass._reflectances = original_reflectances


def compare(scene: Scene, assets: Assets, samples: int) -> list[str]:
    """Renders a scene with both renderers. Returns a row of the table for each of I, T, B, R and
    MR.
    """
    with averaged_polarisations():
        ours = render(scene, assets), render(_reseeded(scene, 1), assets)
    polarised = (
        scene.camera.heading_deg > 30
    )  # at smaller angles, s- and p-polarised light hardly differ
    theirs = tuple(
        trace(
            _reseeded(scene, seed),
            assets,
            noise_threshold=0,
            max_samples=samples,
            polarised=polarised,
        )
        for seed in (2, 3)
    )
    return [_row(name, ours, theirs) for name in SAMPLE_IMAGES]


def _row(name: str, ours: tuple[LinearSample, ...], theirs: tuple[LinearSample, ...]) -> str:
    """Returns the ratio of the means - 1 with its standard error, the PSNR, and the squared error
    relative to noise.
    """
    a1, a2, b1, b2 = (getattr(sample, name).double() for sample in (*ours, *theirs))
    a = (a1 + a2) / 2
    b = (b1 + b2) / 2
    error = (a - b).square().mean()
    noise = ((a1 - a2).square().mean() + (b1 - b2).square().mean()) / 4
    variance = ((b1 - b2).mean(0).var() + (a1 - a2).mean(0).var()) / 4
    standard_error = math.sqrt(float(variance)) / math.sqrt(a[0].numel())
    ratio = float(a.mean() / b.mean()) - 1
    psnr = 10 * math.log10(float(b.clamp(max=1).max() ** 2 / error.clamp(min=1e-20)))
    return (
        f"{100 * ratio:+.3f} ({100 * standard_error / float(b.mean()):.3f}) | {psnr:.1f} | "
        f"{float(error / noise):.2f}"
    )


def _reseeded(scene: Scene, seed: int) -> Scene:
    return scene.model_copy(update={"seed": seed})


def main() -> None:
    """Prints a Markdown table."""
    torch.set_num_threads(2)
    samples = int(sys.argv[1]) if len(sys.argv) > 1 else 1024
    assets = Assets()
    print(
        "| scene, image | analytic / Mitsuba - 1, % (standard error) | PSNR, dB | squared error "
        "/ noise |"
    )
    print("|---|---|---|---|")
    for name, scene in SCENES.items():
        if len(sys.argv) > 2 and sys.argv[2] not in name:
            continue
        print(f"| **{name}** | | | |", flush=True)
        for layer, line in zip(SAMPLE_IMAGES, compare(scene, assets, samples), strict=True):
            print(f"| {layer} | {line} |", flush=True)


if __name__ == "__main__":
    main()
