"""The assessment of a separation: what was removed, where, how reliably, and the verdict."""

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster import Photo, Separator
from brewster.separation.assessment import Verdict, assess, next_step
from brewster.separation.models.zoo import MODELS

SIZE = (24, 32)


def grey(value):
    return np.full((*SIZE, 3), value, np.float32)


def certain(value=1.0):
    return np.full((*SIZE, 1), value, np.float32)


@pytest.mark.parametrize(
    ("photo", "transmission", "confidence", "more", "verdict", "removed_light"),
    [
        (0.4, 0.4, 0.2, {}, "little found", 0),
        (0.0, 0.0, 1.0, {}, "little found", 0),
        (0.2, 0.3, 1.0, {}, "partly removed", 0),  # added light is not removed light
        (0.4, 0.36, 0.5, {}, "reflection remains", 0.1),
        (0.4, 0.2, 0.0, {"is_calibrated": True}, "partly removed", 0.5),
        (0.4, 0.2, 1.0, {"reconstruction_error": 0.05}, "partly removed", 0.5),
        (0.4, 0.2, 1.0, {"reconstruction_error": 0.07}, "doubtful", 0.5),
        (0.4, 0.2, 1.0, {"reconstruction_error": 1.0, "strength": 0.0}, "little found", 0),
        (0.4, 0.2, 1.0, {"reconstruction_error": 1.0, "strength": 0.1}, "doubtful", 0.05),
    ],
)
def test_the_verdict_on_a_uniform_change(
    photo, transmission, confidence, more, verdict, removed_light
):
    found = assess(grey(photo), grey(transmission), certain(confidence), **more)
    assert (found.verdict, found.removed_light) == (verdict, pytest.approx(removed_light))


def test_half_of_the_light_removed_from_a_quarter_of_the_photo_is_measured():
    transmission = grey(0.4)
    transmission[:12, :16] = 0.2
    confidence = certain(0.9)
    confidence[12:] = 0.5  # where nothing changed
    found = assess(grey(0.4), transmission, confidence)
    assert found.removed_light == pytest.approx(1 / 8)
    assert found.changed_area == pytest.approx(1 / 4)
    assert found.confidence == pytest.approx(0.9)
    assert found.verdict == "partly removed"


@pytest.mark.parametrize("takes_hints", [False, True])
@pytest.mark.parametrize("verdict", get_args(Verdict))
def test_a_next_step_is_named_exactly_where_little_was_removed(verdict, takes_hints):
    step = next_step(verdict, takes_hints=takes_hints)
    assert (step is not None) == (verdict in ("little found", "reflection remains"))
    if step:
        assert "film" in step
        assert ("hints" in step) == takes_hints
    without_films = next_step(verdict, takes_hints=takes_hints, takes_films=False)
    assert "film" not in (without_films or "")
    assert ("mark" in (without_films or "")) == ("mark" in (step or ""))


def test_marks_are_advised_to_a_model_that_takes_them_until_there_are_some():
    class Unchanged:
        takes_hints = True

        def __call__(self, tile, hints=None):
            return tile, 0 * tile

    photo = Photo.from_array(grey(0.5), encoding="linear")
    strokes = np.zeros((*SIZE, 3), np.uint8)
    strokes[2:6, 2:6, 0] = 255
    separator = Separator(Unchanged())
    assert "mark" in separator(photo).next_step
    assert "mark" not in separator(photo, hints=strokes).next_step
    assert separator(photo, strength=0).next_step is None
    assert "mark" not in Separator(lambda tile: (tile, 0 * tile))(photo).next_step


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_less_confidence_never_gives_a_better_verdict(is_calibrated):
    order = [name for name in get_args(Verdict) if name != "little found"]
    verdicts = [
        assess(grey(0.4), grey(0.2), certain(value), is_calibrated=is_calibrated).verdict
        for value in (1, 0.6, 0.3, 0.1, 0.05, 0.01, 0.003, 1e-5)
    ]
    ranks = [order.index(verdict) for verdict in verdicts]
    assert ranks == sorted(ranks)
    assert set(verdicts) == set(order if is_calibrated else order[1:])


@given(st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_an_uncalibrated_model_never_removes_a_reflection_and_has_else_the_same_verdict(
    confidence, seed
):
    photo, transmission = np.random.default_rng(seed).random((2, 8, 9, 3), np.float32)
    confidence_map = np.full((8, 9, 1), confidence, np.float32)
    calibrated, own = (
        assess(photo, transmission, confidence_map, is_calibrated=value).verdict
        for value in (True, False)
    )
    assert own == ("partly removed" if calibrated == "removed" else calibrated)


def test_only_a_shipped_model_is_calibrated(tmp_path):
    shipped = MODELS["compact"].path
    own = tmp_path / "own.onnx"
    own.write_bytes(shipped.read_bytes())
    photo = Path(__file__).parent / "pictures/mixture-chelsea-astronaut.jpg"
    verdicts = [Separator.load(str(model))(photo).assessment.verdict for model in ("compact", own)]
    assert verdicts == ["removed", "partly removed"]
    assert Separator.load()(photo, quality="draft").assessment.verdict == "partly removed"


def test_of_a_photo_without_glass_no_removal_is_claimed():
    photo = Path(__file__).parent / "pictures/plain-astronaut.jpg"
    assert Separator.load()(photo).assessment.verdict not in ("removed", "partly removed")


@given(st.integers(0, 2**32 - 1))
def test_every_number_is_a_fraction(seed):
    random = np.random.default_rng(seed)
    photo, transmission = random.random((2, 8, 9, 3), np.float32)
    found = assess(photo, transmission, random.random((8, 9, 1), np.float32))
    assert all(
        0 <= value <= 1 for value in (found.removed_light, found.changed_area, found.confidence)
    )


def halving_separator():
    return Separator(lambda tile: (tile * 0.5, tile * 0.5))


def test_the_strength_scales_the_removed_light_but_does_not_change_the_verdict():
    photo = Photo.from_array(grey(0.5), encoding="linear")
    weak, full = (
        halving_separator()(photo, strength=strength).assessment for strength in (0.02, 1.0)
    )
    assert weak.verdict == full.verdict
    assert weak.confidence == full.confidence
    assert full.removed_light == pytest.approx(0.5, abs=0.01)
    assert weak.removed_light == pytest.approx(0.01, abs=0.001)
    assert (weak.changed_area, full.changed_area) == (0, 1)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_mask_limits_the_removed_light_and_the_changed_area_to_its_white_part(dtype):
    photo = Photo.from_array(grey(0.5), encoding="linear")
    mask = np.zeros(SIZE, dtype)
    mask[:6, :8] = 255 if dtype == np.uint8 else 1  # 1/16 of the photo
    found = halving_separator()(photo, mask=mask)
    removed = 1 - found.transmission.linear().sum() / photo.linear().sum()
    assert found.assessment.removed_light == pytest.approx(float(removed), abs=0.002)
    assert found.assessment.changed_area == pytest.approx(1 / 16)
    assert (
        found.assessment.verdict
        == halving_separator()(photo).assessment.verdict
        == "partly removed"
    )


def test_with_a_black_mask_nothing_is_removed_and_the_verdict_says_so():
    photo = Photo.from_array(grey(0.5), encoding="linear")
    found = halving_separator()(photo, mask=np.zeros(SIZE, np.uint8)).assessment
    assert found == halving_separator()(photo, strength=0).assessment
    assert (found.verdict, found.removed_light, found.changed_area) == ("little found", 0, 0)
