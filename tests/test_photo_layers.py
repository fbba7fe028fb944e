"""Several pictures in one EXR: what comes back, what the channels are called, and what is refused."""

import io
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from brewster.errors import MissingExtra, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import Photo, read_layers, write_layers

NAMES = ("photo", "transmission", "background", "reflection", "mirror")
HEADER = {"scene": 'seed = 7\nrecipe = "Fenêtre"\n', "software": "brewster 0.1.0"}


def pictures(random, names=NAMES):
    return {name: (random.random((6, 9, 3), np.float32) * 4).astype(np.float32) for name in names}


def part_of(data, **options):
    exr = pytest.importorskip("OpenEXR")
    return exr.File(io.BytesIO(data), **options).parts[0]


@settings(max_examples=40, deadline=None, database=None)
@given(
    arrays.arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)),
        elements=st.floats(-60000, 60000, width=32),
    )
)
def test_layers_are_kept_in_half_precision(picture):
    again = read_layers(write_layers({"photo": picture, "mirror": picture * 2**-7}, {}))
    assert sorted(again) == ["mirror", "photo"]
    for name, light in (("photo", picture), ("mirror", picture * 2**-7)):
        assert again[name].dtype == np.float32
        np.testing.assert_allclose(again[name], light, rtol=2**-11, atol=2**-25)
    halfs = read_layers(write_layers(again, {}))
    assert all(np.array_equal(halfs[name], again[name]) for name in again)


def test_values_beyond_half_precision_are_clipped():
    picture = np.full((2, 2, 3), 1e9, np.float32)
    picture[0] = np.inf
    assert (read_layers(write_layers({"photo": picture}, {}))["photo"] == 65504).all()


def test_layers_are_separate_in_any_order(random):
    given_ = pictures(random)
    again = read_layers(write_layers(given_, HEADER))
    assert list(again) == sorted(NAMES)
    for name in NAMES:
        np.testing.assert_allclose(again[name], given_[name], rtol=1e-3)


def test_the_same_pictures_are_the_same_bytes_in_any_order(random):
    given_ = pictures(random)
    turned = {name: given_[name] for name in reversed(NAMES)}
    assert write_layers(given_, HEADER) == write_layers(turned, dict(reversed(HEADER.items())))


def test_other_programs_read_named_compressed_half_layers_and_the_text(random):
    data = write_layers(pictures(random), HEADER)
    exr = pytest.importorskip("OpenEXR")
    part = part_of(data, separate_channels=True)
    assert sorted(part.channels) == sorted(f"{name}.{channel}" for name in NAMES for channel in "RGB")
    assert {channel.pixels.dtype for channel in part.channels.values()} == {np.dtype(np.float16)}
    assert part.header["compression"] == exr.ZIP_COMPRESSION
    assert {key: part.header[key] for key in HEADER} == HEADER
    assert sorted(part_of(data).channels) == sorted(NAMES)  # grouped by what stands before the dot
    assert b"mirror.B\0\1\0\0\0" in data  # as the file's channel list spells a half


def test_a_layer_name_may_have_dots_and_other_channels_are_ignored(random):
    exr = pytest.importorskip("OpenEXR")
    half = np.ones((4, 5), np.float16)
    channels = {f"left.photo.{channel}": half for channel in "RGB"} | {"photo.Z": half, "depth.R": half}
    file = io.BytesIO()
    exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, channels).write(file)
    assert list(read_layers(file.getvalue())) == ["left.photo"]


@pytest.mark.parametrize("damage", [b"", b"no picture", None])
def test_a_damaged_file_is_refused(damage, random):
    data = write_layers(pictures(random), HEADER)
    with pytest.raises(UnreadablePhoto, match="complete"):
        read_layers(data[: len(data) // 2] if damage is None else damage)


def test_an_exr_without_layers_is_refused(random):
    photo = Photo.from_array(random.random((4, 4, 3), np.float32), encoding="linear")
    with pytest.raises(UnreadablePhoto, match=r"the channels B, G, R; .*name\.R"):
        read_layers(photo.encode("exr"))


def test_attributes_that_exr_would_drop_are_refused(random):
    with pytest.raises(UnsupportedPhoto, match="named version"):
        write_layers(pictures(random), {**HEADER, "version": "0.1.0"})


def test_without_openexr_the_error_names_the_extra(monkeypatch, random):
    data = write_layers(pictures(random), {})
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    for attempt in (lambda: read_layers(data), lambda: write_layers(pictures(random), {})):
        with pytest.raises(MissingExtra, match="pip install"):
            attempt()
