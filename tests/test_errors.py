"""Errors have three parts and can be sent between processes."""

import inspect
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from brewster import errors
from brewster.errors import PhotoError

ERROR_CLASSES = [value for value in vars(errors).values() if inspect.isclass(value)]


def raise_photo_error():
    raise PhotoError("the width is 7", "expected an even width", "crop the image")


@pytest.mark.parametrize("kind", ERROR_CLASSES)
def test_every_error_is_pickled_with_its_three_parts(kind):
    error = kind("the value is 7", "expected at most 5; 0 is allowed", "did you mean 5?")
    error.happened = "row 3: the value is 7"
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert (copy.happened, copy.expected, copy.cure) == (error.happened, error.expected, error.cure)
    assert str(copy) == "row 3: the value is 7; expected at most 5; 0 is allowed; did you mean 5?"


def test_an_error_that_is_raised_in_a_worker_arrives_unchanged():
    with ProcessPoolExecutor(1, get_context("spawn")) as pool, pytest.raises(PhotoError) as raised:
        pool.submit(raise_photo_error).result()
    assert str(raised.value) == "the width is 7; expected an even width; crop the image."
    assert raised.value.cure == "crop the image"
