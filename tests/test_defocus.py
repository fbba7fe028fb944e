"""Defocus at infinity: the convolution equals Monte Carlo integration."""

import math

import pytest
import torch

from brewster.render.analytic import render
from brewster.render.rays.defocus import defocus_blur, margin_px
from brewster.scene.camera import Camera
from synthetic_scenes import ASSETS, camera_towards_glass, centroid, make_scene, map_side, plane_side


def lens_camera(aperture_mm, focus_mm=500.0, **more):
    return Camera(
        **{"width": 32, "height": 32, "fov_deg": 40, **more}, aperture_mm=aperture_mm, focus_mm=focus_mm
    )


@pytest.mark.parametrize("aperture_mm", [20.0, 55.0, 100.0])
def test_a_point_is_blurred_to_a_disc_of_radius_aperture_over_twice_the_focus_distance(aperture_mm):
    camera = lens_camera(aperture_mm)
    margin, radius = margin_px(camera), aperture_mm / (2 * 500) / camera.pixel_rad
    point = torch.zeros(1, 32 + 2 * margin, 32 + 2 * margin)
    point[0, margin + 14, margin + 18] = 1
    image = defocus_blur(point, camera, margin)
    assert float(image.sum()) == pytest.approx(1, abs=1e-5)
    assert centroid(image) == pytest.approx((18.5, 14.5), abs=1e-4)
    assert float(1 / image.max()) == pytest.approx(math.pi * radius**2, rel=0.05)
    x = torch.arange(32) - 18
    variance = float((image[0].sum(0) * x**2).sum())
    variance_of_disc, variance_of_pixel = radius**2 / 4, 1 / 12
    assert variance == pytest.approx(variance_of_disc + variance_of_pixel, abs=0.06)
    assert float(image[0, 14, x.abs() > radius + 1].max()) < 1e-6


def test_light_outside_the_image_is_blurred_into_it():
    """Light beyond the right edge reaches the image up to a distance of the disc's radius."""
    camera = lens_camera(60.0)
    margin = margin_px(camera)
    image = torch.zeros(1, 32 + 2 * margin, 32 + 2 * margin)
    image[:, :, margin + 32 :] = 1
    row = defocus_blur(image, camera, margin)[0, 16]
    assert 0.3 < row[31] < 0.5
    assert row[: 32 - margin].max() < 1e-6


@pytest.mark.parametrize("incidence_deg", [0, 30])
def test_defocus_by_convolution_equals_monte_carlo_integration(incidence_deg):
    """A tiny wedge makes the renderer use Monte Carlo integration."""
    camera = camera_towards_glass(incidence_deg, aperture_mm=40, focus_mm=800, fov_deg=40)
    sides = {"behind": map_side("soft", heading_deg=60), "front": map_side("soft")}
    by_convolution, by_monte_carlo = (
        render(make_scene(camera, [{"wedge_deg": wedge_deg}], **sides, samples_per_pixel=196), ASSETS)
        for wedge_deg in (0.0, 1e-9)
    )
    for name in ("background", "transmission", "mirror", "reflection"):
        max_error = 0.01 if name == "reflection" else 3e-3
        convolved, integrated = getattr(by_convolution, name), getattr(by_monte_carlo, name)
        assert float(((convolved - integrated).abs() / convolved.mean()).max()) < max_error, name
        assert float(convolved.mean()) == pytest.approx(float(integrated.mean()), rel=2e-3)


def test_a_near_picture_is_sharp_in_the_focus_plane():
    line = plane_side("line", distance_mm=504, width_mm=1600)
    cameras = [camera_towards_glass(0, aperture_mm=60, focus_mm=focus_mm) for focus_mm in (650, 1004, 3500)]
    scenes = [make_scene(camera, behind=line, samples_per_pixel=64) for camera in cameras]
    peaks = [float(render(scene, ASSETS).background.mean((0, 1)).max()) for scene in scenes]
    assert peaks[1] > 1.1 * max(peaks[0], peaks[2])
