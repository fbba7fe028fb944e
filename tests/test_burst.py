"""The motion of both layers between the frames of a burst is exact, and the frames differ in
nothing else.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from brewster.base.settings import validated
from brewster.errors import RecipeError
from brewster.render.analytic import render
from brewster.render.camera_response import develop
from brewster.render.environments.assets import builtin_catalog
from brewster.render.scene.glass import Glazing, Pane
from brewster.render.scene.recipe import BurstRecipe, SceneRecipe, read_scene_recipe
from brewster.render.scene.sampler import Asset, Catalog, draw, draw_frames
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import AssetSource
from layer_motion import layer_motion
from synthetic_scenes import SyntheticAssets, camera_towards_glass, make_scene, map_side, plane_side

STILL = {"baseline_mm": (0.0, 0.0), "tremble_mm": 0.0, "tremble_deg": 0.0}


def waves(height, width):
    """A smooth picture (H, W, 3) with a few waves in both directions."""
    y, x = np.mgrid[:height, :width] / (height, width)[0]
    light = [1 + 0.5 * np.sin(17 * x + phase) * np.cos(19 * y - phase) for phase in (0, 1, 2)]
    return np.stack(light, -1).astype(np.float32)


ASSETS = SyntheticAssets(waves=waves(256, 512), picture=waves(512, 768))


class AnyAssets:
    """Smooth content for every source of the built-in catalog. Pictures have their real size."""

    def map_radiance(self, environment):
        return ASSETS.pictures["waves"] * np.float32(environment.luminance)

    def plane_radiance(self, plane):
        asset = next(asset for asset in builtin_catalog().pictures if asset.source == plane.source)
        return waves(asset.height, asset.width) * np.float32(plane.luminance)


ANY_ASSETS = AnyAssets()


def burst_recipe(name="burst", size=(48, 32), **values):
    """A packaged recipe in a small size, with a changed table [burst]."""
    recipe = read_scene_recipe(name)
    camera = recipe.camera.model_copy(update={"width": size[0], "height": size[1]})
    burst = (recipe.burst or BurstRecipe()).model_copy(update={"static_probability": 0.0, **values})
    return recipe.model_copy(update={"camera": camera, "burst": burst})


def frames_of(index=0, seed=7, **values):
    return draw_frames(burst_recipe(**values), builtin_catalog(), seed, index)


def moved(scene, offset_mm=(0.0, 0.0, 0.0), turn_deg=(0.0, 0.0, 0.0)):
    return scene.model_copy(update={"camera": scene.camera.moved(offset_mm, turn_deg)})


def warped(layer, motion):
    """A layer (3, H, W) of the second frame at the positions of the first frame, and the mask of
    positions inside.
    """
    height, width = layer.shape[1:]
    y, x = np.mgrid[:height, :width]
    position = motion + np.stack([x, y], -1)
    grid = torch.from_numpy(((position + 0.5) / (width, height) * 2 - 1).astype(np.float32))
    image = functional.grid_sample(layer[None], grid[None], mode="bicubic", align_corners=False)[0]
    return image, ((position > 2) & (position < (width - 3, height - 3))).all(-1)


# --- the motion

BEHIND = plane_side("picture", distance_mm=2500, width_mm=9000, height_mm=6000, heading_deg=25)
FRONT = plane_side(
    "picture", distance_mm=1500, width_mm=5000, height_mm=6000, heading_deg=-20, pitch_deg=9
)


@given(
    offset=st.tuples(*[st.floats(-60, 60)] * 3),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    heading=st.floats(-25, 25),
    panes=st.sampled_from([({},), ({"thickness_mm": 20.0}, {"refractive_index": 1.6})]),
    behind=st.sampled_from([BEHIND, map_side("waves", radius_mm=3000.0), map_side("waves")]),
    front=st.sampled_from([FRONT, map_side("waves", radius_mm=1500.0, heading_deg=50)]),
)
@settings(max_examples=25, deadline=None)
def test_layers_of_a_frame_warped_by_their_motion_are_the_reference(
    offset, turn, heading, panes, behind, front
):
    camera = camera_towards_glass(heading, 4.0, 700.0, width=96, height=72, fov_deg=50)
    scene = make_scene(
        camera, panes, behind=behind, front=front, orders="truncated", samples_per_pixel=1
    )
    other = moved(scene, offset, turn)
    motion = layer_motion(scene, other)
    reference = render(scene, ASSETS)
    frame = render(other, ASSETS)
    layers = {"background": "transmission", "transmission": "transmission", "mirror": "reflection"}
    for name, layer in layers.items():
        steps = getattr(motion, layer)
        image, inside = warped(getattr(frame, name), steps)
        truth = getattr(reference, name)
        error = (image / truth - 1).abs().mean(0).numpy()[inside & (truth > 0).all(0).numpy()]
        assert np.median(error) < 0.01, name  # 0.02 px at the steepest part of a wave
        assert np.quantile(error, 0.9) < 0.03, name


def test_a_sideways_move_shifts_a_plane_by_the_focal_length_over_the_distance():
    """A plane at Z moves by f b / Z; the mirrored plane has the distance camera - glass - plane."""
    scene = make_scene(
        camera_towards_glass(0.0, distance_mm=600.0, width=100, height=80, fov_deg=60),
        behind=plane_side(distance_mm=2400, width_mm=1e5, height_mm=1e5),
        front=plane_side(distance_mm=900, width_mm=1e5, height_mm=1e5),
        glass=Glazing(panes=(Pane(refractive_index=1.0),)),
    )
    motion = layer_motion(scene, moved(scene, (30.0, 0.0, 0.0)))
    focal_px = 50 / math.tan(math.radians(30))
    for found, distance_mm in ((motion.transmission, 3000), (motion.reflection, 1500)):
        expected = np.broadcast_to((-focal_px * 30 / distance_mm, 0), (80, 100, 2))
        np.testing.assert_allclose(found, expected, atol=1e-4)
    assert motion.relative_px() == pytest.approx(focal_px * 30 * (1 / 1500 - 1 / 3000), abs=1e-4)


def test_a_camera_that_rolls_clockwise_turns_the_photo_counterclockwise():
    scene = make_scene(camera_towards_glass(0.0, width=101, height=101))
    motion = layer_motion(scene, moved(scene, turn_deg=(0, 0, 1.0))).transmission
    assert motion[50, 50] == pytest.approx([0, 0], abs=1e-4)
    degree = math.radians(1)
    expected = [50 * (math.cos(degree) - 1), -50 * math.sin(degree)]
    assert motion[50, 100] == pytest.approx(expected, abs=1e-3)


def test_pixels_without_content_have_no_motion():
    narrow = plane_side(width_mm=200, height_mm=100)
    scene = make_scene(camera_towards_glass(0.0), behind=narrow, front=Scene().front)
    motion = layer_motion(scene, moved(scene, (5.0, 0.0, 0.0)))
    assert np.isnan(motion.reflection).all()
    assert np.isfinite(motion.transmission).any()
    assert np.isnan(motion.transmission[0]).all()
    assert math.isnan(motion.relative_px())


# --- drawing


def test_the_reference_frame_is_the_scene_that_the_recipe_draws_without_bursts():
    recipe = burst_recipe("tiny", frames=3)
    for index in range(20):
        single = draw(recipe.model_copy(update={"burst": None}), builtin_catalog(), 7, index)
        reference = draw_frames(recipe, builtin_catalog(), 7, index)[1]
        excluded = {
            "burst": True,
            "behind": {"plane": {"height_mm"}},
            "front": {"plane": {"height_mm"}},
        }
        assert reference.model_dump(exclude=excluded) == single.model_dump(exclude=excluded)
        assert reference.noise_seeds == single.noise_seeds


def test_a_burst_without_motion_has_the_light_of_the_single_photo_in_every_frame():
    recipe = burst_recipe("tiny", frames=3, exposure_jitter_ev=0.0, **STILL)
    for index in (0, 3, 8):
        single = draw(recipe.model_copy(update={"burst": None}), builtin_catalog(), 7, index)
        single = render(single, ANY_ASSETS)
        frames = [
            render(scene, ANY_ASSETS) for scene in draw_frames(recipe, builtin_catalog(), 7, index)
        ]
        for frame in frames:
            for name, light in single.images().items():
                assert torch.equal(frame.images()[name], light)
        photos = [develop(frame).photo_encoded for frame in frames]
        assert torch.equal(photos[1], develop(single).photo_encoded)
        assert not torch.equal(photos[0], photos[2])  # each frame has its own noise


def test_the_frames_of_a_burst_differ_in_camera_exposure_and_number_only():
    frames = frames_of(4, frames=4)
    varying = {"camera", "camera_response", "burst"}
    assert len({str(frame.model_dump(exclude=varying)) for frame in frames}) == 1
    assert [frame.burst.frame for frame in frames] == [0, 1, 2, 3]
    assert [frame.burst.is_reference for frame in frames] == [False, False, True, False]
    assert (
        len({frame.camera for frame in frames}) == len({frame.noise_seeds for frame in frames}) == 4
    )
    lens = {"position_mm", "heading_deg", "pitch_deg", "roll_deg"}
    assert len({str(frame.camera.model_dump(exclude=lens)) for frame in frames}) == 1


@pytest.mark.parametrize("frames", [2, 3, 5, 8])
def test_the_baseline_is_the_distance_between_the_first_and_the_last_position(frames):
    steady = {"tremble_mm": 0.0, "tremble_deg": 0.0, "frames": frames}
    for index in range(10):
        cameras = [scene.camera for scene in frames_of(index, baseline_mm=(40.0, 40.0), **steady)]
        steps = np.diff([camera.position_mm for camera in cameras], axis=0)
        np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 40 / (frames - 1), rtol=1e-4)
        np.testing.assert_allclose(steps @ np.array(cameras[0].axes[2]), 0, atol=1e-3)
        largest = 40 / (frames - 1) * math.sin(math.radians(21))
        assert np.abs(steps @ np.array(cameras[0].axes[1])).max() < largest


def test_the_tremble_has_the_requested_size_on_all_axes():
    turns = []
    moves = []
    for index in range(60):
        frames = frames_of(index, tremble_mm=3.0, tremble_deg=0.5, baseline_mm=(0.0, 0.0))
        reference = frames[2].camera
        for camera in (frames[0].camera, frames[4].camera):
            moves.append(
                np.array(reference.axes) @ np.subtract(camera.position_mm, reference.position_mm)
            )
            turn = (
                camera.heading_deg - reference.heading_deg,
                camera.pitch_deg - reference.pitch_deg,
            )
            turns.append((*turn, camera.roll_deg))
    np.testing.assert_allclose(np.std(moves, axis=0), 3.0, rtol=0.25)
    np.testing.assert_allclose(np.std(turns, axis=0), 0.5, rtol=0.25)


def test_the_exposures_have_the_requested_spread_in_stops():
    recipe = burst_recipe(exposure_jitter_ev=0.4)
    response = recipe.camera_response.model_copy(update={"target_luminance": (0.1, 0.1)})
    recipe = recipe.model_copy(update={"camera_response": response})
    stops = []
    for index in range(60):
        frames = draw_frames(recipe, builtin_catalog(), 7, index)
        light = np.array([scene.camera_response.target_luminance for scene in frames])
        assert light[2] == 0.1  # the reference frame
        stops += np.log2(np.delete(light, 2) / 0.1).tolist()
        bright = burst_recipe(exposure_jitter_ev=9.0)
        frames = draw_frames(bright, builtin_catalog(), 7, index)
        assert max(scene.camera_response.target_luminance for scene in frames) <= 1
    assert np.std(stops) == pytest.approx(0.4, rel=0.15)
    assert np.mean(stops) == pytest.approx(0, abs=0.06)


@pytest.mark.parametrize("frames", [2, 3, 5])
def test_a_polariser_turns_by_half_a_turn_in_equal_steps(frames):
    starts = []
    for index in range(8):
        scenes = draw_frames(
            burst_recipe("polariser", frames=frames, polariser_jitter_deg=0.0),
            builtin_catalog(),
            7,
            index,
        )
        angles = np.array([scene.camera.polariser_deg for scene in scenes])
        assert np.abs(angles).max() <= 90
        steps = np.diff([*angles, angles[0]]) % 180  # the last one leads to the first angle again
        np.testing.assert_allclose(steps, 180 / frames, atol=1e-3)
        starts.append(angles[0])
    assert len(set(starts)) == 8


@pytest.mark.parametrize(("width", "height"), [(60, 20), (30, 30), (20, 60)])
def test_pictures_of_a_burst_keep_their_shape(width, height):
    picture = Asset(source=AssetSource(file="picture"), width=width, height=height)
    catalog = Catalog(maps=builtin_catalog().maps, pictures=(picture,))
    planes = [
        side.plane
        for index in range(8)
        for scene in draw_frames(burst_recipe(frames=2), catalog, 7, index)
        for side in (scene.behind, scene.front)
        if side.plane
    ]
    assert planes
    for plane in planes:
        assert plane.height_mm / plane.width_mm == pytest.approx(height / width)


@pytest.mark.parametrize(("values", "message"), [
    ({"baseline_mm": [-3.0, 5.0]}, "baseline_mm of at least 0"), ({"frames": 1}, ("burst.frames "
                                                                                 "is 1")),
    ({"tremble_mm": -1.0}, "burst.tremble_mm is -1.0"), ({"shake": 1.0}, "no key burst.shake"),
])  # fmt: skip
def test_an_impossible_burst_is_refused(values, message):
    with pytest.raises(RecipeError, match=message):
        validated(
            SceneRecipe, {"name": "a", "about": "b", "burst": values}, source="x", reference="y"
        )
