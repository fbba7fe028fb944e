import math

import numpy as np
import pytest

import synthetic_scenes
from brewster.errors import RecipeError
from brewster.render.mitsuba import renderer, variant
from brewster.render.mitsuba.renderer import trace
from brewster.render.mitsuba.scene_builder import MitsubaSceneBuilder, sample_bilinear
from brewster.render.scene.camera import Camera, axes
from brewster.render.scene.glass import Glazing, Pane
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import Side
from synthetic_scenes import SyntheticAssets, map_side

pytestmark = [
    pytest.mark.usefixtures("mitsuba"),
    pytest.mark.filterwarnings("ignore:no LLVM works:RuntimeWarning"),
]

WHITE = np.ones((64, 128, 3), np.float32)
RED_RIGHT = WHITE.copy()
RED_RIGHT[:, 64:, 1:] = 0
RED_TOP = WHITE.copy()
RED_TOP[:32, :, 1:] = 0
RAMP = np.broadcast_to(((np.arange(64, dtype=np.float32) + 0.5) / 64)[:, None], (64, 64, 3))
MOTTLED = np.random.default_rng(3).random((8, 16, 3), np.float32)
IMAGES = {
    "white": WHITE,
    "red right": RED_RIGHT,
    "red top": RED_TOP,
    "ramp": RAMP,
    "mottled": MOTTLED,
}


ASSETS = SyntheticAssets(**IMAGES)


def plane_side(name, **more):
    return synthetic_scenes.plane_side(name, **{"distance_mm": 1000, "width_mm": 1200, **more})


def a_scene(**more):
    camera = {
        "width": 32,
        "height": 32,
        "fov_deg": 20,
        "position_mm": (0, 0, 500),
        **more.pop("camera", {}),
    }
    return Scene(camera=Camera(**camera), **{"behind": map_side(), "front": map_side(), **more})


def traced(scene, **more):
    return trace(scene, ASSETS, **{"noise_threshold": 0.01, "max_samples": 512, **more})


def render_image(scene, side, glass_mode, samples=64):
    """Renders one image (H, W, 3)."""
    mitsuba = variant.load()
    with renderer._active_variant(mitsuba, polarised=False):
        mi_scene = MitsubaSceneBuilder(mitsuba, scene, ASSETS).scene_dict(
            lit_from_behind=side == "behind", glass_mode=glass_mode
        )
        return np.array(mitsuba.render(mitsuba.load_dict(mi_scene), spp=samples))


def test_a_pane_given_twice_is_two_panes():
    pane = Pane()
    mitsuba = variant.load()
    counts = []
    for panes in ((pane, pane.model_copy()), (pane, pane)):
        scene = a_scene(glass=Glazing(panes=panes, gap_mm=12))
        with renderer._active_variant(mitsuba, polarised=False):
            builder = MitsubaSceneBuilder(mitsuba, scene, ASSETS)
            counts.append(
                len(builder.scene_dict(lit_from_behind=False, glass_mode="truncated_reflection"))
            )
    assert counts[0] == counts[1]


def at(heading_deg, distance_mm=500.0):
    """Values of a camera that looks at the glass from this heading, at the same height."""
    heading = math.radians(heading_deg)
    position = -distance_mm * math.sin(heading), 0, distance_mm * math.cos(heading)
    return {"heading_deg": heading_deg, "position_mm": position, "fov_deg": 2}


def pane_reflectances(incidence_deg, index=1.5):
    """Reflectances of one pane for s- and p-polarised light: all orders sum to 2 r / (1 + r)."""
    cosine = math.cos(math.radians(incidence_deg))
    inside = math.sqrt(1 - (1 - cosine**2) / index**2)
    s = ((cosine - index * inside) / (cosine + index * inside)) ** 2
    p = ((index * cosine - inside) / (index * cosine + inside)) ** 2
    return 2 * s / (1 + s), 2 * p / (1 + p)


def test_truncated_layers_are_the_first_reflection_and_the_path_without_reflection():
    sample = traced(a_scene(camera=at(0), orders="truncated"), noise_threshold=0.002)
    assert float(sample.reflection.mean()) == pytest.approx(0.04, rel=0.001)
    assert float(sample.transmission.mean()) == pytest.approx(0.96**2, rel=0.003)


def test_absorption_in_tinted_panes_follows_the_beer_lambert_law():
    panes = (
        Pane(thickness_mm=10, absorption_per_m=(40, 0, 10)),
        Pane(thickness_mm=5, absorption_per_m=(0, 0, 20)),
    )
    scene = a_scene(camera=at(0), glass=Glazing(panes=panes, gap_mm=10))
    light = render_image(scene, "behind", "truncated_transmission")
    np.testing.assert_allclose(light.mean((0, 1)), 0.96**4 * np.exp([-0.4, 0, -0.2]), rtol=0.01)


def test_polarised_light_follows_the_closed_form_at_brewsters_angle(requires_llvm):
    """Mitsuba's colour variants average s and p at each surface, which is wrong by an eighth at
    this angle.
    """
    camera = {**at(56.31), "width": 16, "height": 16}
    sample = traced(a_scene(camera=camera), polarised=True, noise_threshold=0.01)
    s, p = pane_reflectances(56.31)
    assert float(sample.reflection.mean()) == pytest.approx((s + p) / 2, rel=0.02)


def test_s_and_p_light_each_follow_the_closed_form(requires_llvm, mitsuba):
    camera = {**at(56.31), "width": 16, "height": 16}
    with renderer._active_variant(mitsuba, polarised=True):
        mi_scene = MitsubaSceneBuilder(
            mitsuba, a_scene(camera=camera), ASSETS, channel=0
        ).scene_dict(lit_from_behind=False, glass_mode="full")
        mi_scene["integrator"] = {"type": "stokes", "nested": mi_scene["integrator"]}
        stokes = np.array(mitsuba.render(mitsuba.load_dict(mi_scene), spp=4096)).mean((0, 1))
    intensity = stokes[1]
    difference = abs(stokes[4])
    s, p = pane_reflectances(56.31)
    assert intensity == pytest.approx((s + p) / 2, rel=0.02)
    assert difference == pytest.approx((s - p) / 2, rel=0.02)


def red_half(image):
    """The name of the half that is red in a red and white image."""
    green = image[..., 1] / image[..., 0].max()
    halves = {
        "left": green[:, :13],
        "right": green[:, -13:],
        "top": green[:13],
        "bottom": green[-13:],
    }
    return " ".join(name for name, half in halves.items() if half.max() < 0.05)


@pytest.mark.parametrize("radius_mm", [math.inf, 3000])
def test_the_left_edge_of_a_map_is_at_its_heading_and_a_mirror_shows_the_map_behind_the_camera(
    radius_mm,
):
    """A map's centre is opposite its heading; seen by a camera that faces it, its right half is at
    -x.
    """
    behind, front = (map_side("red right", heading_deg=at, radius_mm=radius_mm) for at in (180, 0))
    scene = a_scene(behind=behind, front=front)
    assert red_half(render_image(scene, "behind", "none")) == "right"
    assert red_half(render_image(scene, "front", "mirror")) == "left"


@pytest.mark.parametrize("radius_mm", [math.inf, 3000])
@pytest.mark.parametrize("behind", [True, False])
def test_a_map_emits_the_light_of_its_texels_on_its_side_only(
    radius_mm, behind, rng, requires_llvm, mitsuba
):
    side = map_side("mottled", heading_deg=37, radius_mm=radius_mm)
    glass = Glazing(heading_deg=-20, pitch_deg=10)
    scene = a_scene(behind=side, front=side, glass=glass, camera={"position_mm": (100, 0, 500)})
    directions = rng.normal(size=(3, 4000))
    directions /= np.linalg.norm(directions, axis=0)
    to_glass = np.array(axes(glass.heading_deg, glass.pitch_deg))
    with renderer._active_variant(mitsuba, polarised=False):
        mi_scene = mitsuba.load_dict(
            MitsubaSceneBuilder(mitsuba, scene, ASSETS).scene_dict(
                lit_from_behind=behind, glass_mode="none"
            )
        )
        intersection = mi_scene.ray_intersect(
            mitsuba.Ray3f(
                mitsuba.Point3f(0), mitsuba.Vector3f((to_glass @ directions).astype("f4"))
            )
        )
        light = np.array(intersection.emitter(mi_scene).eval(intersection))
    u = (np.arctan2(directions[0], -directions[2]) / (2 * np.pi) - 37 / 360) % 1
    v = np.arccos(directions[1]) / np.pi
    texels = [sample_bilinear(MOTTLED, u[i : i + 1], v[i : i + 1])[0, 0] for i in range(len(u))]
    height = to_glass[2] @ directions
    expected = np.stack(texels, axis=1) * ((height < 0) == behind)
    is_off_glass_plane = np.abs(height) > 0.01
    np.testing.assert_allclose(
        light[:, is_off_glass_plane], expected[:, is_off_glass_plane], atol=1e-4
    )


def test_a_plane_hides_the_map_behind_it():
    plane = plane_side("white", luminance=0.5).plane
    light = render_image(a_scene(behind=Side(map=map_side().map, plane=plane)), "behind", "none")
    np.testing.assert_allclose(light, 0.5, atol=1e-3)


def test_the_back_of_a_plane_between_camera_and_glass_is_black_in_the_light_of_both_sides():
    plane = plane_side("white", distance_mm=300, width_mm=1000).plane
    scene = a_scene(front=Side(map=map_side().map, plane=plane))
    assert (
        render_image(scene, "behind", "full").max()
        == render_image(scene, "front", "full").max()
        == 0
    )


@pytest.mark.parametrize(
    ("side", "glass_mode"), [("behind", "full"), ("behind", "none"), ("front", "mirror")]
)
def test_a_frame_is_an_opening_in_a_black_wall(side, glass_mode):
    scene = a_scene(glass=Glazing(opening_mm=(200, 44)), camera={"position_mm": (0, 0, 250)})
    light = render_image(scene, side, glass_mode)[..., 0]
    assert (light > 0.5).sum(axis=0).tolist() == [16] * 32


@pytest.mark.parametrize("radii_mm", [(300.0, -300.0), (-400.0, 900.0)])
def test_a_lens_refracts_light_according_to_the_lensmakers_equation(radii_mm):
    """A ray through height y of a thin lens meets a plane at y (1 + b / a - b / f).

    a and b are the distances of the camera and of the plane from the lens, f is its focal length.
    """
    near = 400.0
    far = 150.0
    glass = Glazing(panes=(Pane(thickness_mm=6.0),), radii_mm=radii_mm, opening_mm=(40.0, 40.0))
    camera = {"position_mm": (0, 0, near), "fov_deg": 2.0}
    scene = a_scene(
        glass=glass, behind=plane_side("ramp", distance_mm=far, width_mm=100), camera=camera
    )
    r1, r2 = radii_mm
    power = 0.5 * (1 / r1 - 1 / r2 + 0.5 * 6 / (1.5 * r1 * r2))
    found = slope(render_image(scene, "behind", "truncated_transmission"), near) * 100 / 0.96**2
    assert found == pytest.approx(1 + far / near - far * power, abs=0.02)


def test_the_mirror_image_of_a_lens_is_that_of_its_first_surface():
    """A sphere's focal length is half its radius: a ray at height y meets a plane at y (1 + b / a +
    2 b / r).
    """
    glass = Glazing(
        panes=(Pane(thickness_mm=20),), radii_mm=(300.0, 1000.0), opening_mm=(100.0, 100.0)
    )
    front = plane_side("ramp", distance_mm=1000, width_mm=4000)
    image = render_image(
        a_scene(glass=glass, front=front, camera={"fov_deg": 2}), "front", "mirror"
    )
    assert -slope(image, 500) * 4000 == pytest.approx(1 + 1000 / 500 + 2000 / 300, rel=0.01)


def slope(image, distance_mm):
    """The slope of light to the right along the first surface, per mm; the view is 2 degrees
    wide.
    """
    half = distance_mm * math.tan(math.radians(1))
    return np.polyfit(np.linspace(-31 / 32, 31 / 32, 32) * half, image[..., 0].mean(0), 1)[0]


@pytest.mark.parametrize("glass", [
    Glazing(panes=(Pane(wedge_deg=5.0),)),
    Glazing(panes=(Pane(wedge_deg=1.0, thickness_mm=50), Pane()), gap_mm=1.0),
    Glazing(radii_mm=(100.0, -100.0), opening_mm=(80.0, 80.0)),
    Glazing(radii_mm=(50.0, 60.0), opening_mm=(80.0, 80.0)),
], ids=["knife's edge", "panes that touch", "lens without edge", "sphere too small"])  # fmt: skip
def test_impossible_glass_is_refused(glass):
    with pytest.raises(RecipeError, match="expected"):
        traced(a_scene(glass=glass))


def test_the_same_seed_gives_the_same_bytes_and_another_seed_gives_other_bytes():
    scene = a_scene(behind=map_side("mottled"), front=map_side("mottled"))
    first, repeated, reseeded = (
        traced(s, max_samples=16) for s in (scene, scene, scene.model_copy(update={"seed": 1}))
    )
    samples = (first, repeated, reseeded)
    for a, b, c in zip(*(sample.images().values() for sample in samples), strict=True):
        assert a.numpy().tobytes() == b.numpy().tobytes()
        assert a.numpy().tobytes() != c.numpy().tobytes()


def test_the_noise_is_at_most_the_requested_one():
    scene = a_scene(behind=map_side("mottled"), front=map_side("mottled"))
    errors = []
    for noise_threshold in (0.05, 0.005):
        one, other = (
            traced(
                scene.model_copy(update={"seed": n}),
                noise_threshold=noise_threshold,
                max_samples=4096,
            )
            for n in (1, 2)
        )
        difference = (one.photo - other.photo).mean(0).abs() / one.photo.mean(0)
        errors.append(
            float(difference.mean()) * math.sqrt(math.pi) / 2
        )  # E|a - b| = 2 sigma / sqrt(pi)
    assert errors[0] < 0.05
    assert 0.004 < errors[1] < 0.0055


def test_the_previously_selected_variant_is_restored(mitsuba):
    traced(a_scene(), max_samples=4)
    mitsuba.set_variant("scalar_rgb")
    traced(a_scene(), max_samples=4)
    assert mitsuba.variant() == "scalar_rgb"
