"""Rough glass: energy, blur, the smooth limit, and agreement of the sampling strategies, also of
light.
"""

import math

import numpy as np
import pytest
import torch

from brewster.render.analytic import render
from brewster.render.rays import rough_glass
from brewster.render.rays.emitters import (
    CameraView,
    EnvmapDistribution,
    Rays,
    SideEmitters,
    direction_to_uv,
    uv_to_direction,
)
from brewster.render.rays.layered_glass import total_throughput, truncated_throughput
from brewster.render.rays.rough_glass import (
    sample_visible_normal,
    smith_g1,
    surfaces,
    vndf_over_cosine,
)
from brewster.render.scene.glass import Glazing, Pane
from synthetic_scenes import (
    ASSETS,
    camera_towards_glass,
    make_scene,
    map_side,
    plane_side,
    smooth_map,
)


def rough_scene(alpha, count=1, samples_per_pixel=16, **more):
    values = {"camera": camera_towards_glass(20), "panes": [{"roughness": alpha}] * count, **more}
    return make_scene(**values, samples_per_pixel=samples_per_pixel)


def mean(image):
    return float(image.mean())


def test_smooth_glass_is_the_limit_of_rough_glass():
    sides = {"behind": map_side("soft", heading_deg=50), "front": map_side("soft")}
    smooth, nearly_smooth = (
        render(rough_scene(alpha, samples_per_pixel=64, **sides), ASSETS) for alpha in (0.0, 1e-3)
    )
    assert mean(nearly_smooth.transmission) == pytest.approx(mean(smooth.transmission), rel=2e-3)
    assert mean(nearly_smooth.reflection) == pytest.approx(mean(smooth.reflection), rel=5e-3)


@pytest.mark.parametrize(("alpha", "count"), [(0.02, 1), (0.05, 1), (0.05, 2)])
def test_in_uniform_light_rough_glass_creates_no_light_and_loses_little(alpha, count):
    sample = render(rough_scene(alpha, count, samples_per_pixel=16), ASSETS)
    total = mean(sample.transmission) + mean(sample.reflection)
    assert 0.985 < total < 1.003
    smooth = total_throughput(Glazing(panes=(Pane(),) * count, gap_mm=9), torch.tensor(0.94))
    assert mean(sample.reflection) == pytest.approx(float(smooth.reflectance), rel=0.05)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("orders", ["all", "truncated"])
@pytest.mark.parametrize(("kind", "samples"), [({"wedge_deg": 1e-9}, 1), ({"roughness": 1e-3}, 4)])
def test_traced_layers_have_the_orders_of_the_closed_form(orders, count, kind, samples):
    """A wedge or a roughness that is too small to matter: each order is traced. With roughness,
    rays of small weight end at random.
    """
    scene = make_scene(
        camera_towards_glass(30, fov_deg=1, width=16, height=16),
        [{**kind, "absorption_per_m": (4.0, 1.5, 20.0)}] * count,
        orders=orders,
        samples_per_pixel=samples,
    )
    sample = render(scene, ASSETS)
    closed = total_throughput if orders == "all" else truncated_throughput
    expected = closed(scene.glass, torch.tensor(math.cos(math.radians(30))))
    for layer, share in zip((sample.transmission, sample.reflection), expected, strict=True):
        assert layer.mean((1, 2)).tolist() == pytest.approx(share.expand(3).tolist(), rel=0.02)


def test_rough_glass_with_index_one_is_invisible():
    side = map_side("mottled")
    panes = [{"roughness": 0.2, "refractive_index": 1.0}] * 2
    scene = make_scene(None, panes, behind=side, front=side, samples_per_pixel=1)
    sample = render(scene, ASSETS)
    torch.testing.assert_close(sample.photo, sample.background, rtol=1e-4, atol=1e-4)
    assert not sample.reflection.any()


def test_rougher_glass_blurs_an_edge_behind_it_more():
    steepness = []
    for alpha in (0.01, 0.05, 0.15):
        view = {
            "camera": camera_towards_glass(0, fov_deg=60),
            "behind": map_side("right", heading_deg=180),
        }
        scene = rough_scene(alpha, samples_per_pixel=8, **view)
        columns = render(scene, ASSETS).transmission.mean((0, 1))
        steepness.append(float(columns.diff().max()))
    assert steepness[0] > 1.2 * steepness[1] > 1.5 * steepness[2]


@pytest.mark.parametrize(
    ("alpha", "radius_mm"), [(0.1, float("inf")), (0.3, 2500.0)], ids=["far", "dome"]
)
def test_light_sampling_does_not_change_the_mean(monkeypatch, alpha, radius_mm):
    """The same light with a smooth gradient surrounds the glass on both sides."""
    side = map_side("soft", heading_deg=30, radius_mm=radius_mm)
    scene = rough_scene(alpha, samples_per_pixel=32, behind=side, front=side)
    combined = render(scene, ASSETS)
    monkeypatch.setattr(rough_glass, "_MIN_LIGHT_SAMPLING_WEIGHT", 2.0)
    facets_only = render(scene, ASSETS)
    assert not torch.equal(combined.photo, facets_only.photo)
    assert mean(combined.photo) == pytest.approx(mean(facets_only.photo), rel=5e-3)
    assert mean(combined.transmission) == pytest.approx(mean(facets_only.transmission), rel=5e-3)
    # The reflection is a small part of the light, so its mean has more noise.
    assert mean(combined.reflection) == pytest.approx(mean(facets_only.reflection), rel=0.02)


def test_a_plane_hides_the_light_samples_behind_it(monkeypatch):
    """A black plane with its edge in the view, in front of a map."""
    ASSETS.pictures["black"] = 0 * smooth_map(16)
    plane = plane_side("black", width_mm=600).plane
    side = map_side("soft").model_copy(update={"plane": plane})
    scene = rough_scene(0.2, samples_per_pixel=32, camera=camera_towards_glass(0), behind=side)
    combined = render(scene, ASSETS).transmission
    monkeypatch.setattr(rough_glass, "_MIN_LIGHT_SAMPLING_WEIGHT", 2.0)
    facets_only = render(scene, ASSETS).transmission
    assert not torch.equal(combined, facets_only)
    assert mean(combined) == pytest.approx(mean(facets_only), rel=0.02)


def test_light_sampling_halves_the_noise_of_a_small_sun_in_frosted_glass(monkeypatch):
    ASSETS.pictures["lamp"] = smooth_map(64) * 0.02
    ASSETS.pictures["lamp"][30:32, :2] += 500
    view = {"camera": camera_towards_glass(0), "behind": map_side("lamp", heading_deg=5)}
    scene = rough_scene(0.2, samples_per_pixel=16, **view)
    combined = render(scene, ASSETS).transmission
    monkeypatch.setattr(rough_glass, "_MIN_LIGHT_SAMPLING_WEIGHT", 2.0)
    facets_only = render(scene, ASSETS).transmission
    assert mean(combined) == pytest.approx(mean(facets_only), rel=0.1)

    def relative_noise(image):
        return float(image.diff(dim=2).abs().mean() / image.mean())

    assert relative_noise(combined) < relative_noise(facets_only) / 2


def test_visible_normals_are_sampled_with_their_density():
    """The mean of 1 / density over the samples in a cap of normals is the cap's solid angle."""
    generator = torch.Generator().manual_seed(1)
    for alpha in (0.1, 0.4):
        wi = torch.tensor([[0.6], [0.0], [0.8]]).expand(3, 200_000)
        facet = sample_visible_normal(wi, alpha, torch.rand(2, 200_000, generator=generator))
        cosine = (facet * wi).sum(0).clamp(min=0)
        density = vndf_over_cosine(wi, facet, alpha) * cosine
        is_inside = facet[2] > 0.95
        assert float((is_inside / density).mean()) == pytest.approx(2 * np.pi * 0.05, rel=0.02)
        assert facet.norm(dim=0) == pytest.approx(1, abs=1e-5)


def test_smith_g1_is_one_at_normal_incidence_and_falls_towards_grazing_angles():
    normal, oblique, grazing = smith_g1(torch.tensor([1.0, 0.5, 0.05]), 0.4)
    assert float(normal) == 1
    assert 1 > float(oblique) > float(grazing) > 0


def test_the_first_surface_is_the_one_nearest_to_the_camera():
    glass = Glazing(panes=(Pane(thickness_mm=4), Pane(thickness_mm=6, wedge_deg=1)), gap_mm=10)
    stack = surfaces(glass, torch.zeros(1))
    assert [surface.height_mm for surface in stack] == [0, -4, -14, -20]
    assert [surface.glass_is_below for surface in stack] == [True, False, True, False]
    assert float(stack[3].axes[2, 2]) == pytest.approx(np.cos(np.radians(1)))
    assert float(stack[2].axes[2, 2]) == 1


AHEAD = torch.tensor([0.0, 0.0, -1.0])
HEIGHT = 32


def uniforms(count, seed=0):
    return torch.rand(2, count, generator=torch.Generator().manual_seed(seed))


def random_map(seed=1):
    return torch.rand(3, HEIGHT, 2 * HEIGHT, generator=torch.Generator().manual_seed(seed)) ** 4


def texel_directions(u_offset):
    """Directions of the centres of all texels, (3, H * 2 H), and their solid angles, (H * 2 H,)."""
    v = (torch.arange(HEIGHT) + 0.5) / HEIGHT
    u = (torch.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT)
    edges = torch.cos(torch.arange(HEIGHT + 1) / HEIGHT * math.pi)
    solid_angle = (edges[:-1] - edges[1:]) * math.pi / HEIGHT
    directions = uv_to_direction(
        u[None].expand(HEIGHT, -1), v[:, None].expand(-1, 2 * HEIGHT), u_offset
    )
    return directions.reshape(3, -1), solid_angle[:, None].expand(-1, 2 * HEIGHT).reshape(-1)


def make_emitters(side, behind=True):
    view = CameraView(height_mm=1000.0, pixel_rad=0.01, aperture_mm=0.0, focus_mm=3000.0)
    return SideEmitters(side, ASSETS, view, behind=behind, to_world=torch.eye(3), device="cpu")


def test_texture_coordinates_and_directions_are_inverse():
    u, v = uniforms(500) * 0.98 + 0.01
    for u_offset in (0.0, 0.3, -0.8):
        again = direction_to_uv(uv_to_direction(u, v, u_offset), u_offset)
        torch.testing.assert_close(again, (u, v), atol=1e-4, rtol=0)
    ahead, right, up = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, 1, 0]])
    assert [float(direction_to_uv(d[:, None], 0.5)[0]) for d in (ahead, right)] == pytest.approx(
        [0.5, 0.75]
    )
    assert float(direction_to_uv(up[:, None], 0.0)[1]) == pytest.approx(0, abs=1e-3)


def test_no_direction_is_sampled_on_the_other_side_of_the_glass():
    outward = torch.tensor([0.6, 0.0, 0.8])
    distribution = EnvmapDistribution(random_map(), outward, 0.2)
    sampled = distribution.sample(uniforms(5000), 0.2)
    assert float((outward @ sampled).min()) > -0.05 - math.pi / HEIGHT
    assert (distribution.pdf(*direction_to_uv(sampled, 0.2)) > 0).all()
    assert float(distribution.pdf(*direction_to_uv(-outward[:, None], 0.2))) == 0
    black = EnvmapDistribution(torch.zeros(3, HEIGHT, 2 * HEIGHT), AHEAD, 0.0)
    assert torch.isfinite(black.sample(uniforms(100), 0.0)).all()


@pytest.mark.parametrize("u_offset", [0.0, -0.25])
def test_the_density_matches_the_frequency_of_samples(u_offset):
    distribution = EnvmapDistribution(random_map(), AHEAD, u_offset)
    count = 400_000
    sampled = distribution.sample(uniforms(count), u_offset)
    u, v = direction_to_uv(sampled, u_offset)
    cell = (v * HEIGHT).long().clamp(max=HEIGHT - 1) * 2 * HEIGHT + (u * 2 * HEIGHT).long() % (
        2 * HEIGHT
    )
    counts = torch.bincount(cell, minlength=2 * HEIGHT**2)
    directions, solid_angle = texel_directions(u_offset)
    expected = distribution.pdf(*direction_to_uv(directions, u_offset)) * solid_angle * count
    is_frequent = expected > 20
    chi_squared = ((counts - expected) ** 2 / expected.clamp(min=1))[is_frequent].mean()
    assert float(chi_squared) == pytest.approx(1, abs=0.15)
    assert float(distribution.pdf(u, v).min()) > 0


@pytest.mark.parametrize("radius_mm", [math.inf, 1500.0], ids=["far", "dome"])
@pytest.mark.parametrize("behind", [True, False])
def test_the_mean_of_one_over_the_density_is_the_solid_angle(radius_mm, behind):
    """A cone of half-angle 60 degrees has a solid angle of pi, from any point inside a dome."""
    emitters = make_emitters(map_side("soft", radius_mm=radius_mm, heading_deg=25), behind)
    origin = torch.tensor([[300.0], [-200.0], [0.0]]).expand(3, 200_000)
    samples = emitters.sample_map(uniforms(200_000)[0], 1.0)
    direction, radiance, pdf = emitters.towards(samples, Rays(origin, origin, 1.0))
    outward = -direction[2] if behind else direction[2]
    is_inside = outward > 0.5
    assert float((is_inside / pdf.clamp(min=1e-9)).mean()) == pytest.approx(math.pi, rel=0.01)
    torch.testing.assert_close(direction.norm(dim=0), torch.ones(200_000))
    expected_radiance, expected_pdf = emitters.radiance_and_pdf(Rays(origin, direction, 1.0))
    torch.testing.assert_close(radiance, expected_radiance, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(pdf, expected_pdf)
