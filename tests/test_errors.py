"""Errors say three things, and survive the way from one process to another."""

import inspect
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from brewster import errors
from brewster.errors import PhotoError

EVERY = [value for value in vars(errors).values() if inspect.isclass(value)]


def refuse():
    raise PhotoError("the picture is odd", "even; or square", "paint another")


@pytest.mark.parametrize("kind", EVERY)
def test_every_error_is_pickled_with_its_three_parts(kind):
    error = kind("the lamp is out", "a lamp; or two", "did you mean lamp?")
    error.happened = "room 7: the lamp is out"
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (again.happened, again.expected, again.cure) == (error.happened, error.expected, error.cure)
    assert str(again) == "room 7: the lamp is out; a lamp; or two; did you mean lamp?"


def test_an_error_that_is_raised_in_a_worker_arrives_as_it_is():
    with ProcessPoolExecutor(1, get_context("spawn")) as pool, pytest.raises(PhotoError) as raised:
        pool.submit(refuse).result()
    assert str(raised.value) == "the picture is odd; even; or square; paint another."
    assert raised.value.cure == "paint another"
