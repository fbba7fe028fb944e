from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvips
from hypothesis import given, settings
from hypothesis import strategies as st

import brewster
from brewster import Photo, Separator
from brewster.errors import BrewsterError, PhotoError
from brewster.inference import QUALITIES
from brewster.metrics import psnr, ssim
from brewster.photo import FileInfo

PICTURES = sorted((Path(__file__).parent / "pictures").glob("*.jpg"))


def glass(tile):
    """A pane that lets three quarters through."""
    return tile * 0.75, tile * 0.25


def nothing(tile):
    return tile, np.zeros_like(tile)


@pytest.fixture(scope="module")
def separator():
    return Separator.load("compact", device="cpu")


def picture(height, width, channels=3, dtype=np.uint8, seed=1):
    high = np.iinfo(dtype).max + 1
    return np.random.default_rng(seed).integers(0, high, (height, width, channels), dtype)


@settings(max_examples=25)
@given(
    st.integers(1, 60), st.integers(1, 60), st.sampled_from([1, 3, 4]), st.sampled_from([np.uint8, np.uint16])
)
def test_what_the_backend_leaves_alone_comes_back_bit_equal(height, width, channels, dtype):
    array = picture(height, width, channels, dtype)
    result = Separator(nothing)(Photo.from_array(array, encoding="srgb"))
    assert (result.transmission.pixels == result.photo.pixels).all()
    assert not result.reflection.pixels.any()
    assert result.residual == 0


@pytest.mark.parametrize("profile", ["srgb", "p3"])
def test_strength_nought_returns_the_photo_and_no_reflection_whatever_the_profile(profile):
    icc = bytes(pyvips.Image.profile_load(profile))
    photo = Photo(picture(300, 500), file_info=FileInfo(icc=icc))
    result = Separator(glass)(photo, strength=0)
    assert (result.transmission.pixels == photo.pixels).all()
    assert not result.reflection.pixels.any()
    assert result.transmission.file_info.icc == icc


def test_light_above_white_and_below_black_is_left_alone_too():
    light = np.random.default_rng(3).normal(1, 4, (50, 80, 3)).astype(np.float32)
    result = Separator(nothing)(light, encoding="linear")
    assert (result.transmission.linear() == light).all()


def test_a_brighter_picture_is_separated_like_the_same_picture_darker():
    def threshold(tile):
        return np.minimum(tile, 0.3), np.maximum(tile - 0.3, 0)

    light = np.random.default_rng(3).random((60, 60, 3), np.float32)
    light /= np.percentile(light, 99)
    dark, bright = (Separator(threshold)(scale * light, encoding="linear") for scale in (1, 50))
    np.testing.assert_allclose(
        bright.transmission.linear(), 50 * dark.transmission.linear(), rtol=5e-3, atol=1e-3
    )


def test_strength_goes_evenly_from_the_photo_to_the_whole_separation():
    photo = Photo.from_array(np.full((40, 40, 3), 0.5, np.float32), encoding="linear")
    light = [Separator(glass)(photo, strength=share).transmission.linear().mean() for share in (0, 0.5, 1)]
    np.testing.assert_allclose(light, [0.5, 0.4375, 0.375], atol=0.003)


@pytest.mark.parametrize("size", [(1, 1), (1, 700), (300, 20000), (2100, 1500)])
def test_size_in_is_size_out(size):
    result = Separator(glass)(Photo.from_array(picture(*size), encoding="srgb"), quality="draft")
    for layer in (result.transmission, result.reflection, result.confidence):
        assert layer.size == size[::-1]


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_additive_layers_sum_to_the_photo_to_the_last_bit(channels):
    photo = Photo.from_array(picture(200, 300, channels), encoding="srgb")

    def brighter_in_places(tile):
        return np.clip(tile * 1.5 - 0.2, 0, 1), tile * 0.1

    result = Separator(brighter_in_places)(photo, additive=True)
    layers = result.transmission.pixels, result.reflection.pixels
    light = photo.linear()[..., : photo.pixels.shape[2]]
    assert (layers[0] + layers[1] == light).all()
    assert min(layer.min() for layer in layers) >= 0
    assert result.residual == 0
    assert (result.transmission.alpha is None) == (photo.alpha is None)
    if photo.alpha is not None:
        np.testing.assert_allclose(result.transmission.alpha, photo.alpha / 255, atol=1e-6)


def test_the_unexplained_remainder_is_reported():
    photo = Photo.from_array(np.full((64, 64, 3), 0.4, np.float32), encoding="linear")
    result = Separator(lambda tile: (tile * 0.5, tile * 0.25))(photo)
    assert result.residual == pytest.approx(0.1, abs=0.005)


def test_light_that_is_too_much_and_light_that_is_missing_do_not_cancel_in_the_remainder():
    """Dark: 0.2 - 0.1 - 0.05 = 0.05 is missing. Bright: 0.6 - 0.3 - 0.45 = -0.15 is too much."""
    light = np.full((64, 64, 3), 0.2, np.float32)
    light[32:] = 0.6

    def uneven(tile):
        return tile * 0.5, np.where(tile < 0.4, tile * 0.25, tile * 0.75)

    photo = Photo.from_array(light, encoding="linear")
    assert Separator(uneven)(photo).residual == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(
    ("reconstruction_error", "doubtful"), [(None, False), (0.0, False), (0.05, False), (0.07, True)]
)
def test_a_separation_is_doubtful_where_the_model_redraws_the_photo(reconstruction_error, doubtful):
    separation = Separator(nothing)(picture(8, 8), encoding="srgb")
    assert replace(separation, reconstruction_error=reconstruction_error).doubtful == doubtful


def test_confidence_falls_where_the_two_views_disagree():
    def sees_left_from_right(tile):
        half = tile.shape[1] // 2
        answer = tile.copy()
        answer[:, :half] *= 0.5
        return answer, np.zeros_like(tile)

    grey = Photo.from_array(np.full((64, 64, 3), 128, np.uint8), encoding="srgb")
    assert Separator(nothing)(grey).confidence.pixels.min() == 255
    assert Separator(sees_left_from_right)(grey).confidence.pixels.max() < 50


def test_a_mixture_comes_closer_to_what_is_behind_the_glass(separator):
    """The mixture is 0.92 of the coffee picture plus a rocket: see tests/pictures/make.py."""
    data = pytest.importorskip("skimage.data")
    photo = Photo.open(next(path for path in PICTURES if "coffee" in path.name))
    result = separator(photo)
    assert psnr(result.transmission.pixels, data.coffee()) > psnr(photo.pixels, data.coffee()) + 1


def test_tiled_and_untiled_agree(separator, monkeypatch):
    photo = Photo.open(PICTURES[0])
    whole = separator(photo, quality="best").transmission.pixels
    monkeypatch.setattr("brewster.inference.predictor._TILE_PX", 416)
    assert psnr(separator(photo, quality="best").transmission.pixels, whole) > 40


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.stem)
def test_every_kind_of_source_gives_the_same_answer(separator, path):
    image = pytest.importorskip("PIL.Image")
    sources = [path, str(path), path.read_bytes(), image.open(path), Photo.open(path)]
    answers = [separator(source, quality="draft").transmission.pixels for source in sources]
    for answer in answers:
        assert (answer == answers[0]).all()


def test_the_same_photo_gives_the_same_bytes_whatever_came_before(separator):
    first = separator(PICTURES[0]).transmission.encode()
    separator(PICTURES[1])
    assert separator(PICTURES[0]).transmission.encode() == first


def test_the_line_in_the_readme_works(tmp_path):
    brewster.separate(PICTURES[0]).transmission.save(tmp_path / "b.jpg")
    assert Photo.open(tmp_path / "b.jpg").size == Photo.open(PICTURES[0]).size


@pytest.mark.parametrize("wrong", [{"strength": 1.5}, {"strength": -1}, {"quality": "superb"}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(BrewsterError):
        Separator(nothing)(Photo.from_array(picture(4, 4), encoding="srgb"), **wrong)


def test_every_quality_works_and_more_quality_sees_more_pixels():
    assert list(QUALITIES) == ["draft", "standard", "best"]
    seen = {}
    photo = Photo.from_array(picture(900, 1200), encoding="srgb")
    for quality in QUALITIES:
        sizes = []
        Separator(lambda tile, sizes=sizes: sizes.append(tile.size) or nothing(tile))(photo, quality=quality)
        seen[quality] = max(sizes)
    assert seen["draft"] < seen["standard"] < seen["best"]


def test_a_source_that_is_no_picture_is_refused():
    with pytest.raises(PhotoError):
        Separator(nothing)(b"hello")


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["nature", "real"])
def test_the_shipped_model_beats_doing_nothing_on_the_development_pairs(separator, data, folder):
    gains = []
    for path in sorted((data / "real/dev" / folder / "blended").iterdir()):
        (partner,) = (data / "real/dev" / folder).glob(f"transmission*/{path.stem}.*")
        photo, truth = Photo.open(path), Photo.open(partner).pixels
        answer = separator(photo).transmission.pixels
        gains.append([metric(answer, truth) - metric(photo.pixels, truth) for metric in (psnr, ssim)])
    assert len(gains) == 10
    assert (np.mean(gains, axis=0) > [0.4, 0]).all()


@pytest.mark.slow
def test_the_shipped_model_hardly_changes_photographs_without_glass(separator, data):
    photos = [Photo.open(data / "photos/permissive" / f"kodak24__{number:02}.jpg") for number in range(1, 11)]
    scores = [psnr(separator(photo).transmission.pixels, photo.pixels) for photo in photos]
    assert np.mean(scores) >= 32


@pytest.mark.parametrize("quality", QUALITIES)
def test_the_share_that_is_done_rises_to_one(quality):
    told = []
    Separator(glass)(
        Photo.from_array(picture(600, 900), encoding="srgb"), quality=quality, on_progress=told.append
    )
    assert told == sorted(told)
    assert (told[0], told[-1]) == (0, 1)
    assert len(told) > 4


@pytest.mark.parametrize("patience", [1, 3, 6])
def test_what_tell_raises_stops_the_work(patience):
    told, tiles = [], []

    def give_up(share):
        told.append(share)
        if len(told) == patience:
            raise TimeoutError

    def counting(tile):
        tiles.append(tile)
        return glass(tile)

    with pytest.raises(TimeoutError):
        Separator(counting)(Photo.from_array(picture(600, 900), encoding="srgb"), on_progress=give_up)
    assert len(told) == patience
    assert len(tiles) <= patience
