"""Several layers in one EXR: values, names of the channels, and errors."""

import io

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from brewster.errors import UnsupportedPhoto
from brewster.photo import read_exr_layers, write_exr_layers
from picture_files import exr_of

NAMES = ("photo", "transmission", "background", "reflection", "mirror")
HEADER = {"scene": 'seed = 7\nrecipe = "Fenêtre"\n', "software": "brewster 0.1.0"}


def random_layers(rng, names=NAMES):
    return {name: (rng.random((6, 9, 3), np.float32) * 4).astype(np.float32) for name in names}


def read_part(data, **options):
    return OpenEXR.File(io.BytesIO(data), **options).parts[0]


SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))


@settings(max_examples=40, deadline=None, database=None)
@given(arrays.arrays(np.float32, SHAPES, elements=st.floats(-60000, 60000, width=32)))
def test_layers_are_kept_in_half_precision(image):
    again = read_exr_layers(write_exr_layers({"photo": image, "mirror": image * 2**-7}, {}))
    assert sorted(again) == ["mirror", "photo"]
    for name, light in (("photo", image), ("mirror", image * 2**-7)):
        assert again[name].dtype == np.float32
        np.testing.assert_allclose(again[name], light, rtol=2**-11, atol=2**-25)
    halves = read_exr_layers(write_exr_layers(again, {}))
    assert all(np.array_equal(halves[name], again[name]) for name in again)


def test_values_beyond_half_precision_are_clipped():
    image = np.full((2, 2, 3), 1e9, np.float32)
    image[0] = np.inf
    assert (read_exr_layers(write_exr_layers({"photo": image}, {}))["photo"] == 65504).all()


def test_the_same_layers_give_the_same_bytes_in_any_order(rng):
    layers = random_layers(rng)
    reversed_layers = {name: layers[name] for name in reversed(NAMES)}
    assert write_exr_layers(layers, HEADER) == write_exr_layers(
        reversed_layers, dict(reversed(HEADER.items()))
    )


def test_other_programs_read_named_compressed_half_layers_and_the_text(rng):
    data = write_exr_layers(random_layers(rng), HEADER)
    part = read_part(data, separate_channels=True)
    assert sorted(part.channels) == sorted(
        f"{name}.{channel}" for name in NAMES for channel in "RGB"
    )
    assert {channel.pixels.dtype for channel in part.channels.values()} == {np.dtype(np.float16)}
    assert part.header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert {key: part.header[key] for key in HEADER} == HEADER
    assert sorted(read_part(data).channels) == sorted(
        NAMES
    )  # grouped by the part of the name before the dot
    assert b"mirror.B\0\1\0\0\0" in data  # the channel list of the file: pixel type 1 is half


def test_a_layer_name_may_have_dots_and_other_channels_are_ignored(rng):
    half = np.ones((4, 5), np.float16)
    channels = {f"left.photo.{channel}": half for channel in "RGB"} | {
        "photo.Z": half,
        "depth.R": half,
    }
    assert list(read_exr_layers(exr_of(channels))) == ["left.photo"]


def test_attributes_that_exr_would_drop_are_refused(rng):
    with pytest.raises(UnsupportedPhoto, match="have the names version"):
        write_exr_layers(random_layers(rng), {**HEADER, "version": "0.1.0"})
