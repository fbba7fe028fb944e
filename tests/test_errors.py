"""Errors have three parts and can be sent between processes."""

import inspect
import math
import pickle
from datetime import date
from typing import Annotated

import pytest
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from brewster import Separator, errors
from brewster.batch import plan_files
from brewster.benchmarks.registry import read_benchmark
from brewster.environments.assets import read_catalog
from brewster.evaluate.methods import PredictionFolder
from brewster.models.diffusion.backbones.loading import load_backbone
from brewster.models.diffusion.tensors import read_tensors
from brewster.rendered.generation.workers import render_again
from brewster.scene.recipe import read_scene_recipe
from brewster.scene.scene import read_scene
from brewster.training.data.image_loading import read_pairs
from brewster.training.data.rendered import RenderedDatasets
from brewster.training.loop import Checkpoint
from brewster.training.recipe import read_recipe
from brewster.user_study import study

ERROR_CLASSES = [value for value in vars(errors).values() if inspect.isclass(value)]


@pytest.mark.parametrize("kind", ERROR_CLASSES)
def test_every_error_is_pickled_with_its_three_parts(kind):
    error = kind("the value is 7", "expected at most 5; 0 is allowed", "did you mean 5?")
    error.happened = "row 3: the value is 7"
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert (copy.happened, copy.expected, copy.cure) == (error.happened, error.expected, error.cure)
    assert str(copy) == "row 3: the value is 7; expected at most 5; 0 is allowed; did you mean 5?"


class Described(BaseModel):
    """A model with one field for each kind of limit."""

    model_config = ConfigDict(extra="forbid")

    above: Annotated[float, Field(gt=0, lt=5, allow_inf_nan=False)] = 1
    whole: Annotated[int, Field(ge=1)] = 1
    name: Annotated[str, Field(min_length=2, max_length=4, pattern="^[a-z]+$")] = "abc"
    day: date = date(2026, 1, 31)
    time: AwareDatetime | None = None
    sizes: Annotated[tuple[int, ...], Field(min_length=1)] = (1,)
    ours: Annotated[int, AfterValidator(lambda _: fail("expected an even number"))] = 2


def fail(message):
    raise ValueError(message)


@pytest.mark.parametrize(("name", "value", "expected"), [
    ("above", 0, "a number above 0"), ("above", 5, "a number below 5"),
    ("above", math.nan, "a finite number"), ("above", "much", "a number"),
    ("whole", 0, "a number of at least 1"), ("whole", 1.5, "an integer"),
    ("name", "a", "at least 2 characters"), ("name", "abcde", "at most 4 characters"),
    ("name", "A1", "a text that matches ^[a-z]+$"), ("name", 1, "a text"),
    ("day", "yesterday", "a date such as 2026-01-31"),
    ("time", "2026-01-31T12:00:00", "a time with its time zone"), ("sizes", 1, "a list"),
    ("sizes", [], "at least 1 entries"), ("ours", 3, "an even number"),
])  # fmt: skip
def test_an_invalid_value_gives_three_parts_without_the_words_of_pydantic(name, value, expected):
    with pytest.raises(ValidationError) as raised:
        Described.model_validate({name: value})
    error = errors.invalid_value(raised.value.errors()[0])
    assert str(error) == f"{name} is {value!r}; expected {expected}; correct {name}."


def test_an_unknown_type_of_error_is_named_and_a_long_value_is_shortened():
    error = errors.invalid_value({"type": "url_scheme", "loc": ("a", 0), "input": ["x" * 500]})
    assert error.happened == f"a.0 is ['{'x' * 38}"
    assert error.expected == "expected a valid value (url_scheme)"


READERS = {
    "backbone": lambda path: load_backbone(str(path)),
    "benchmark": lambda path: read_benchmark("pairs", path), "checkpoint": Checkpoint.read,
    "list of photos": lambda path: plan_files(path.with_suffix(".csv")),
    "maps": lambda path: read_catalog([path], []),
    "model": lambda path: Separator.load(str(path.with_suffix(".onnx"))),
    "pairs for training": lambda path: read_pairs([path]),
    "photos": lambda path: read_catalog([], [path]),
    "predictions": lambda path: PredictionFolder("theirs", path).check_pairing([]),
    "rendered benchmark": lambda path: read_benchmark("rendered", path),
    "rendered dataset": lambda path: RenderedDatasets([path], seed=1), "scene": read_scene,
    "scene recipe": lambda path: read_scene_recipe(str(path.with_suffix(".toml"))),
    "scene to render again": lambda path: render_again(path, path.with_name("out")),
    "study": study.read_study, "tensors": read_tensors, "training recipe": read_recipe,
}  # fmt: skip


@pytest.mark.parametrize("kind", READERS)
def test_a_file_or_folder_that_is_missing_or_damaged_is_an_error_that_names_it(kind, tmp_path):
    for name in ("missing", "damaged"):
        with pytest.raises(errors.BrewsterError, match=name) as raised:
            READERS[kind](tmp_path / name)
        assert raised.value.cure
        for suffix in ("", ".csv", ".onnx", ".toml"):
            (tmp_path / "damaged").with_suffix(suffix).write_bytes(b"\xff damaged")
