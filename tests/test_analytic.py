"""The analytic renderer: layers add up and match closed forms; geometry of objects; defocus by
convolution.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from brewster.errors import RecipeError
from brewster.render import analytic
from brewster.render.analytic import render
from brewster.render.rays.defocus import defocus_blur, margin_px
from brewster.render.rays.layered_glass import total_throughput, truncated_throughput
from brewster.render.scene.camera import Camera, axes
from brewster.render.scene.glass import Glazing, Pane
from brewster.render.scene.world import Side
from synthetic_scenes import (
    ASSETS,
    SyntheticAssets,
    camera_towards_glass,
    centroid,
    make_scene,
    map_side,
    map_with_bright_texel,
    pixel_directions,
    plane_side,
    random_scenes,
)

without_shrinking = settings(phases=[Phase.explicit, Phase.generate], deadline=None, database=None)
examples_25, examples_10 = (settings(without_shrinking, max_examples=count) for count in (25, 10))
UNIFORM_SIDES = {"far": map_side(), "dome": map_side(radius_mm=3000.0), "near": plane_side()}


def closed_form(scene, throughput_of=total_throughput):
    """Transmittance and reflectance at the centre of every pixel, (3, H, W) or (1, H, W)."""
    cosine = torch.from_numpy(-pixel_directions(scene.camera) @ np.array([0, 0, 1]))
    throughput = throughput_of(scene.glass, cosine)
    layers = throughput.transmittance, throughput.reflectance
    return [layer.reshape(-1, *cosine.shape).float() for layer in layers]


@examples_25
@given(random_scenes(orders="all"))
def test_the_photo_is_the_sum_of_its_two_layers(scene):
    sample = render(scene, ASSETS)
    layers = sample.images().values()
    assert all(layer.shape == (3, 16, 16) and layer.dtype == torch.float32 for layer in layers)
    assert all(torch.isfinite(layer).all() and (layer >= 0).all() for layer in layers)
    total = sample.transmission + sample.reflection
    atol = 1e-7 * float(sample.photo.max())
    torch.testing.assert_close(total, sample.photo, rtol=1e-6, atol=atol)


@examples_10
@given(random_scenes(orders="all"))
def test_the_choice_of_orders_changes_the_layers_and_not_the_photo(scene):
    complete, truncated = (
        render(scene.model_copy(update={"orders": orders}), ASSETS)
        for orders in ("all", "truncated")
    )
    for name in ("photo", "background", "mirror"):
        assert torch.equal(getattr(complete, name), getattr(truncated, name))
    tolerance = 1e-6 * float(complete.photo.max()) + 1e-9
    for name in ("transmission", "reflection"):
        assert (getattr(truncated, name) <= getattr(complete, name) + tolerance).all()
    is_dark = not scene.front.map and not scene.front.plane
    assert is_dark or truncated.reflection.sum() < complete.reflection.sum()


@examples_10
@given(random_scenes(front=Side()), random_scenes(behind=Side(), orders="all"))
def test_without_light_in_front_or_behind_there_is_no_reflection_or_nothing_else(
    dark_in_front, dark_behind
):
    sample = render(dark_in_front, ASSETS)
    assert not sample.reflection.any()
    assert not sample.mirror.any()
    sample = render(dark_behind, ASSETS)
    assert not sample.transmission.any()
    assert not sample.background.any()
    assert torch.equal(sample.photo, sample.reflection)


@pytest.mark.parametrize("side", ["far", "dome", "near"])
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("aperture_mm", [0.0, 20.0])
def test_glass_with_index_one_is_invisible(side, count, aperture_mm):
    sides = {"far": map_side("mottled"), "dome": map_side("mottled", radius_mm=2000.0)}
    sides["near"] = plane_side("mottled", width_mm=500)
    camera = camera_towards_glass(15, 5, aperture_mm=aperture_mm)
    panes = [{"refractive_index": 1.0, "thickness_mm": 20.0}] * count
    scene = make_scene(camera, panes, behind=sides[side], front=sides[side], samples_per_pixel=4)
    sample = render(scene, ASSETS)
    torch.testing.assert_close(sample.transmission, sample.background, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(sample.photo, sample.background, rtol=1e-4, atol=1e-4)
    assert sample.mirror.any()
    assert not sample.reflection.any()


@pytest.mark.parametrize("side", sorted(UNIFORM_SIDES))
@pytest.mark.parametrize("aperture_mm", [0.0, 20.0])
@pytest.mark.parametrize("orders", ["all", "truncated"])
def test_in_uniform_light_every_pixel_equals_the_closed_form(side, aperture_mm, orders):
    first = {"thickness_mm": 6.0, "absorption_per_m": (4.0, 1.5, 20.0)}
    panes = [first, {"refractive_index": 1.7, "absorption_per_m": (2.0, 9.0, 1.0)}]
    camera = camera_towards_glass(30, aperture_mm=aperture_mm, focus_mm=800)
    sides = dict.fromkeys(("behind", "front"), UNIFORM_SIDES[side])
    scene = make_scene(camera, panes, **sides, orders=orders, samples_per_pixel=16)
    sample = render(scene, ASSETS)
    closed = total_throughput if orders == "all" else truncated_throughput
    transmittance, reflectance = closed_form(scene, closed)
    torch.testing.assert_close(sample.transmission, transmittance, rtol=2e-3, atol=0)
    torch.testing.assert_close(sample.reflection, reflectance, rtol=1e-2, atol=0)
    assert float(sample.reflection.mean() / reflectance.mean()) == pytest.approx(1, abs=2e-3)
    for layer in (sample.background, sample.mirror):
        torch.testing.assert_close(layer, torch.ones_like(layer), rtol=1e-5, atol=0)


def test_far_light_has_no_ghost_in_parallel_glass():
    """R is MR times a factor that depends on the angle only: all orders leave in one direction."""
    camera = camera_towards_glass(40, 10, width=25, height=25)
    sides = {"front": map_side("mottled"), "behind": map_side("mottled", heading_deg=90)}
    scene = make_scene(camera, [{"thickness_mm": 30.0}, {}], **sides, samples_per_pixel=1)
    sample = render(scene, ASSETS)
    transmittance, reflectance = closed_form(scene)
    torch.testing.assert_close(sample.reflection, sample.mirror * reflectance, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(
        sample.transmission, sample.background * transmittance, rtol=1e-4, atol=1e-7
    )


def test_content_behind_a_thick_pane_appears_nearer_by_a_third_of_its_thickness():
    """The image's area grows by (distance / (distance - t (1 - 1 / n)))^2."""
    scene = make_scene(
        camera=camera_towards_glass(0, distance_mm=1000, fov_deg=10, width=48, height=48),
        panes=[{"thickness_mm": 90.0}],
        behind=plane_side("mottled", distance_mm=500, width_mm=100),
        orders="truncated",
    )
    sample = render(scene, ASSETS)
    area_ratio = float(sample.transmission.sum() / sample.background.sum()) / 0.96**2
    assert area_ratio == pytest.approx((1500 / 1470) ** 2, rel=2e-3)


@pytest.mark.parametrize("wedge_deg", [2.0, -2.0])
def test_a_wedge_deflects_rays_by_half_its_angle_towards_its_thick_side(wedge_deg):
    """With a positive angle, the right side is thick: the camera sees there what is farther right,
    so that everything moves to the left.
    """
    light = SyntheticAssets(sun=map_with_bright_texel(256, 128, 0))
    options = {"behind": map_side("sun"), "orders": "truncated", "samples_per_pixel": 64}
    sample = render(make_scene({"fov_deg": 10}, [{"wedge_deg": wedge_deg}], **options), light)
    (deflected_x, _), (straight_x, _) = centroid(sample.transmission), centroid(sample.background)
    assert (deflected_x - straight_x) * 10 / 24 == pytest.approx(-wedge_deg / 2, rel=0.03)


def test_the_right_half_of_a_map_appears_on_the_right_and_a_mirror_exchanges_the_sides():
    scenes = [make_scene(behind=map_side(name, heading_deg=180)) for name in ("right", "top")]
    right, top = (render(scene, ASSETS).background for scene in scenes)
    assert right[:, :, 15:].min() == top[:, :9].min() == 1
    assert right[:, :, :9].max() == top[:, 15:].max() == 0
    mirror = render(make_scene(front=map_side("right", heading_deg=0)), ASSETS).mirror
    assert (mirror[:, :, :9].min(), mirror[:, :, 15:].max()) == (1, 0)


@pytest.mark.parametrize("heading_deg", [0, 90, -120])
def test_a_camera_that_turns_right_sees_a_map_move_left(heading_deg):
    """A camera with the sun's heading sees it in the centre; a turn of 5 degrees moves it by 4
    pixels.
    """
    light = SyntheticAssets(sun=map_with_bright_texel(64, 32, 0))
    glass = Glazing(heading_deg=heading_deg)
    positions = []
    for rotation_deg in (0, 5):
        camera = camera_towards_glass(heading_deg + rotation_deg, fov_deg=30)
        sun = map_side("sun", heading_deg=heading_deg)
        scene = make_scene(camera, glass=glass, behind=sun, samples_per_pixel=16)
        positions.append(centroid(render(scene, light).background))
    half_texel = 360 / 128 / 2
    pixels_per_degree = 24 / math.degrees(2 * math.tan(math.radians(15)))
    assert positions[0][0] == pytest.approx(12 + half_texel * pixels_per_degree, abs=0.1)
    assert positions[0][1] == pytest.approx(12 + half_texel * pixels_per_degree, abs=0.1)
    assert positions[0][0] - positions[1][0] == pytest.approx(5 * pixels_per_degree, rel=0.03)


def test_a_picture_in_front_of_the_glass_is_mirrored_and_one_behind_it_is_not():
    picture = np.zeros((32, 32, 3), np.float32)
    picture[:8, 24:] = 1  # the upper right corner
    scene = make_scene(
        behind=plane_side("corner", width_mm=300), front=plane_side("corner", width_mm=300)
    )
    sample = render(scene, SyntheticAssets(corner=picture))
    x, y = centroid(sample.background)
    assert x > 14
    assert y < 10
    mirrored_x, mirrored_y = centroid(sample.reflection)
    assert mirrored_x == pytest.approx(24 - x, abs=0.05)
    assert mirrored_y == pytest.approx(y, abs=0.05)


PLANE_POSITIONS = st.fixed_dictionaries(
    {
        "distance_mm": st.floats(100, 3000),
        "offset": st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)),
        # with the camera, no plane is seen edge-on
        "angles_deg": st.tuples(st.floats(-40, 40), st.floats(-20, 20)),
        "glass_deg": st.tuples(st.floats(-180, 180), st.floats(-20, 20)),
        "camera_deg": st.tuples(st.floats(-30, 30), st.floats(-10, 10)),
        "is_behind": st.booleans(),
    }
)


def projected(scene, point, to_glass):
    """Projects a point in the glass frame into a pinhole camera. Returns x and y in pixels."""
    in_world = (
        point @ to_glass + np.array(scene.glass.position_mm) - np.array(scene.camera.position_mm)
    )
    right, up, back = map(np.array, axes(scene.camera.heading_deg, scene.camera.pitch_deg))
    scale = scene.camera.width / 2 / scene.camera.half_width / -(in_world @ back)
    return (
        scene.camera.width / 2 + in_world @ right * scale,
        scene.camera.height / 2 - in_world @ up * scale,
    )


@examples_25
@given(PLANE_POSITIONS)
def test_a_plane_appears_where_pinhole_geometry_projects_it(drawn):
    """The centroid of a small plane, or of its mirror image if the plane is in front."""
    heading, pitch = drawn["glass_deg"]
    to_glass = np.array(axes(heading, pitch))
    towards = heading + drawn["camera_deg"][0], pitch + drawn["camera_deg"][1]
    camera = camera_towards_glass(*towards, fov_deg=40, width=48, height=48)
    position = np.array([30.0, -20.0, 70.0])
    camera["position_mm"] = tuple(np.array(camera["position_mm"]) + position)
    glass = Glazing(heading_deg=heading, pitch_deg=pitch, position_mm=tuple(position))
    empty = make_scene(camera, glass=glass)
    eye = to_glass @ (np.array(empty.camera.position_mm) - position)
    distance_mm = drawn["distance_mm"] + 4
    axis = to_glass @ pixel_directions(empty.camera)[23:25, 23:25].mean((0, 1))
    length = (eye[2] + distance_mm) / -axis[2]  # along the axis, from the camera to the plane
    offset = (eye + axis * length)[:2] + np.array(
        drawn["offset"]
    ) * length * empty.camera.half_width
    plane = {"distance_mm": distance_mm, "width_mm": length * 0.06, "offset_mm": tuple(offset)}
    plane |= dict(zip(("heading_deg", "pitch_deg"), drawn["angles_deg"], strict=True))
    which = "behind" if drawn["is_behind"] else "front"
    scene = empty.model_copy(
        update={"behind": Side(), "front": Side(), which: plane_side("square", **plane)}
    )
    sample = render(scene, SyntheticAssets(square=np.ones((16, 16, 3), np.float32)))
    image = sample.background if drawn["is_behind"] else sample.mirror
    position = projected(scene, np.array([*offset, -distance_mm]), to_glass)
    assert centroid(image) == pytest.approx(position, abs=0.25)


@pytest.mark.parametrize("is_behind", [True, False])
def test_a_plane_has_the_size_of_its_pinhole_projection(is_behind):
    which = "behind" if is_behind else "front"
    wide = plane_side("wide", distance_mm=700, width_mm=310)
    scene = make_scene({"width": 40, "height": 40}, **{which: wide})
    sample = render(scene, SyntheticAssets(wide=np.ones((16, 32, 3), np.float32)))
    image = sample.background if is_behind else sample.mirror
    width_px = 310 / 1200 / (2 * math.tan(math.radians(15))) * 40
    assert float(image[0].sum()) == pytest.approx(width_px * width_px / 2, rel=0.01)


@pytest.mark.parametrize("texels", [0.5, 1, 1.3])
def test_a_sun_of_one_texel_does_not_flicker(texels):
    """The sun's energy in the image stays constant while the camera rotates in steps of a tenth of
    a pixel.

    A pixel is `texels` texels wide.
    """
    light = SyntheticAssets(sun=map_with_bright_texel(256, 128, 0))
    fov_deg = 360 / 512 * texels * 32
    energies = []
    for tenth in range(10):
        rotation_deg = tenth / 10 * fov_deg / 32
        camera = camera_towards_glass(
            rotation_deg, rotation_deg / 2, fov_deg=fov_deg, width=32, height=32
        )
        sample = render(
            make_scene(camera=camera, behind=map_side("sun"), samples_per_pixel=36), light
        )
        energies.append(float(sample.background.sum()))
    assert max(energies) / min(energies) < 1.01


SCENE_KINDS = {
    "far": {"front": map_side("soft")},
    "near": {"front": map_side("soft", radius_mm=3000.0), "behind": plane_side("mottled")},
    "lens": {"front": map_side("soft", radius_mm=3000.0), "camera": {"aperture_mm": 10}},
    "wedge": {"front": map_side("soft"), "panes": [{"wedge_deg": 0.5}]},
    "rough": {"front": map_side("soft"), "panes": [{"roughness": 0.1}]},
}


@pytest.mark.parametrize("kind", sorted(SCENE_KINDS))
def test_the_result_does_not_depend_on_the_batch_size(kind, monkeypatch):
    one_batch = render(make_scene(**SCENE_KINDS[kind], samples_per_pixel=4), ASSETS)
    monkeypatch.setattr(analytic, "_CPU_BATCH_RAYS", 100)
    many_batches = render(make_scene(**SCENE_KINDS[kind], samples_per_pixel=4), ASSETS)
    for first, second in zip(
        one_batch.images().values(), many_batches.images().values(), strict=True
    ):
        # The rays of a batch decide where the tracing of rough glass ends: orders of small mean
        # weight end, and rays of small weight are continued at random. So the batch size changes
        # the result.
        if kind == "rough":
            assert float(first.mean()) == pytest.approx(float(second.mean()), rel=2e-3)
        else:
            torch.testing.assert_close(first, second, rtol=1e-5, atol=1e-6)


def test_another_index_changes_the_random_numbers_and_not_the_means():
    scene = make_scene(panes=[{"wedge_deg": 0.5}], behind=map_side("mottled"), samples_per_pixel=16)
    one, other = (
        render(scene.model_copy(update={"index": index}), ASSETS).background for index in (0, 1)
    )
    assert not torch.equal(one, other)
    assert float(one.mean()) == pytest.approx(float(other.mean()), rel=2e-3)


FRAMED = Glazing(opening_mm=(500.0, 400.0))
CURVED = Glazing(panes=(Pane(thickness_mm=20),), radii_mm=(300.0, -300.0), opening_mm=(80.0, 80.0))


@pytest.mark.parametrize("glass", [FRAMED, CURVED], ids=["framed", "curved"])
def test_framed_and_curved_glass_is_refused_with_a_hint_to_mitsuba(glass):
    with pytest.raises(RecipeError, match="--renderer mitsuba"):
        render(make_scene(glass=glass), ASSETS)


def test_a_dome_and_a_map_at_infinity_agree_when_the_dome_is_large():
    sides = [map_side("soft", radius_mm=radius) for radius in (math.inf, 1e7)]
    far, dome = (
        render(make_scene(camera_towards_glass(20), behind=side), ASSETS) for side in sides
    )
    torch.testing.assert_close(far.transmission, dome.transmission, rtol=1e-3, atol=0)


def test_the_ghost_distance_is_the_formula_in_pixels_and_far_content_has_no_ghost():
    scene = make_scene(
        camera=camera_towards_glass(30, distance_mm=1000 / math.cos(math.radians(30))),
        front=map_side(radius_mm=3000.0),
    )
    inside = math.asin(math.sin(math.radians(30)) / 1.5)
    ghost_mm = 2 * 4 * math.tan(inside) * math.cos(math.radians(30))
    expected = ghost_mm / (scene.camera.pixel_rad * 4000)
    assert analytic.ghost_distance_px(scene) == pytest.approx(expected, rel=1e-3)
    assert analytic.ghost_distance_px(make_scene(camera=camera_towards_glass(30))) == 0


def lens_camera(aperture_mm, focus_mm=500.0, **more):
    return Camera(
        **{"width": 32, "height": 32, "fov_deg": 40, **more},
        aperture_mm=aperture_mm,
        focus_mm=focus_mm,
    )


@pytest.mark.parametrize("aperture_mm", [20.0, 55.0, 100.0])
def test_a_point_is_blurred_to_a_disc_of_radius_aperture_over_twice_the_focus_distance(aperture_mm):
    camera = lens_camera(aperture_mm)
    margin = margin_px(camera)
    radius = aperture_mm / (2 * 500) / camera.pixel_rad
    point = torch.zeros(1, 32 + 2 * margin, 32 + 2 * margin)
    point[0, margin + 14, margin + 18] = 1
    image = defocus_blur(point, camera, margin)
    assert float(image.sum()) == pytest.approx(1, abs=1e-5)
    assert centroid(image) == pytest.approx((18.5, 14.5), abs=1e-4)
    assert float(1 / image.max()) == pytest.approx(math.pi * radius**2, rel=0.05)
    x = torch.arange(32) - 18
    variance = float((image[0].sum(0) * x**2).sum())
    variance_of_disc = radius**2 / 4
    variance_of_pixel = 1 / 12
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
        render(
            make_scene(camera, [{"wedge_deg": wedge_deg}], **sides, samples_per_pixel=196), ASSETS
        )
        for wedge_deg in (0.0, 1e-9)
    )
    for name in ("background", "transmission", "mirror", "reflection"):
        max_error = 0.01 if name == "reflection" else 3e-3
        convolved = getattr(by_convolution, name)
        integrated = getattr(by_monte_carlo, name)
        assert float(((convolved - integrated).abs() / convolved.mean()).max()) < max_error, name
        assert float(convolved.mean()) == pytest.approx(float(integrated.mean()), rel=2e-3)


def test_a_near_picture_is_sharp_in_the_focus_plane():
    line = plane_side("line", distance_mm=504, width_mm=1600)
    cameras = [
        camera_towards_glass(0, aperture_mm=60, focus_mm=focus_mm) for focus_mm in (650, 1004, 3500)
    ]
    scenes = [make_scene(camera, behind=line, samples_per_pixel=64) for camera in cameras]
    peaks = [float(render(scene, ASSETS).background.mean((0, 1)).max()) for scene in scenes]
    assert peaks[1] > 1.1 * max(peaks[0], peaks[2])
