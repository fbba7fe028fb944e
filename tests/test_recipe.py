import pickle
import tomllib
from pathlib import Path

import pytest

from brewster.base.settings import commented_toml, read_toml
from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.errors import RecipeError
from brewster.render.scene.recipe import RECIPES, SceneRecipe, read_scene_recipe
from brewster.training.data.data_recipe import MixRecipe
from brewster.training.recipe import (
    TEMPLATES,
    CompactRecipe,
    read_recipe,
    read_template,
    with_value,
)

FOLDER = Path(__file__).parents[1] / "recipes"
TINY = FOLDER / "train/tiny.toml"
KONTEXT = TINY.with_stem("kontext")
SETS = '[data.rendered]\ndatasets = ["a"]\n'
BASES = [FOLDER / "ablations/base.toml", FOLDER / "ablations/tiny.toml"]


def read_with_data(tmp_path, data):
    """Returns the tiny recipe with other data."""
    head = TINY.read_text().split("[data]")[0]
    (tmp_path / "recipe.toml").write_text(f"{head}[data]\n{data}")
    return read_recipe(tmp_path / "recipe.toml")


def test_a_changed_value_leaves_the_rest_of_a_recipe_as_it_was():
    before = read_recipe(BASES[0])
    after = with_value(before, "data.rendered.blend_space", "srgb")
    assert after.data.rendered.blend_space == "srgb"
    assert with_value(after, "data.rendered.blend_space", "linear") == before
    assert with_value(before, "mix.noise", [0, 0.5]).mix == MixRecipe(noise=(0, 0.5))


@pytest.mark.parametrize(("key_path", "value", "message"), [
    ("sparkle", 1, "with sparkle = 1: there is no key sparkle"),
    ("data.rendered.blend_space", "dark", "with data.rendered.blend_space = 'dark'"),
    ("data.pairs_share", 0.01, "pairs_share = 0.01: the values are inconsistent; .* gives 0 of 8"),
    ("steps", 0, "steps = 0: steps is 0; expected integer, above 0; compare"),
])  # fmt: skip
def test_a_change_that_is_not_allowed_is_refused_and_the_key_named(key_path, value, message):
    with pytest.raises(RecipeError, match=message):
        with_value(read_recipe(BASES[0]), key_path, value)


def test_training_images_grow_at_the_shares_of_the_run_in_the_recipe():
    recipe = read_recipe(FOLDER / "train/tiny.toml")
    assert (recipe.steps, recipe.image_size_schedule) == (6, [(0.0, 64), (0.5, 96)])
    assert [recipe.size_at(step) for step in range(6)] == [64, 64, 64, 96, 96, 96]


def test_sources_with_a_share_of_0_may_be_listed(tmp_path):
    no_pairs = 'pairs = ["real"]\npairs_share = 0.0\n'
    assert not read_with_data(tmp_path, f"{no_pairs}{SETS}").data.is_empty
    assert not read_with_data(tmp_path, f'photos = ["a"]\n{no_pairs}').data.is_empty
    assert not read_with_data(tmp_path, f'photos = ["a"]\n{SETS}share = 0.0\n').data.is_empty
    assert not read_with_data(tmp_path, 'pairs = ["real"]\npairs_share = 1.0\n').data.is_empty
    assert read_with_data(tmp_path, f"{no_pairs}{SETS}count = 0\n").data.is_empty


@pytest.mark.parametrize(("change", "message"), [
    (("seed = 1", "seed ="), "not TOML"),
    (("# A short run", "# Un test complété"), "not TOML .*utf-8"),
    (("steps = 6", 'steps = 6\nnetwork = "lite3"'), ('network is "lite3"; expected one of the '
                                                    'networks')),
    (("[[0.0, 64], [0.5, 96]]", "[[0.1, 64]]"), "image_size_schedule is .*; .* start at 0"),
    (("[[0.0, 64], [0.5, 96]]", "[[0.0, 64], [0.0, 96]]"), ("image_size_schedule is .*; .* "
                                                           "increase")),
    (("[[0.0, 64], [0.5, 96]]", "[[0.0, 96], [0.5, 64]]"), ("image_size_schedule is .*; .* "
                                                           "increase")),
    (("[[0.0, 64], [0.5, 96]]", "[[0.0, 50]]"), (r"image_size_schedule\.0\.1 is 50; .* multiples "
                                                r"of 32")),
    (('["photos/permissive"]', "[]"), r"\[data\] are inconsistent"),
    (("[data]", '[data]\npairs = ["real"]'), r"\[data\] are inconsistent; expected pairs_share"),
    (("[data]", '[data]\npairs = ["real"]\npairs_share = 0.1'), "inconsistent"),
    (("[data]", '[data]\npairs = ["real"]\npairs_share = 0.9'), "inconsistent"),
    (("[data]", "[data]\npairs_share = 0.5"), r"\[data\] are inconsistent"),
    (('photos = ["photos/permissive"]', 'pairs = ["real"]\npairs_share = 0.5'), r"\[data\] are"),
    (("[mix]", "[data.rendered]\n[mix]"), r"data\.rendered\.datasets is missing"),
    (("[mix]", "[data.rendered]\ndatasets = []\n[mix]"), r"data\.rendered\.datasets is \[\]"),
    (("[mix]", f"{SETS}[mix]"), r"\[data\] are inconsistent"),
    (("[mix]", f"{SETS}share = 0.2\n[mix]"), "inconsistent"),
    (('photos = ["photos/permissive"]', f"{SETS}share = 0.5"), r"\[data\] are"),
    (("[mix]", f"{SETS}count = -1\n[mix]"), r"data\.rendered\.count"),
    (("[mix]", f'{SETS}blend_space = "dark"\n[mix]'), r"data\.rendered\.blend_space"),
    (("[mix]", "[mix]\nreflection_ratio = [0, 2]"), r"mix\.reflection_ratio\.0 is 0; .* above 0"),
    (("[mix]", "[mix]\ngamma = [1.2, 0.8]"), r"mix\.gamma is .* expected low <= high"),
    (("[mix]", "[mix]\nno_glass_probability = 1.5"), r"mix\.no_glass_probability"),
])  # fmt: skip
def test_a_wrong_recipe_is_refused_and_the_key_named(tmp_path, change, message):
    text = TINY.read_text()
    assert change[0] in text
    (tmp_path / "wrong.toml").write_bytes(text.replace(*change).encode("latin-1"))
    with pytest.raises(RecipeError, match=f"wrong.toml.*{message}"):
        read_recipe(tmp_path / "wrong.toml")


def test_a_recipe_with_a_backbone_is_a_lora_recipe():
    lora_recipes = {
        path.stem
        for path in FOLDER.glob("train/*.toml")
        if isinstance(read_recipe(path), LoraRecipe)
    }
    names = "kontext kontext-first-day kontext-real klein qwen lora-tiny lora-real-tiny"
    assert lora_recipes == set(names.split())
    assert isinstance(read_recipe(TINY), CompactRecipe)


def test_the_path_of_a_prompt_is_relative_to_the_recipe(tmp_path):
    text = KONTEXT.read_text().replace("rank = 16", 'rank = 16\nprompt = "mine.safetensors"')
    (tmp_path / "large.toml").write_text(text)
    assert read_recipe(tmp_path / "large.toml").prompt == str(tmp_path / "mine.safetensors")


@pytest.mark.parametrize(("change", "message"), [
    (('"int8"', '"int3"'), 'quantization is "int3"; expected one of "int8"'),
    (('"kontext"', '"tiny:kontext"'), ("are inconsistent; expected no quantization: a tiny "
                                      "backbone")),
    (('["I", "T", "R"]', '["I", "R"]'), "inconsistent; expected panels .* T, .*\\['I', 'R'\\]"),
    (('["I", "T", "R"]', '["T", "T"]'), "inconsistent; expected panels .* at most once"),
    (("rank = 16", "panel_weights = { I = 0, T = 0, R = 0 }"), ("inconsistent; expected a weight "
                                                               "above 0")),
    (("[data.rendered]", 'photos = ["p"]\n[data.rendered]\nshare = 0.5'), "inconsistent"),
])  # fmt: skip
def test_a_wrong_lora_recipe_is_refused_and_the_key_named(tmp_path, change, message):
    text = KONTEXT.read_text()
    assert change[0] in text
    (tmp_path / "wrong.toml").write_text(text.replace(*change, 1))
    with pytest.raises(RecipeError, match=f"wrong.toml.*{message}"):
        read_recipe(tmp_path / "wrong.toml")


SCENES = sorted(FOLDER.glob("render/*.toml"))
TRAINING = sorted(path for path in FOLDER.glob("**/*.toml") if path not in SCENES)


def refused(path, text):
    """The error for a scene recipe with this text."""
    path.write_text(text)
    with pytest.raises(RecipeError) as caught:
        read_toml(SceneRecipe, path, reference="docs/recipes.md")
    return caught.value


def test_all_problems_are_reported_at_once_with_file_key_value_and_what_is_allowed(tmp_path):
    text = """
name = "mine"
samples_per_pixel = 0
[glass]
double_probability = 2
thickness_mm = [5, 4]
[behind]
map_probabilty = 0.5
[camera_respons]
contrast = [0, 1]
"""
    found = str(refused(tmp_path / "mine.toml", text)).replace(f"{tmp_path}/", "").splitlines()
    assert found[1].startswith("mine.toml: samples_per_pixel is 0; expected integer, above 0;")
    names = "about samples_per_pixel double_prob thickness_mm map_prob camera_respons"
    for line, key in zip(found, names.split(), strict=True):
        assert key in line
    assert found[4].endswith("did you mean behind.map_probability?")


def test_an_error_with_several_problems_can_be_pickled(tmp_path):
    error = refused(tmp_path / "mine.toml", "")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert len(error.messages()) == 2


@pytest.mark.parametrize("name", [*RECIPES, *map(str, SCENES)])
def test_a_scene_recipe_that_is_printed_and_read_is_the_same(name):
    recipe = read_scene_recipe(name)
    assert SceneRecipe.model_validate(tomllib.loads(commented_toml(recipe))) == recipe


@pytest.mark.parametrize("name", [*TEMPLATES, *map(str, TRAINING)])
def test_a_training_recipe_that_is_printed_and_read_is_the_same(name):
    recipe = read_template(name)
    assert type(recipe).model_validate(tomllib.loads(commented_toml(recipe))) == recipe


def test_the_commands_show_recipes(run_without_model, tmp_path):
    code, out, _ = run_without_model("render", "--show-recipe", "office")
    assert (code, out.decode()) == (0, commented_toml(read_scene_recipe("office")))
    (tmp_path / "mine.toml").write_bytes(out)
    assert run_without_model("render", "--show-recipe", "mine.toml")[1] == out
    code, out, _ = run_without_model("train", "--show-recipe", "compact")
    assert (code, out.decode()) == (0, commented_toml(read_template("compact")))
    (tmp_path / "compact.toml").write_bytes(out)
    assert run_without_model("train", "--show-recipe", "compact.toml")[1] == out
