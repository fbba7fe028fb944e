"""Scenes are the same on every machine, possible, and within the ranges of their recipe."""

import hashlib
import math
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from brewster.errors import RecipeError
from brewster.render.analytic import render
from brewster.render.environments.assets import builtin_catalog
from brewster.render.scene.camera import Camera
from brewster.render.scene.recipe import (
    RECIPES,
    BurstRecipe,
    CameraRecipe,
    GlassRecipe,
    SceneRecipe,
    SideRecipe,
    read_scene_recipe,
)
from brewster.render.scene.sampler import Asset, Catalog, draw
from brewster.render.scene.scene import Scene, read_scene
from brewster.render.scene.world import AssetSource
from synthetic_scenes import ASSETS, SyntheticAssets, pixel_directions

BUILTIN = builtin_catalog()
WIDTHS = {asset.source: asset.width for asset in BUILTIN.maps}


def drawn(recipe, index, seed=7, catalog=BUILTIN):
    return draw(
        read_scene_recipe(recipe) if isinstance(recipe, str) else recipe, catalog, seed, index
    )


def changed(name, **parts):
    """A packaged recipe with some values of some parts changed."""
    recipe = read_scene_recipe(name)
    update = {
        part: getattr(recipe, part).model_copy(update=values) for part, values in parts.items()
    }
    return recipe.model_copy(update=update)


@pytest.fixture(scope="module")
def fifty():
    return {recipe: [drawn(recipe, index) for index in range(50)] for recipe in RECIPES}


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_packaged_recipe_draws_possible_scenes(fifty, recipe):
    for index, scene in enumerate(fifty[recipe]):
        assert Scene.model_validate(scene.model_dump()) == scene
        number = index // read_scene_recipe(recipe).frames  # all frames of a burst have its index
        assert (scene.recipe, scene.seed, scene.index) == (recipe, 7, number)
        assert scene.glass.is_flat
    assert len({scene.to_toml() for scene in fifty[recipe]}) == 50


def test_a_scene_depends_on_its_index_and_not_on_scenes_drawn_before(fifty):
    assert [drawn("tiny", index) for index in (9, 3, 40)] == [
        fifty["tiny"][index] for index in (9, 3, 40)
    ]


EVERYTHING = SceneRecipe(
    name="everything",
    about="Each feature in some of the scenes.",
    glass=GlassRecipe(
        double_probability=0.5, structural_probability=0.3, rough_probability=0.3,
        absorption_per_m=((4.0, 1.0, 2.0), (9.0, 8.0, 1.0)), wedge_probability=0.5,
        pitch_deg=(-5, 5),
    ),
    camera=CameraRecipe(pinhole_probability=0.5, focus_on_front_probability=0.4),
    behind=SideRecipe(
        map_probability=0.6, map_categories=("indoor",), dome_probability=0.5,
        plane_probability=0.4, heading_deg=(-20, 20), highlight_boost=(0, 3),
    ),
    front=SideRecipe(
        dome_probability=0.4, plane_probability=0.3, partial_probability=0.5, luminance=(0.1, 5),
    ),
)  # fmt: skip
EVERYTHING_CATALOG = Catalog(
    maps=tuple(
        Asset(source=AssetSource(file=f"{k}.exr"), width=2048 * k, height=1024 * k, category=kind)
        for k, kind in enumerate(("indoor", "outdoor", "", "night"), 1)
    ),
    pictures=tuple(
        Asset(source=AssetSource(file=f"{w}.jpg"), width=w, height=300) for w in (200, 300, 900)
    ),
)


@pytest.mark.parametrize(("changes", "digest"), [
    ({}, "fd95d9158cbebf0c"), ({"setups": {"map|map": 0.5, "plane|map": 0.5}}, "456f9960da39967b"),
    ({"burst": BurstRecipe(static_probability=0.3)}, "1e333f24f4f833e4"),
    ({"burst": BurstRecipe(light="polariser", frames=4)}, "4ee02b7d39fdfb4d"),
    ({"burst": BurstRecipe(light="cloth", frames=3)}, "289907158a36f7b5"),
], ids=["all", "setups", "moving", "polariser", "cloth"])  # fmt: skip
def test_a_seed_gives_the_same_scenes_in_every_version(changes, digest):
    """A dataset can be continued after an update. Whoever changes what is drawn says so in the
    changelog.
    """
    recipe = EVERYTHING.model_copy(update=changes)
    scenes = [drawn(recipe, index, catalog=EVERYTHING_CATALOG) for index in range(40)]
    text = "".join(scene.model_copy(update={"version": ""}).to_toml() for scene in scenes)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == digest


def test_index_seed_and_name_each_make_another_scene():
    recipe = read_scene_recipe("tiny")
    scenes = [drawn(recipe, 1), drawn(recipe, 2), drawn(recipe, 1, seed=8)]
    scenes.append(drawn(recipe.model_copy(update={"name": "other"}), 1))
    assert len({scene.camera.position_mm for scene in scenes}) == 4


@pytest.mark.parametrize("recipe", RECIPES)
def test_no_texel_of_a_map_spans_more_pixels_than_the_recipe_allows(fifty, recipe):
    asked = read_scene_recipe(recipe)
    maps = 0
    for scene in fifty[recipe]:
        for name in ("behind", "front"):
            side = getattr(scene, name)
            most = getattr(asked, name).max_px_per_texel
            if side.map:
                maps += 1
                least = scene.camera.width * 360 / WIDTHS[side.map.source] / most
                assert scene.camera.fov_deg >= least * (1 - 1e-5)
    assert maps > 5


def test_a_picture_behind_the_glass_fills_the_view():
    """No pixel is black, for a picture of any shape, with and without the glass."""
    recipe = changed(
        "vitrine",
        camera={"width": 24, "height": 16, "pinhole_probability": 1.0},
        behind={"relative_width": (1.05, 1.5), "heading_deg": (0.0, 0.0)},
    )
    for index in range(12):
        scene = drawn(recipe, index)
        white = SyntheticAssets(
            **{scene.behind.plane.source.file: ASSETS.pictures["white"][:, :24]}
        )
        scene = scene.model_copy(update={"front": Scene().front, "samples_per_pixel": 4})
        sample = render(scene, white)
        assert float(sample.background.min()) > 0.99 * scene.behind.plane.luminance
        assert float(sample.transmission.min()) > 0.4 * scene.behind.plane.luminance


@pytest.mark.parametrize("shape", [(20, 60), (30, 30), (60, 20)])
@pytest.mark.parametrize("size", [(24, 16), (16, 24)])
def test_wide_and_tall_pictures_just_cover_views_of_any_shape(shape, size):
    height, width = shape
    picture = Asset(source=AssetSource(file="picture"), width=width, height=height)
    assets = SyntheticAssets(picture=np.ones((*shape, 3), np.float32))
    for widening, is_covered in (1.05, True), (0.85, False):
        recipe = changed(
            "vitrine",
            camera={"width": size[0], "height": size[1], "pinhole_probability": 1.0},
            behind={"relative_width": (widening, widening), "heading_deg": (0.0, 0.0)},
        )
        for index in range(4):
            scene = drawn(recipe, index, catalog=Catalog(maps=BUILTIN.maps, pictures=(picture,)))
            scene = scene.model_copy(update={"front": Scene().front, "samples_per_pixel": 1})
            light = render(scene, assets).background
            assert (float(light.min()) > 0.99 * scene.behind.plane.luminance) == is_covered


def test_the_camera_distance_is_within_the_range_of_the_recipe(fifty):
    nearest, farthest = read_scene_recipe("window").camera.distance_mm
    for scene in fifty["window"]:
        assert 0.9 * nearest < scene.camera_above_glass_mm < 1.1 * farthest


def test_rough_glass_gets_more_rays():
    asked = changed("tiny", glass={"rough_probability": 1.0})
    asked = asked.model_copy(update={"rough_samples_per_pixel": 77})
    assert drawn(asked, 0).samples_per_pixel == 77
    assert drawn(asked, 0).glass.is_rough


def test_categories_are_respected_and_a_map_without_one_fits_everywhere():
    asked = changed("window", behind={"map_probability": 1.0, "map_categories": ("indoor",)})
    rooms = {drawn(asked, index).behind.map.source.file for index in range(20)}
    assert rooms <= {asset.source.file for asset in BUILTIN.maps if asset.category == "indoor"}
    plain = Catalog(maps=(Asset(source=AssetSource(file="a.hdr"), width=4096, height=2048),))
    assert drawn(asked, 0, catalog=plain).behind.map.source.file == "a.hdr"


def test_a_recipe_of_maps_needs_maps_that_are_sharp_enough():
    asked = changed("window", behind={"map_probability": 1.0, "plane_probability": 0.0})
    small = Asset(source=AssetSource(file="a.hdr"), width=64, height=32)
    for catalog in (Catalog(pictures=BUILTIN.pictures), Catalog(maps=(small,))):
        with pytest.raises(RecipeError, match=rf"none of {len(catalog.maps)} maps is suitable"):
            drawn(asked, 0, catalog=catalog)


@pytest.mark.parametrize(("camera", "says"), [
    ({"incidence_deg": (88.0, 89.0)}, ("gave no possible scene in 100 attempts; .* a corner of "
                                      "the view")),
    ({"fov_deg": (155.0, 160.0)}, ("gave no possible scene in 100 attempts; expected a number "
                                  "below 150;")),
])  # fmt: skip
def test_an_impossible_recipe_names_the_reason(camera, says):
    with pytest.raises(RecipeError, match=says):
        drawn(changed("tiny", camera=camera), 0)


@pytest.mark.parametrize("share", [0, 1])
def test_panes_pinholes_and_focus_have_the_frequency_of_their_probabilities(share):
    camera = {"pinhole_probability": share, "focus_on_front_probability": share}
    behind = {"map_probability": 1.0, "dome_probability": 0.0, "plane_probability": 0.0}
    sides = {"behind": behind, "front": {"plane_probability": 1.0}}
    recipe = changed("window", glass={"double_probability": share}, camera=camera, **sides)
    scenes = [drawn(recipe, index) for index in range(12)]
    assert {len(scene.glass.panes) for scene in scenes} == {1 + share}
    assert {scene.camera.aperture_mm == 0 for scene in scenes} == {bool(share)}
    assert {scene.camera.focus_mm < 1e6 for scene in scenes} == {
        bool(share)
    }  # content behind the glass is far


def test_a_logarithmic_range_has_its_median_at_the_geometric_mean():
    recipe = changed("window", glass={"thickness_mm": (1.0, 100.0), "structural_probability": 0.0})
    thick = sorted(drawn(recipe, index).glass.panes[0].thickness_mm for index in range(101))
    assert 1 <= thick[0] <= thick[-1] <= 100
    assert 4 < thick[50] < 25  # a uniform distribution has a median of 50


PAPER = str(Path(__file__).parents[1] / "recipes" / "render" / "paper.toml")


@pytest.fixture(scope="module")
def paper_scenes():
    recipe = read_scene_recipe(PAPER)
    maps = (Asset(source=AssetSource(file="a.exr"), width=8192, height=4096),)
    catalog = Catalog(maps=maps, pictures=BUILTIN.pictures)
    return [draw(recipe, catalog, 10, index) for index in range(600)]


def test_the_paper_recipe_draws_its_three_setups_with_their_frequencies(paper_scenes):
    """The set-ups are HDR|HDR, HDR|LDR and LDR|HDR: one kind of content on each side, and never two
    pictures.
    """

    def kind(side):
        assert (side.map is None) != (side.plane is None)
        return "plane" if side.map is None else "map"

    counts = Counter((kind(scene.behind), kind(scene.front)) for scene in paper_scenes)
    assert set(counts) == {("map", "map"), ("map", "plane"), ("plane", "map")}
    assert counts["map", "map"] / 600 == pytest.approx(0.5, abs=0.06)
    assert counts["map", "plane"] / 600 == pytest.approx(0.25, abs=0.055)


def test_the_paper_recipe_has_the_glass_and_the_orders_of_the_paper(paper_scenes):
    glasses = [scene.glass for scene in paper_scenes]
    panes = [pane for glass in glasses for pane in glass.panes]
    assert {scene.orders for scene in paper_scenes} == {"truncated"}
    assert all(1.45 <= pane.refractive_index <= 1.65 for pane in panes)
    assert all(3 <= pane.thickness_mm <= 6 or 10 <= pane.thickness_mm <= 40 for pane in panes)
    assert min(pane.refractive_index for pane in panes) < 1.46
    assert max(pane.refractive_index for pane in panes) > 1.64
    for share, low, high in (
        (sum(glass.is_rough for glass in glasses), 0.06, 0.14),
        (sum(len(glass.panes) == 2 for glass in glasses), 0.1, 0.2),
        (sum(glass.panes[0].thickness_mm >= 10 for glass in glasses), 0.14, 0.26),
        (sum(scene.camera.aperture_mm > 0 for scene in paper_scenes), 0.33, 0.47),
    ):
        assert low < share / 600 < high
    fields = [scene.camera.fov_deg for scene in paper_scenes]
    assert min(fields) < 25
    assert max(fields) > 85


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


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[[glass.panes]]\n[[glass.panes]]", "expected a gap_mm above 0 between several panes"),
        ("glass.radii_mm = [100, 100]", "expected one pane, .* and opening_mm"),
        ("[camera]\nfocus_mm = 1002\naperture_mm = 3", "the focus is 2 mm inside the glass"),
        (
            "camera.position_mm = [0, 0, -5]",
            "expected the camera in front of the glass, but it is 5 mm",
        ),
        ("camera.heading_deg = 80", "expected angles of incidence up to 85 degrees"),
        ("glass.pitch_deg = 75", "expected angles of incidence up to 85 degrees"),
        (f"[behind.map]\n{MAP}\nradius_mm = 500", "inside the dome, but its radius_mm is 500"),
        (f"[front.map]\n{MAP}\nradius_mm = 900", "inside the dome, but its radius_mm is 900"),
        (
            f"[behind.plane]\n{MAP}\ndistance_mm = 2\nwidth_mm = 9",
            "does not touch the glass, but its",
        ),
        (
            (
                f"[front.map]\n{MAP}\nradius_mm = 3000\n[front.plane]\n{MAP}\ndistance_mm = "
                "4000\nwidth_mm = 9"
            ),
            "distance_mm must be below radius_mm",
        ),
        ("glass = [", "is not TOML"),
    ],
)
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


def covered_share(scene):
    """The share of the view that the mirrored picture covers, for a picture that faces the glass:
    the light of a white picture in a black room, over that of a white room.
    """
    small = scene.camera.model_copy(update={"width": 24, "height": 16, "aperture_mm": 0.0})
    plane = scene.front.plane
    white = SyntheticAssets(**{plane.source.file: ASSETS.pictures["white"]})
    front = scene.front.model_copy(
        update={"map": None, "plane": plane.model_copy(update={"luminance": 1.0})}
    )
    update = {"camera": small, "front": front, "behind": Scene().behind, "samples_per_pixel": 4}
    return float(render(scene.model_copy(update=update), white).mirror.mean())


def test_a_partial_reflection_covers_a_part_of_the_view_and_is_brighter_or_darker_than_the_rest():
    part = {"plane_probability": 0.0, "partial_probability": 1.0, "partial_width": (0.2, 0.4)}
    asked = changed("window", front={"partial_contrast": (5.0, 9.0), **part})
    ratios = []
    for index in range(16):
        front = drawn(asked, index).front
        ratios.append(front.plane.luminance / front.map.luminance)
        assert 0 < covered_share(drawn(asked, index)) < 0.75
        assert max(front.plane.luminance, front.map.luminance) >= asked.front.luminance[0]
    assert all(5 <= max(ratio, 1 / ratio) < 9.01 for ratio in ratios)
    assert min(ratios) < 1 < max(ratios)


def test_the_share_of_partial_reflections_is_that_of_the_recipe():
    asked = changed("window", front={"plane_probability": 0.0})
    partial = sum(drawn(asked, index).front.plane is not None for index in range(200))
    assert abs(partial / 200 - asked.front.partial_probability) < 0.1


def test_a_static_burst_differs_in_exposure_and_noise_only():
    burst = read_scene_recipe("burst").burst
    asked = changed("burst", burst={"static_probability": 1.0})
    scenes = [drawn(asked, index) for index in range(burst.frames)]
    assert len({scene.camera for scene in scenes}) == 1
    assert len({scene.camera_response.target_luminance for scene in scenes}) == burst.frames
    moving = changed("burst", burst={"static_probability": 0.0})
    assert len({drawn(moving, index).camera for index in range(burst.frames)}) == burst.frames
    reference = burst.frames // 2
    assert scenes[reference] == drawn(moving, reference)
