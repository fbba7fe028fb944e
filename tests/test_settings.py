"""Recipe files: all problems are reported at once, and a recipe is printed with all its keys."""

import pickle
import tomllib
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field

from brewster.errors import RecipeError
from brewster.scene.recipe import RECIPES, SceneRecipe, read_scene_recipe
from brewster.settings import FrozenModel, LogRange, Pixels, Share, commented_toml, read_toml, tables
from brewster.training.recipe import TEMPLATES, read_template

_FOLDER = Path(__file__).parents[1] / "recipes"
SCENES = sorted(_FOLDER.glob("render/*.toml"))
TRAINING = sorted(path for path in _FOLDER.glob("**/*.toml") if path not in SCENES)


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


class Inner(FrozenModel):
    """An inner table."""

    width_px: Pixels = 64
    """A width."""
    mode: Literal["fast", "slow"] | None = None
    """A mode."""


class Outer(FrozenModel):
    """A recipe."""

    length_mm: LogRange = (1.0, 2.0)
    """A length,
    over two lines."""
    shares: Annotated[list[Share], Field(min_length=1)]
    """Some shares."""
    inner: Inner | None = None
    """An optional table."""


def keys(model):
    return {key.path: key for table in tables(model) for key in table.keys}


def test_a_key_has_type_allowed_values_unit_default_and_meaning():
    found = keys(Outer)
    assert list(found) == ["length_mm", "shares", "inner.width_px", "inner.mode"]
    values = "range [low, high] above 0, sampled log-uniformly"
    assert found["length_mm"][1:] == (values, "mm", "default [1.0, 2.0]", "A length, over two lines.")
    assert found["shares"].values == "list of number, at least 0, at most 1, with 1 or more entries"
    assert found["shares"].default == "required"
    assert (found["inner.width_px"].values, found["inner.width_px"].unit) == ("integer, at least 16", "px")
    assert found["inner.mode"][1:4] == ('one of "fast", "slow"', "", "not set by default")
