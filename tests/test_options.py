"""Defaults and documentation of the Python API are those of `Options`."""

import inspect
import pickle
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

import brewster
from brewster import Separator
from brewster.errors import BrewsterError
from brewster.options import LoadOptions, Options, SeparateOptions

LOAD, CALL = (inspect.signature(function) for function in (Separator.load, Separator.__call__))
SEPARATE = inspect.signature(brewster.separate)


@pytest.mark.parametrize("signature", [LOAD, CALL, SEPARATE])
def test_defaults_are_those_of_the_options(signature):
    shared = {field.name for field in fields(Options)} & set(signature.parameters)
    assert shared
    for name in shared:
        assert signature.parameters[name].default == getattr(Options, name)


def test_options_are_passed_to_the_functions_that_take_them():
    """Each option but the layers and their format is a keyword of Python, with the type that `Options` has."""
    types, keywords = get_type_hints(Options), get_type_hints(SeparateOptions)
    assert types.keys() - keywords.keys() == {"layers", "format", "model", "mask", "hints"}
    assert {name: types[name] for name in keywords} == keywords
    assert set(Options().load_options()) == {"model", *get_type_hints(LoadOptions)}
    assert set(Options().call_options()) == types.keys() & set(CALL.parameters)
    others = {"self", "source", "encoding", "on_progress", "mask", "hints"}
    assert set(CALL.parameters) - others < keywords.keys()


@pytest.mark.parametrize(
    "function", [Separator.load, partial(brewster.separate, np.zeros((8, 8, 3), np.uint8))]
)
def test_an_unknown_option_is_refused(function):
    with pytest.raises(TypeError, match="there is no option strenght; expected device, "):
        function(strenght=0.5)


@pytest.mark.parametrize(("values", "message"), [
    ({"format": "gif"}, "format is 'gif'; expected 'jpeg', 'png', .*; correct format"),
    ({"layers": "transmission"}, "layers is 'transmission'; expected a list; correct layers"),
    ({"layers": ()}, "layers is empty; expected at least one layer"),
    ({"strength": float("nan")}, "strength is nan; expected a finite number; correct strength"),
    ({"guidance": float("inf")}, "guidance is inf; expected a finite number; correct guidance"),
    ({"additive": "perhaps"}, "additive is 'perhaps'; expected true or false"),
    ({"additive": True, "format": "jpg"}, "additive layers were requested as jpeg; expected tiff or exr"),
])  # fmt: skip
def test_an_invalid_value_is_refused_when_the_options_are_built(values, message):
    with pytest.raises(BrewsterError, match=message):
        Options(**values)


def test_values_are_converted_to_the_types_of_their_fields():
    options = Options(layers=["confidence"], format=".JPG", mask="mask.png", strength=np.float32(0.5))
    assert options == Options(layers=("confidence",), format="jpeg", mask=Path("mask.png"), strength=0.5)
    assert type(options.strength) is float
    assert pickle.loads(pickle.dumps(options)) == options
