import inspect
import pickle
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import pyvips
from hypothesis import given, settings
from hypothesis import strategies as st

import brewster
from brewster import Photo, Separator
from brewster.base.image_formats import SUFFIXES
from brewster.errors import BrewsterError
from brewster.film import separate_video
from brewster.metrics import psnr, ssim
from brewster.options import LoadOptions, Options, field_schemas, option_names
from brewster.photo import FileInfo
from brewster.separation import QUALITIES
from brewster.separation.guided_upsampling import GeneratedOverride
from brewster.separation.predictor import Prediction, Predictor
from picture_files import random_image

PHOTOS = sorted((Path(__file__).parent / "pictures").glob("*.jpg"))


def glass_backend(tile):
    """T = 0.75 I and R = 0.25 I."""
    return tile * 0.75, tile * 0.25


def identity_backend(tile):
    """T = I and R = 0."""
    return tile, np.zeros_like(tile)


@pytest.fixture(scope="module")
def separator():
    return Separator.load("compact", device="cpu")


@settings(max_examples=25)
@given(
    *[st.integers(1, 60)] * 2, st.sampled_from([1, 3, 4]), st.sampled_from([np.uint8, np.uint16])
)
def test_an_unchanged_photo_is_returned_bit_equal(height, width, channels, dtype):
    array = random_image(height, width, channels, dtype)
    result = Separator(identity_backend)(Photo.from_array(array, encoding="srgb"))
    assert (result.transmission.pixels == result.photo.pixels).all()
    assert not result.reflection.pixels.any()
    assert result.residual == 0


@pytest.mark.parametrize("profile", ["srgb", "p3"])
def test_strength_zero_returns_the_photo_and_no_reflection_with_any_profile(profile):
    icc = bytes(pyvips.Image.profile_load(profile))
    photo = Photo(random_image(300, 500), file_info=FileInfo(icc=icc))
    result = Separator(glass_backend)(photo, strength=0)
    assert (result.transmission.pixels == photo.pixels).all()
    assert not result.reflection.pixels.any()
    assert result.next_step is None
    assert result.transmission.file_info.icc == icc


def test_unchanged_light_above_white_and_below_black_is_kept():
    light = np.random.default_rng(3).normal(1, 4, (50, 80, 3)).astype(np.float32)
    result = Separator(identity_backend)(light, encoding="linear")
    assert (result.transmission.linear() == light).all()


def test_a_photo_above_white_is_separated_like_the_same_photo_with_less_light():
    def threshold(tile):
        return np.minimum(tile, 0.3), np.maximum(tile - 0.3, 0)

    light = np.random.default_rng(3).random((60, 60, 3), np.float32)
    light /= np.percentile(light, 99)
    dark, bright = (Separator(threshold)(scale * light, encoding="linear") for scale in (1, 50))
    expected = 50 * dark.transmission.linear()
    np.testing.assert_allclose(bright.transmission.linear(), expected, rtol=5e-3, atol=1e-3)


def test_strength_is_linear_between_the_photo_and_the_full_separation():
    photo = Photo.from_array(np.full((40, 40, 3), 0.5, np.float32), encoding="linear")
    light = [
        Separator(glass_backend)(photo, strength=strength).transmission.linear().mean()
        for strength in (0, "0.5", 1)  # as a text, as `Options` takes it
    ]
    np.testing.assert_allclose(light, [0.5, 0.4375, 0.375], atol=0.003)


@pytest.mark.parametrize("size", [(1, 1), (1, 700), (300, 20000), (2100, 1500)])
def test_layers_and_confidence_have_the_size_of_the_photo(size):
    result = Separator(glass_backend)(
        Photo.from_array(random_image(*size), encoding="srgb"), quality="draft"
    )
    for layer in (result.transmission, result.reflection, result.confidence):
        assert layer.size == size[::-1]


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_additive_layers_sum_to_the_photo_to_the_last_bit(channels):
    photo = Photo.from_array(random_image(200, 300, channels), encoding="srgb")

    def partly_brighter(tile):
        return np.clip(tile * 1.5 - 0.2, 0, 1), tile * 0.1

    result = Separator(partly_brighter)(photo, additive=True)
    layers = result.transmission.pixels, result.reflection.pixels
    light = photo.linear()[..., : photo.pixels.shape[2]]
    assert (layers[0] + layers[1] == light).all()
    assert min(layer.min() for layer in layers) >= 0
    assert result.residual == 0
    assert (result.transmission.alpha is None) == (photo.alpha is None)
    if photo.alpha is not None:
        np.testing.assert_allclose(result.transmission.alpha, photo.alpha / 255, atol=1e-6)


def test_positive_and_negative_differences_do_not_cancel_in_the_residual():
    """I - T - R is 0.2 - 0.1 - 0.05 = 0.05 in the dark half, and 0.6 - 0.3 - 0.45 = -0.15 in the
    bright half.
    """
    light = np.full((64, 64, 3), 0.2, np.float32)
    light[32:] = 0.6

    def brightness_dependent(tile):
        return tile * 0.5, np.where(tile < 0.4, tile * 0.25, tile * 0.75)

    photo = Photo.from_array(light, encoding="linear")
    assert Separator(brightness_dependent)(photo).residual == pytest.approx(0.1, abs=0.01)


def test_confidence_falls_where_the_flipped_prediction_disagrees():
    def left_right_dependent(tile):
        half = tile.shape[1] // 2
        transmission = tile.copy()
        transmission[:, :half] *= 0.5
        return transmission, np.zeros_like(tile)

    grey = Photo.from_array(np.full((64, 64, 3), 128, np.uint8), encoding="srgb")
    assert Separator(identity_backend)(grey).confidence.pixels.min() == 255
    assert Separator(left_right_dependent)(grey).confidence.pixels.max() < 50


def test_the_transmission_of_a_mixture_is_closer_to_the_background(separator):
    """The photo is 0.92 times the image of coffee plus the image of a rocket (see
    tests/pictures/make.py).
    """
    data = pytest.importorskip("skimage.data")
    photo = Photo.open(next(path for path in PHOTOS if "coffee" in path.name))
    result = separator(photo)
    assert psnr(result.transmission.pixels, data.coffee()) > psnr(photo.pixels, data.coffee()) + 1


@pytest.mark.parametrize("path", PHOTOS, ids=lambda path: path.stem)
def test_every_kind_of_source_gives_the_same_transmission(separator, path):
    image = pytest.importorskip("PIL.Image")
    sources = [path, str(path), path.read_bytes(), image.open(path), Photo.open(path)]
    transmissions = [separator(source, quality="draft").transmission.pixels for source in sources]
    for transmission in transmissions:
        assert (transmission == transmissions[0]).all()


@pytest.mark.parametrize("options", [{"strength": 1.5}, {"strength": -1}, {"quality": "best"}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(BrewsterError):
        Separator(identity_backend)(
            Photo.from_array(random_image(4, 4), encoding="srgb"), **options
        )


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["nature", "real"])
def test_the_shipped_model_beats_the_unprocessed_input_on_the_development_pairs(
    separator, data, folder
):
    gains = []
    for path in sorted((data / "real/dev" / folder / "blended").iterdir()):
        (partner,) = (data / "real/dev" / folder).glob(f"transmission*/{path.stem}.*")
        photo = Photo.open(path)
        ground_truth = Photo.open(partner).pixels
        transmission = separator(photo).transmission.pixels
        scores = [
            [metric(each, ground_truth) for metric in (psnr, ssim)]
            for each in (transmission, photo.pixels)
        ]
        gains.append(np.subtract(*scores))
    assert len(gains) == 10
    assert (np.mean(gains, axis=0) > [0.4, 0]).all()


@pytest.mark.slow
def test_the_shipped_model_hardly_changes_photos_without_glass(separator, data):
    photos = [
        Photo.open(data / "photos/permissive" / f"kodak24__{number:02}.jpg")
        for number in range(1, 11)
    ]
    scores = [psnr(separator(photo).transmission.pixels, photo.pixels) for photo in photos]
    assert np.mean(scores) >= 32


@pytest.mark.parametrize("quality", QUALITIES)
def test_progress_rises_to_one(quality):
    photo = Photo.from_array(random_image(600, 900), encoding="srgb")
    progress = []
    Separator(glass_backend)(photo, quality=quality, on_progress=progress.append)
    assert progress == sorted(progress)
    assert (progress[0], progress[-1]) == (0, 1)
    assert len(progress) > 4


@pytest.mark.parametrize("calls_until_error", [1, 3, 6])
def test_an_exception_in_on_progress_stops_the_work(calls_until_error):
    progress = []
    tiles = []

    def stop(fraction):
        progress.append(fraction)
        if len(progress) == calls_until_error:
            raise TimeoutError

    def recording_backend(tile):
        tiles.append(tile)
        return glass_backend(tile)

    photo = Photo.from_array(random_image(600, 900), encoding="srgb")
    with pytest.raises(TimeoutError):
        Separator(recording_backend)(photo, on_progress=stop)
    assert len(progress) == calls_until_error
    assert len(tiles) <= calls_until_error


class Generating(Predictor):
    """A predictor that replaces the transmission by a generated one, half of its input."""

    def input_sizes(self, size, quality):
        return [size]

    def __call__(self, inputs, quality, on_progress):
        (image,) = inputs
        ones = np.ones_like(image[..., :1])
        return Prediction(-image / 4, image / 4, ones, GeneratedOverride(image / 2, ones))


def test_the_generated_layers_of_a_photo_brighter_than_white_scale_with_its_light(rng):
    light = 0.5 * rng.random((24, 32, 3), np.float32)
    light[:, :2] = 1  # a lamp, which stays as it is
    once, twice = (
        Separator(Generating())(Photo.from_array(scale * light, encoding="linear"))
        for scale in (2, 4)
    )
    np.testing.assert_allclose(twice.transmission.pixels, 2 * once.transmission.pixels, rtol=1e-5)
    np.testing.assert_allclose(
        once.transmission.pixels[:, 12:].mean(), light[:, 12:].mean(), rtol=0.02
    )


class Deriving(Predictor):
    """A predictor of a smooth transmission at a quarter of the size, and of no reflection."""

    def input_sizes(self, size, quality):
        return [(size[0] // 4, size[1] // 4)]

    def __call__(self, inputs, quality, on_progress):
        (image,) = inputs
        ones = np.ones_like(image[..., :1])
        override = GeneratedOverride(np.full_like(image, 0.1), ones / 2)
        return Prediction(
            -image / 4, image / 4, ones, override=override, reflection_is_derived=True
        )


@pytest.mark.parametrize("strength", [1, 0.5])
def test_a_derived_reflection_is_the_light_that_the_transmission_lacks(rng, strength):
    light = rng.uniform(0.3, 0.6, (40, 48, 3)).astype(np.float32)
    result = Separator(Deriving())(Photo.from_array(light, encoding="linear"), strength=strength)
    assert result.reflection.pixels.max() > 0.1
    whole = result.transmission.pixels + result.reflection.pixels
    np.testing.assert_allclose(whole, light, atol=1e-6)
    assert result.residual == pytest.approx(0, abs=1e-6)


LOAD, CALL = (inspect.signature(function) for function in (Separator.load, Separator.__call__))
SEPARATE, BURST, VIDEO = (
    inspect.signature(function)
    for function in (brewster.separate, brewster.separate_burst, separate_video)
)


@pytest.mark.parametrize("signature", [LOAD, CALL, SEPARATE, BURST, VIDEO])
def test_defaults_are_those_of_the_options(signature):
    shared = {field.name for field in fields(Options)} & set(signature.parameters)
    assert shared
    for name in shared:
        assert signature.parameters[name].default == getattr(Options, name)


def test_options_are_passed_to_the_functions_that_take_them():
    """Each option of a group is a keyword of the functions that take the group, with its type. A
    painted image may be in memory in Python.
    """
    types = get_type_hints(Options)
    load = get_type_hints(LoadOptions)
    assert {"model": str, **load} == {name: types[name] for name in option_names("load")}
    assert set(Options().load_options()) == {"model", *load}
    call = set(option_names("call"))
    assert set(Options().call_options()) == call
    assert set(CALL.parameters) - {"self", "source", "encoding", "on_progress"} == call
    for signature in (CALL, SEPARATE, BURST):
        own = {name: each.annotation for name, each in signature.parameters.items()}
        assert call <= own.keys()
        assert own["mask"] == own["hints"] == "Source | None"
        shared = own.keys() & types.keys() - {"mask", "hints"}
        assert {name: own[name] for name in shared} == {
            name: Options.__annotations__[name] for name in shared
        }


def test_every_option_has_a_description_and_belongs_to_one_group():
    groups = ("batch", "call", "load", "burst")
    names = [name for group in groups for name in option_names(group)]
    assert sorted(names) == sorted(field.name for field in fields(Options))
    for name, schema in field_schemas(Options).items():
        assert schema["description"].endswith("."), name


@pytest.mark.parametrize(
    "function", [Separator.load, partial(brewster.separate, np.zeros((8, 8, 3), np.uint8))]
)
def test_an_unknown_option_is_refused(function):
    with pytest.raises(TypeError, match=r"there is no option strenght; expected .*device, "):
        function(strenght=0.5)


@pytest.mark.parametrize(("values", "message"), [
    ({"format": "gif"}, "format is 'gif'; expected 'jpeg', 'png', .*; correct format"),
    ({"layers": "transmission"}, "layers is 'transmission'; expected a list; correct layers"),
    ({"layers": ()}, "layers is empty; expected at least one layer"),
    ({"strength": float("nan")}, "strength is nan; expected a finite number; correct strength"),
    ({"guidance": float("inf")}, "guidance is inf; expected a finite number; correct guidance"),
    ({"additive": "perhaps"}, "additive is 'perhaps'; expected true or false"),
    ({"additive": True, "format": "jpg"}, ("additive layers were requested as jpeg; expected tiff "
                                          "or exr")),
])  # fmt: skip
def test_an_invalid_value_is_refused_when_the_options_are_built(values, message):
    with pytest.raises(BrewsterError, match=message):
        Options(**values)


@pytest.mark.parametrize(
    ("name", "limit", "step"),
    [
        (field.name, field.metadata[kind], step)
        for field in fields(Options)
        for kind, step in (("ge", -1), ("le", 1))
        if kind in field.metadata
    ],
)
def test_a_number_may_have_the_value_of_its_limit_and_not_one_beyond(name, limit, step):
    assert getattr(Options(**{name: limit}), name) == limit
    with pytest.raises(BrewsterError, match=name):
        Options(**{name: limit + step})


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    "options", [Options(), Options(format="tif"), Options(additive=True)], ids=str
)
def test_a_layer_of_a_photo_in_capitals_has_the_same_format(options, suffix):
    for layer in ("transmission", "reflection", "confidence"):
        written = options.suffix(layer, suffix.upper())
        assert written.lower() == options.suffix(layer, suffix)
        assert written in (suffix.upper(), written.lower())


def test_values_are_converted_to_the_types_of_their_fields():
    options = Options(
        layers=["confidence"], format=".JPG", mask="mask.png", strength=np.float32(0.5)
    )
    assert options == Options(
        layers=("confidence",), format="jpeg", mask=Path("mask.png"), strength=0.5
    )
    assert type(options.strength) is float
    assert pickle.loads(pickle.dumps(options)) == options
