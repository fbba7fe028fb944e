"""Compares the analytic renderer with Mitsuba's scalar variant, which runs wherever Mitsuba can be
imported.
"""

import pytest
import torch

from brewster.render.analytic import render
from brewster.render.mitsuba import renderer
from brewster.render.mitsuba.variant import VariantProbe
from synthetic_scenes import ASSETS, camera_towards_glass, make_scene, plane_side

pytestmark = pytest.mark.filterwarnings("ignore:no LLVM works:RuntimeWarning")

SCENE = make_scene(
    camera=camera_towards_glass(25, 5, width=16, height=16, fov_deg=12),
    panes=[{"thickness_mm": 12.0, "absorption_per_m": (20.0, 5.0, 30.0)}],
    behind=plane_side("mottled", width_mm=900),
    front=plane_side("mottled", width_mm=400, offset_mm=(420.0, 0.0)),
    samples_per_pixel=64,
)
RUNS = 4


@pytest.fixture(scope="module")
def traced_layers(mitsuba):
    """Independent images of every layer, (RUNS, 3, H, W) each; their standard deviation estimates
    the noise.
    """
    seeds = [SCENE.model_copy(update={"seed": seed}) for seed in range(RUNS)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(renderer, "probe", lambda: VariantProbe("scalar_rgb"))
        samples = [
            renderer.trace(scene, ASSETS, noise_threshold=0.02, max_samples=512).images()
            for scene in seeds
        ]
    return {name: torch.stack([sample[name] for sample in samples]).double() for name in samples[0]}


@pytest.mark.parametrize("layer", ["photo", "transmission", "background", "reflection", "mirror"])
def test_the_analytic_renderer_and_mitsuba_render_the_same_image(traced_layers, layer):
    """The mean error is at most 1.3 times the noise plus 1 % of the mean light; the means differ by
    at most 1.5 %.
    """
    analytic = render(SCENE, ASSETS).images()[layer].double()
    mitsuba = traced_layers[layer].mean(0)
    noise = traced_layers[layer].std(0) / RUNS**0.5
    light = float(mitsuba.mean())
    assert float((analytic - mitsuba).abs().mean()) < 1.3 * float(noise.mean()) + 0.01 * light
    assert analytic.mean((1, 2)).tolist() == pytest.approx(mitsuba.mean((1, 2)).tolist(), rel=0.015)
