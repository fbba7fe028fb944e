"""Defaults and documentation of the Python API are those of `Options`."""

import inspect
from dataclasses import fields

import pytest

import brewster
from brewster import Separator
from brewster.options import DIFFUSION_OPTIONS, Options

LOAD, CALL = (inspect.signature(function) for function in (Separator.load, Separator.__call__))
SEPARATE = inspect.signature(brewster.separate)


@pytest.mark.parametrize("signature", [LOAD, CALL, SEPARATE])
def test_defaults_are_those_of_the_options(signature):
    shared = {field.name for field in fields(Options)} & set(signature.parameters)
    assert shared
    for name in shared:
        assert signature.parameters[name].default == getattr(Options, name)


def test_options_are_passed_to_the_functions_that_take_them():
    names = {field.name for field in fields(Options)}
    assert set(Options().load_options()) == names & set(LOAD.parameters)
    assert set(Options().call_options()) == names & set(CALL.parameters)
    assert set(SEPARATE.parameters) & names == set(Options().load_options()) | set(Options().call_options())
    assert set(DIFFUSION_OPTIONS) < set(LOAD.parameters)


@pytest.mark.parametrize("function", [Separator.load, Separator.__call__, brewster.separate])
def test_help_describes_every_parameter_once(function):
    text = inspect.getdoc(function)
    for name, parameter in inspect.signature(function).parameters.items():
        if name != "self" and parameter.kind is not parameter.VAR_KEYWORD:
            assert text.count(f"    {name}: ") == 1, name
