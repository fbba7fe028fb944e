"""Errors have three parts and can be sent between processes."""

import inspect
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from brewster import errors
from brewster.errors import PhotoError

EVERY = [value for value in vars(errors).values() if inspect.isclass(value)]


def fail():
    raise PhotoError("the width is odd", "even; or square", "crop it")


@pytest.mark.parametrize("kind", EVERY)
def test_every_error_is_pickled_with_its_three_parts(kind):
    error = kind("the value is 7", "a number; at most 5", "did you mean 5?")
    error.happened = "row 3: the value is 7"
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (again.happened, again.expected, again.cure) == (error.happened, error.expected, error.cure)
    assert str(again) == "row 3: the value is 7; a number; at most 5; did you mean 5?"


def test_an_error_that_is_raised_in_a_worker_arrives_as_it_is():
    with ProcessPoolExecutor(1, get_context("spawn")) as pool, pytest.raises(PhotoError) as raised:
        pool.submit(fail).result()
    assert str(raised.value) == "the width is odd; even; or square; crop it."
    assert raised.value.cure == "crop it"
