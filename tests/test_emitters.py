"""Importance sampling of maps: samples follow the luminance, and the density matches the samples."""

import math

import pytest
import torch

from brewster.render.rays.emitters import (
    CameraView,
    EnvmapDistribution,
    Rays,
    SideEmitters,
    direction_to_uv,
    uv_to_direction,
)
from synthetic_scenes import ASSETS, map_side

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
    directions = uv_to_direction(u[None].expand(HEIGHT, -1), v[:, None].expand(-1, 2 * HEIGHT), u_offset)
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
    assert [float(direction_to_uv(d[:, None], 0.5)[0]) for d in (ahead, right)] == pytest.approx([0.5, 0.75])
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
    cell = (v * HEIGHT).long().clamp(max=HEIGHT - 1) * 2 * HEIGHT + (u * 2 * HEIGHT).long() % (2 * HEIGHT)
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
