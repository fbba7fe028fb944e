"""Errors have three parts and can be sent between processes."""

import inspect
import math
import pickle
import re
from datetime import date
from typing import Annotated

import pytest
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from brewster import Separator, errors
from brewster.batch import plan_files
from brewster.diffusion.backbones.loading import load_backbone
from brewster.diffusion.tensors import read_tensors
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.evaluation.methods import PredictionFolder
from brewster.evaluation.study import study
from brewster.render.dataset.generation.workers import render_again
from brewster.render.environments.assets import read_catalog
from brewster.render.scene.recipe import read_scene_recipe
from brewster.render.scene.scene import read_scene
from brewster.training.data.image_loading import read_pairs
from brewster.training.data.rendered import RenderedDatasets
from brewster.training.loop import Checkpoint
from brewster.training.recipe import read_recipe

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


INVALID = [  # the field, a value, and the limit that it does not meet
    ("above", 0, "0"),
    ("above", 5, "5"),
    ("above", math.nan, ""),
    ("above", "much", ""),
    ("whole", 0, "1"),
    ("whole", 1.5, ""),
    ("name", "a", "2"),
    ("name", "abcde", "4"),
    ("name", "A1", "^[a-z]+$"),
    ("name", 1, ""),
    ("day", "yesterday", ""),
    ("time", "2026-01-31T12:00:00", "time zone"),
    ("sizes", 1, ""),
    ("sizes", [], "1"),
    ("ours", 3, "even"),
]


@pytest.mark.parametrize(("name", "value", "limit"), INVALID)
def test_an_invalid_value_is_named_with_its_limit_and_not_in_the_words_of_pydantic(
    name, value, limit
):
    details, error = refusal(name, value)
    assert name in error.happened
    assert repr(value) in error.happened
    assert limit in error.expected
    assert name in error.cure
    assert details["type"] not in error.expected  # as for the errors of a type without a text
    assert details["msg"] not in str(error)


def refusal(name, value):
    """What pydantic says about a value, and the error made of it."""
    with pytest.raises(ValidationError) as raised:
        Described.model_validate({name: value})
    (details,) = raised.value.errors()
    return details, errors.invalid_value(details)


def test_each_limit_of_a_field_has_a_text_of_its_own_and_examples_are_accepted():
    texts = [(name, refusal(name, value)[1].expected) for name, value, _ in INVALID]
    assert len(set(texts)) == len(texts)
    examples = [(name, re.search(r"such as (\S+)", text)) for name, text in texts]
    examples = {name: found[1] for name, found in examples if found}
    assert "day" in examples
    assert Described.model_validate(examples)


def test_an_unknown_type_of_error_is_named_and_a_long_value_is_shortened():
    error = errors.invalid_value({"type": "url_scheme", "loc": ("a", 0), "input": ["x" * 500]})
    assert "a.0" in error.happened
    assert "xxx" in error.happened
    assert len(error.happened) < 60
    assert "url_scheme" in error.expected


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
