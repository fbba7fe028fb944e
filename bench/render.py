"""Compares the cost of the analytic renderer and of Mitsuba at equal error, and measures the cost
of a stored sample.

    BREWSTER_DATA=../shared/data python bench/render.py

Costs are CPU-seconds. The error is relMSE = mean((x - reference)^2 / (reference^2 + 0.01
mean(reference)^2)), averaged over the five images of a sample. The reference is an image of the
analytic renderer at four times the width and height, averaged over blocks of 4 x 4 pixels.
bench/compare_renderers.py shows that the two renderers agree. Mitsuba's number of samples per pixel
(spp) is doubled until the error is at most 1e-3, or until the next run will take more than a
minute. In the second case, the cost without the denoiser is extrapolated, because the error is then
proportional to 1 / spp. With the denoiser (OIDN) there is no such law, so the cost is a lower
bound, marked with >.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba_oidn
import numpy as np
import torch
from compare_renderers import DOME, STREET, TINTED
from torch.nn.functional import avg_pool2d

from brewster.base.executors.local import SerialExecutor
from brewster.render.analytic import needs_monte_carlo, render
from brewster.render.dataset.generation.job import RenderJob, build
from brewster.render.dataset.generation.workers import TaskRunner
from brewster.render.dataset.store import encode_sample
from brewster.render.environments.assets import Assets, builtin_catalog, read_catalog
from brewster.render.mitsuba.renderer import trace
from brewster.render.sample import SAMPLE_IMAGES, LinearSample
from brewster.render.scene.camera import Camera
from brewster.render.scene.glass import Glazing
from brewster.render.scene.recipe import read_scene_recipe
from brewster.render.scene.sampler import draw
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import AssetSource, EnvironmentMap, Plane, Side

TARGET_ERROR = 1e-3
MAX_CPU_S = 60.0
PAPER_RECIPE = Path(__file__).parents[1] / "recipes" / "render" / "paper.toml"
CAMERA = Camera(fov_deg=50, position_mm=(0, 0, 800), heading_deg=10)
ROOM = EnvironmentMap(source=AssetSource(file="vestibule.exr"))
PAINTING = Plane(source=AssetSource(file="cathedral_roof.jpg"), distance_mm=500, width_mm=2500)
SCENES = {
    "one smooth pane, sun": Scene(camera=CAMERA, behind=Side(map=STREET), front=Side(map=ROOM)),
    "two tinted panes, near photo": Scene(
        camera=CAMERA,
        glass=Glazing(panes=(TINTED, TINTED), gap_mm=12),
        behind=Side(plane=PAINTING),
        front=Side(map=DOME),
    ),
}


def relative_error(sample: LinearSample, reference: LinearSample) -> float:
    """Returns the relMSE, averaged over the five images."""
    errors = []
    for name in SAMPLE_IMAGES:
        x, r = (getattr(which, name).double() for which in (sample, reference))
        errors.append(((x - r).square() / (r.square() + 0.01 * r.mean() ** 2)).mean())
    return float(sum(errors) / len(errors))


def render_reference(scene: Scene, assets: Assets) -> LinearSample:
    """Renders a scene at four times the width and height, and averages blocks of 4 x 4 pixels."""
    camera = scene.camera.model_copy(
        update={"width": 4 * scene.camera.width, "height": 4 * scene.camera.height}
    )
    fine = render(scene.model_copy(update={"camera": camera}), assets)
    coarse = {name: avg_pool2d(image[None], 4)[0] for name, image in fine.images().items()}
    return replace(fine, **coarse)


def denoised(sample: LinearSample) -> LinearSample:
    """Returns the sample with its images filtered by Intel Open Image Denoise."""
    filtered = {
        name: torch.from_numpy(
            np.array(
                mitsuba_oidn.denoise(np.ascontiguousarray(image.permute(1, 2, 0)), hdr=True),
                np.float32,
            )
        ).permute(2, 0, 1)
        for name, image in sample.images().items()
    }
    return replace(sample, **filtered)


def measure_mitsuba(
    scene: Scene, assets: Assets, reference: LinearSample, *, denoise: bool
) -> tuple[float, float, int, bool]:
    """Doubles the samples per pixel (spp) until the error is at most TARGET_ERROR, or a run would
    exceed MAX_CPU_S.

    Returns:
        The CPU-seconds, the last error, the last spp, and whether TARGET_ERROR was not reached. In
            this case, the
        seconds are extrapolated to TARGET_ERROR without the denoiser, and those of the last run
            with it.
    """
    samples = 4
    trace(scene, assets, noise_threshold=0, max_samples=samples)  # compiles the kernels
    while True:
        start = time.process_time()
        traced = trace(scene, assets, noise_threshold=0, max_samples=samples)
        traced = denoised(traced) if denoise else traced
        spent = time.process_time() - start
        error = relative_error(traced, reference)
        if error <= TARGET_ERROR:
            return spent, error, samples, False
        if 2 * spent > MAX_CPU_S:
            return spent if denoise else spent * error / TARGET_ERROR, error, samples, True
        samples *= 2


def compare_costs() -> None:
    """Prints one row for each scene, with and without the denoiser of Mitsuba."""
    assets = Assets()
    print(
        "| scene | analytic: relMSE | analytic: CPU-s | "
        "Mitsuba: variant | Mitsuba: relMSE | Mitsuba: CPU-s | ratio of CPU-s |\n"
        "|---|---|---|---|---|---|---|"
    )
    for name, scene in SCENES.items():
        reference = render_reference(scene, assets)
        render(scene, assets)  # warm-up: loads the maps
        start = time.process_time()
        ours = render(scene, assets)
        spent = time.process_time() - start
        error = relative_error(ours, reference)
        for denoise in (False, True):
            theirs, reached, spp, is_unreached = measure_mitsuba(
                scene, assets, reference, denoise=denoise
            )
            variant = f"{spp} spp" + (" + OIDN" if denoise else "")
            bound = "> " if is_unreached and denoise else ""
            cost = f"{bound}{theirs:.1f}" + (
                " (extrapolated)" if is_unreached and not denoise else ""
            )
            print(
                f"| {name} | {error:.1e} | {spent:.3f} | {variant} | {reached:.1e} | {cost} "
                f"| {bound}{theirs / spent:.0f} |",
                flush=True,
            )


def cost_per_sample() -> None:
    """Prints CPU-seconds per stored sample of 512x384, which must not depend on the number of
    samples.
    """
    recipe = read_scene_recipe("window")
    print("| samples | CPU-s per sample |\n|---|---|")
    for count in (10, 30, 90):
        with tempfile.TemporaryDirectory() as folder:
            job = RenderJob(Path(folder) / "set", recipe, builtin_catalog(), 7, "analytic", ())
            start = time.process_time()
            build(
                job,
                range(count),
                SerialExecutor(partial(TaskRunner, job)),
                shards=False,
                report=lambda _: None,
            )
            print(f"| {count} | {(time.process_time() - start) / count:.2f} |", flush=True)


def cost_by_method(data: Path, count: int = 60) -> None:
    """Prints CPU-seconds per sample of 512x384 of the recipe of the paper, by the method that
    renders the scene.

    The scenes show the maps and photos of the folder `data`. All files of a sample are encoded.
    """
    recipe = read_scene_recipe(str(PAPER_RECIPE))
    camera = recipe.camera.model_copy(update={"width": 512, "height": 384})
    recipe = recipe.model_copy(update={"camera": camera})
    maps = data / "hdri"
    photos = data / "photos/permissive"
    assets = Assets([maps, photos])
    catalog, _ = read_catalog([maps], [photos])
    seconds: defaultdict[str, list[float]] = defaultdict(list)
    for index in range(count):
        scene = draw(recipe, catalog, 7, index)
        start = time.process_time()
        encode_sample(render(scene, assets), "analytic")
        if scene.glass.is_rough:
            method = "rough glass"
        elif needs_monte_carlo(scene):
            method = "lens and near content"
        else:
            method = "pinhole or blur of content at infinity"
        seconds[method].append(time.process_time() - start)
    print("| method | samples | CPU-s per sample |\n|---|---|---|")
    for method, spent in [
        *seconds.items(),
        ("all", [s for values in seconds.values() for s in values]),
    ]:
        print(f"| {method} | {len(spent)} | {sum(spent) / len(spent):.2f} |", flush=True)


def main(data: Path) -> None:
    """Prints all tables. Uses one thread."""
    torch.set_num_threads(1)
    cost_by_method(data)
    compare_costs()
    cost_per_sample()


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
