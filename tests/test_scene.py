"""Writing and reading a scene gives the same scene; impossible scenes are refused and the key named."""

import math
import tomllib

import pytest

from brewster.environments.assets import builtin_catalog
from brewster.errors import RecipeError
from brewster.scene.camera import Camera
from brewster.scene.recipe import RECIPES, read_scene_recipe
from brewster.scene.sampler import draw
from brewster.scene.scene import Scene, read_scene
from synthetic_scenes import pixel_directions

MAP = "source.file = 'spree_bank.exr'"


@pytest.fixture
def written(tmp_path):
    def written(text):
        (tmp_path / "scene.toml").write_text(text)
        return tmp_path / "scene.toml"

    return written


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_scene_that_is_written_and_read_is_the_same(recipe, written):
    for index in range(12):
        scene = draw(read_scene_recipe(recipe), builtin_catalog(), 3, index)
        assert read_scene(written(scene.to_toml())) == scene


def test_an_empty_file_is_the_plainest_scene_and_a_map_is_infinitely_far(written):
    assert read_scene(written("")) == Scene()
    scene = read_scene(written(f"behind.map.{MAP}"))
    assert scene.behind.map.radius_mm == math.inf
    assert tomllib.loads(scene.to_toml())["behind"]["map"]["radius_mm"] == math.inf
    assert read_scene(written(scene.to_toml())) == scene


def test_the_outcome_of_a_scene_is_ignored(written):
    scene = draw(read_scene_recipe("window"), builtin_catalog(), 3, 1)
    text = scene.to_toml(outcome={"exposure_ev": -1.5, "white_balance_gains": [1.0, 1.1, 0.9]})
    assert "[outcome]" in text
    found = read_scene(written(text))
    assert found == scene
    assert type(found) is Scene
    assert "outcome" not in found.to_toml()


@pytest.mark.parametrize(("text", "says"), [
    ("[[glass.panes]]\n[[glass.panes]]", "expected a gap_mm above 0 between several panes"),
    ("glass.radii_mm = [100, 100]", "expected one pane, .* and opening_mm"),
    ("[camera]\nfocus_mm = 1002\naperture_mm = 3", "the focus is 2 mm inside the glass"),
    ("camera.position_mm = [0, 0, -5]", "expected the camera in front of the glass, but it is 5 mm"),
    ("camera.heading_deg = 80", "expected angles of incidence up to 85 degrees"),
    ("glass.pitch_deg = 75", "expected angles of incidence up to 85 degrees"),
    (f"[behind.map]\n{MAP}\nradius_mm = 500", "inside the dome, but its radius_mm is 500"),
    (f"[front.map]\n{MAP}\nradius_mm = 900", "inside the dome, but its radius_mm is 900"),
    (f"[behind.plane]\n{MAP}\ndistance_mm = 2\nwidth_mm = 9", "does not touch the glass, but its"),
    (
        f"[front.map]\n{MAP}\nradius_mm = 3000\n[front.plane]\n{MAP}\ndistance_mm = 4000\nwidth_mm = 9",
        "distance_mm must be below radius_mm",
    ),
    ("glass = [", "is not TOML"),
])  # fmt: skip
def test_an_impossible_scene_is_refused_and_the_value_named(text, says, written):
    path = written(text)
    with pytest.raises(RecipeError, match=says) as caught:
        read_scene(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("text", "says"), [
    (
        "glass.refractive_index = [0.9, 1.5]",
        "expected a refractive_index of at least 1, but it starts at",
    ),
    ("glass.gap_mm = [0, 1]\nglass.double_probability = 0.5", "expected a gap_mm above 0"),
    ("glass.absorption_per_m = []", "at least one colour"),
    ("camera_response.jpeg_quality = [97, 60]", r"camera_response\.jpeg_quality is \[97, 60\]"),
])  # fmt: skip
def test_an_impossible_recipe_is_refused_and_the_value_named(text, says, written):
    path = written(f"name = 'mine'\nabout = ''\n{text}")
    with pytest.raises(RecipeError, match=says):
        read_scene_recipe(str(path))


def test_framed_glass_is_accepted_at_any_angle_and_a_pinhole_camera_with_any_focus(written):
    read_scene(written("glass.opening_mm = [500, 400]\ncamera.heading_deg = 80"))
    read_scene(written("camera.focus_mm = 1002"))


def test_a_cameras_corners_frame_its_pixels():
    camera = Camera(heading_deg=33, pitch_deg=-12, fov_deg=60, width=48, height=32)
    pixels = pixel_directions(camera)
    for corner, place in zip(camera.corners(), [(-1, 0), (0, 0), (-1, -1), (0, -1)], strict=True):
        cosine = pixels[place] @ corner / math.hypot(*corner)
        assert math.degrees(math.acos(min(cosine, 1))) < 1.3
