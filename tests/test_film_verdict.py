"""The verdict of a burst: two scenes side by side, doubtful regions, and how they are reported."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster import Photo, Separator
from brewster.errors import PhotoError
from brewster.film.fitted_burst import FittedBurst
from brewster.film.motion.mixed_scenes import MixedScenes, find_mixed_scenes
from brewster.film.motion.model.joint_model import JointModel, with_fourth_channel
from brewster.film.motion.model.levels import LEVELS
from brewster.film.motion.model.optimiser import Rates, optimise
from brewster.film.motion.side_by_side import SideBySide, compare_side_by_side
from brewster.film.motion.solution import Solution
from brewster.film.self_check import burst_report
from brewster.photo.history import PROGRAM, recorded_parameters
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.burst_report import PhotoFilmReport
from simulated_bursts import linear_pictures

SHIFTS = (-8, -4, 0, 4, 8)
SIZE = 112, 168
"""Height and width of the frames."""


def view(picture, shift):
    """The frame that shows a picture moved to the right by a number of pixels."""
    matrix = np.float32([[1, 0, shift - 12], [0, 1, -4]])
    return np.maximum(cv2.warpAffine(picture, matrix, SIZE[::-1]), 0)


def optimised(frames):
    """A model with the motions of a wall and of a mirrored scene after some steps, for the prior of
    a photo that shows no reflection, and the frames.
    """
    padded = with_fourth_channel(np.stack(frames).astype(np.float32))
    motions = np.tile(np.eye(3), (1, 2, len(SHIFTS), 1, 1))
    motions[0, 1, :, 0, 2] = -np.array(SHIFTS) * 2 / SIZE[1]
    start = JointModel.start(padded, motions, np.array([False]), 2, 1.0)
    rates = Rates(homographies=0, splines=0, log_gains=0)
    weights = LEVELS[-1].weights
    return optimise(start, padded, padded[2], 80, rates=rates, weights=weights), padded


def compared(frames):
    """The comparison for such a model."""
    model, padded = optimised(frames)
    return compare_side_by_side(model, padded, model.collected_errors(padded, layer=0))


@pytest.fixture(scope="module")
def scenes():
    return linear_pictures((192, 120))


@pytest.fixture(scope="module")
def door():
    """Where a mirror hangs on the wall, (H, W, 1): the left two fifths."""
    is_mirror = np.zeros((120, 192, 1), np.float32)
    is_mirror[:, :76] = 1
    return is_mirror


def test_a_mirror_beside_a_wall_is_no_reflection_over_a_scene(scenes, door):
    wall, mirrored = scenes
    frames = []
    for shift in SHIFTS:
        hole = view(door, 0)[..., None]
        frames.append(0.8 * ((1 - hole) * view(wall, 0) + hole * view(mirrored, shift)))
    found = compared(frames)
    assert found.is_likely
    assert found.region[:, 8:50].mean() > 0.9
    assert found.region[:, 85:].mean() < 0.1


@pytest.mark.parametrize("is_partial", [False, True])
def test_a_reflection_over_a_scene_is_not_side_by_side(scenes, door, is_partial):
    """Not even if the glass, which moves with the wall, covers a part of it only."""
    behind, mirrored = scenes
    frames = []
    for shift in SHIFTS:
        glass = view(door, 0)[..., None] if is_partial else 1
        frames.append(0.6 * view(behind, 0) + 0.35 * glass * view(mirrored, shift))
    found = compared(frames)
    assert not found.is_likely
    assert found.error > 1.5 * found.layers_error


@pytest.mark.parametrize("is_split", [False, True])
def test_a_wall_and_what_a_door_beside_it_shows_are_no_single_layer(scenes, door, is_split):
    """T is the wall and the scene behind the door. If both move alike, that is one scene."""
    behind, mirrored = scenes
    wall = behind[::-1, ::-1].copy()
    frames = []
    for shift in SHIFTS:
        hole = view(door, 0)[..., None]
        inside = 0.5 * view(behind, 0.15 * shift if is_split else 0)
        transmission = (1 - hole) * view(wall, 0) + hole * inside
        frames.append(transmission + 0.6 * hole * view(mirrored, shift))
    model, padded = optimised(frames)
    found = find_mixed_scenes(model, padded, model.collected_errors(padded, layer=0))
    assert found.area > 0.1
    assert found.is_likely == is_split


def solution_of(**changes):
    """A solution of two clear layers that a large motion separates."""
    layers = np.random.default_rng(0).uniform(0.1, 0.5, (2, 40, 60, 3)).astype(np.float32)
    solution = Solution(
        measured=layers,
        predicted=layers[::-1],
        frame_errors=np.full((40, 60), 0.005, np.float32),
        relative_motion=0.03,
        naming=0.5,
        edge_correlation=0.0,
        one_layer_error=0.01,
        two_layer_error=0.004,
    )
    return replace(solution, **changes)


def side_by_side(area=0.4, error=0.01, border=1.0):
    region = np.zeros((20, 40), np.float32)
    region[:, : round(40 * area)] = 1
    return SideBySide(region=region, error=error, layers_error=0.01, border_ratio=border)


def mixed_scenes(**changes):
    found = MixedScenes(
        area=0.2, shift_px=0.1, reflection_shift_px=0.01, deviations=6.0, error_ratio=1.5
    )
    return replace(found, **changes)


def hole(area):
    """Errors of the frames that are large in an area."""
    errors = np.full((40, 60), 0.002, np.float32)
    errors[:, : round(60 * area)] = 0.3
    return errors


@pytest.mark.parametrize(("changes", "method", "verdict"), [
    ({}, "burst", "removed"),
    ({"two_layer_error": 0.0085}, "burst", "partly removed"),
    ({"frame_errors": np.full((40, 60), 0.03, np.float32)}, "burst", "partly removed"),
    ({"is_small": True, "small_motion_evidence": 0.6}, "burst", "partly removed"),
    ({"frame_errors": hole(0.1)}, "burst", "partly removed"),
    ({"frame_errors": hole(0.4)}, "burst", "doubtful"),
    ({"two_layer_error": 0.01}, "single photo", "doubtful"),
    ({"side_by_side": side_by_side()}, "unchanged", "doubtful"),
    ({"side_by_side": side_by_side(area=0.05)}, "burst", "removed"),
    ({"side_by_side": side_by_side(error=0.02)}, "burst", "removed"),
    ({"side_by_side": side_by_side(error=0.015)}, "burst", "removed"),
    ({"side_by_side": side_by_side(error=0.015, border=2.0)}, "unchanged", "doubtful"),
    ({"mixed_scenes": mixed_scenes()}, "unchanged", "doubtful"),
    ({"mixed_scenes": mixed_scenes(area=0.01)}, "burst", "removed"),
    ({"mixed_scenes": mixed_scenes(reflection_shift_px=0.05)}, "burst", "removed"),
    ({"mixed_scenes": mixed_scenes(shift_px=0.01)}, "burst", "removed"),
    ({"mixed_scenes": mixed_scenes(deviations=3.0)}, "burst", "removed"),
    ({"mixed_scenes": mixed_scenes(error_ratio=1.2)}, "burst", "removed"),
    ({"side_by_side": side_by_side(), "small_motion_evidence": 0.6, "relative_motion": 0.008},
     "burst", "partly removed"),
])  # fmt: skip
def test_the_verdict_follows_from_the_measurement(changes, method, verdict):
    changes = {"one_layer_error": 0.01} | changes
    report = burst_report(solution_of(**changes), "little found", 5, (), 2)
    if method == "single photo":  # where the model finds a reflection
        report = burst_report(solution_of(**changes), "reflection remains", 5, (), 2)
    assert (report.method, report.measured_verdict) == (method, verdict)
    assert report.is_side_by_side == (method == "unchanged")
    is_in_part = method == "burst" and report.doubtful_area > 0.05
    assert ("neither layer explains" in report.message) == is_in_part


@pytest.mark.parametrize(("count", "explained", "error", "method"), [
    (2, 0.45, 0.001, "single photo"),
    (3, 0.25, 0.001, "single photo"),
    (2, 0.6, 0.001, "burst"),
    (2, 0.45, 0.006, "burst"),
    (4, 0.25, 0.001, "burst"),
])  # fmt: skip
def test_few_photos_must_show_more_of_a_second_layer(count, explained, error, method):
    solution = solution_of(one_layer_error=error, two_layer_error=error * (1 - explained))
    report = burst_report(solution, "reflection remains", count, (), 0)
    assert report.method == method


SMALL = {"is_small": True, "small_motion_evidence": 0.13, "one_layer_error": 0.001}


@pytest.mark.parametrize("is_doubted", [False, True])
@pytest.mark.parametrize(("changes", "is_burst"), [
    ({"relative_motion": 0.0165}, True),
    ({"relative_motion": 0.0155}, "unless doubted"),
    ({"relative_motion": 0.0105}, "unless doubted"),
    ({"relative_motion": 0.0095}, False),
    ({"relative_motion": 0.0155, "small_motion_evidence": 0.13}, True),
    ({"relative_motion": 0.0095, "small_motion_evidence": 0.13}, True),
    ({"relative_motion": 0.0095, "small_motion_evidence": 0.11}, False),
    ({"relative_motion": 0.0155, "small_motion_evidence": 0.2, "two_layer_error": 0.01}, True),
    ({"relative_motion": 0.0165, "small_motion_evidence": 0.2, "two_layer_error": 0.01}, False),
    ({"relative_motion": 0.0021, **SMALL}, True),
    ({"relative_motion": 0.0019, **SMALL}, False),
    ({"relative_motion": 0.02, **SMALL}, True),
    ({"relative_motion": 0.02, **SMALL, "small_motion_evidence": 0.11}, False),
    ({"relative_motion": 0.02, **SMALL, "edge_correlation": 0.24}, True),
    ({"relative_motion": 0.02, **SMALL, "edge_correlation": 0.26}, False),
    ({"relative_motion": 0.029, "edge_correlation": 0.19}, True),
    ({"relative_motion": 0.029, "edge_correlation": 0.21}, False),
    ({"relative_motion": 0.031, "edge_correlation": 0.21}, True),
    ({"two_layer_error": 0.0087}, True),
    ({"two_layer_error": 0.0089}, False),
    ({"one_layer_error": 0.005, "two_layer_error": 0.0039}, True),
    ({"one_layer_error": 0.005, "two_layer_error": 0.0041}, False),
])  # fmt: skip
def test_a_motion_separates_the_layers_by_its_size_and_by_what_it_explains(
    changes, is_burst, is_doubted
):
    """Twice the motion is needed where the model finds no reflection in the single photo."""
    verdict = "little found" if is_doubted else "reflection remains"
    report = burst_report(solution_of(**changes), verdict, 5, (), 2)
    if is_burst == "unless doubted":
        is_burst = not is_doubted
    other = "unchanged" if is_doubted else "single photo"
    assert report.method == ("burst" if is_burst else other)
    assert report.relative_motion_px == pytest.approx(1000 * solution_of(**changes).relative_motion)


@pytest.mark.parametrize(("changes", "verdict"), [
    ({"two_layer_error": 0.0074}, "removed"), ({"two_layer_error": 0.0076}, "partly removed"),
    ({"frame_errors": np.full((40, 60), 0.0139, np.float32)}, "removed"),
    ({"frame_errors": np.full((40, 60), 0.0141, np.float32)}, "partly removed"),
    ({"frame_errors": hole(0.02)}, "removed"), ({"frame_errors": hole(0.08)}, "partly removed"),
    ({"frame_errors": hole(0.2)}, "partly removed"), ({"frame_errors": hole(0.3)}, "doubtful"),
    ({"relative_motion": 0.0101, "small_motion_evidence": 0.2}, "removed"),
    ({"relative_motion": 0.0099, "small_motion_evidence": 0.2}, "partly removed"),
    ({"is_small": True, "small_motion_evidence": 0.2}, "partly removed"),
    # Some large errors, which the layers explain
    ({"frame_errors": np.repeat(np.float32([0.045, 0.01]), [1080, 1320]).reshape(40, 60)},
     "removed"),
])  # fmt: skip
def test_layers_are_removed_only_if_nothing_speaks_against_it(changes, verdict):
    report = burst_report(solution_of(**changes), "reflection remains", 5, (), 2)
    assert (report.method, report.measured_verdict) == ("burst", verdict)


@pytest.mark.parametrize(("naming", "is_small", "is_certain"), [
    (0.31, False, True), (0.29, False, False), (0.61, True, True), (0.59, True, False),
    (-0.5, False, False),
])  # fmt: skip
def test_unclear_names_are_asked(naming, is_small, is_certain):
    solution = solution_of(naming=naming, is_small=is_small, small_motion_evidence=0.2)
    report = burst_report(solution, "reflection remains", 5, (), 2)
    assert report.are_names_certain == is_certain
    assert (report.next_step is None) == is_certain


@pytest.mark.parametrize(("changes", "is_seen"), [
    ({}, True),
    ({"relative_motion": 0.005}, True),
    ({"two_layer_error": 0.01}, False),
    ({"is_small": True, "small_motion_evidence": 0.11}, True),
    ({"is_small": True, "small_motion_evidence": 0.09}, True),
    ({"is_small": True, "small_motion_evidence": 0.07}, False),
    ({"side_by_side": side_by_side()}, False),
])  # fmt: skip
def test_a_second_motion_may_be_seen_although_it_is_too_small_for_layers(changes, is_seen):
    """Not if it is that of a scene beside the other one."""
    report = burst_report(solution_of(**changes), "little found", 5, (), 2)
    assert report.is_second_motion_seen == is_seen


@pytest.mark.parametrize("is_measured", [False, True])
@pytest.mark.parametrize(("left_out", "numbers"), [((0,), "1"), ((0, 3), "1, 4"), ((4,), "5")])
def test_photos_that_were_left_out_are_named_from_one_and_not_counted(
    left_out, numbers, is_measured
):
    solution = solution_of() if is_measured else None
    report = burst_report(solution, "reflection remains", 5, left_out, 2)
    assert report.message.endswith(f": {numbers}.")
    assert (report.left_out, report.frames) == (left_out, 5 - len(left_out))
    assert report.is_measured == is_measured
    whole = burst_report(solution, "reflection remains", 5, (), 2)
    assert "Left out" not in whole.message
    # Why nothing was measured
    reasons = "too small" in report.message, "too small" in whole.message
    assert reasons == (False, not is_measured)
    assert whole.frames == 5


def test_photos_that_were_left_out_show_no_second_layer():
    """Of four photos, a motion must explain less than of three."""
    solution = solution_of(one_layer_error=0.001, two_layer_error=0.00075)
    four, three = (
        burst_report(solution, "reflection remains", 5, left_out, 2) for left_out in ((0,), (0, 1))
    )
    assert (four.method, three.method) == ("burst", "single photo")


def test_the_report_has_the_numbers_of_the_measurement():
    solution = solution_of(
        edge_correlation=0.1234, small_motion_evidence=0.2345, two_layer_error=0.0042
    )
    report = burst_report(solution, "reflection remains", 5, (), 2)
    assert (report.reference, report.frames) == (2, 5)
    assert report.relative_motion_px == 30
    assert report.explained == pytest.approx(0.58, abs=1e-4)
    assert (report.edge_correlation, report.second_motion) == (0.1234, 0.2345)
    assert "by 3.0 % of the width" in report.message
    worse = burst_report(replace(solution, two_layer_error=0.02), "removed", 5, (), 2)
    assert (worse.explained, "%" in worse.message) == (0, False)
    slower = burst_report(replace(solution, relative_motion=0.0016), "removed", 5, (), 2)
    assert slower.method == "single photo"
    assert "by 0.2 % of the width" in slower.message


@pytest.mark.parametrize(("area", "percent"), [(0.03, "3"), (0.15, "15"), (0.4, "40")])
def test_a_doubtful_part_of_layers_is_told_in_percent(area, percent):
    solution = solution_of(frame_errors=hole(area))
    area = float(solution.doubtful.mean())
    report = burst_report(solution, "reflection remains", 5, (), 2)
    assert f"In {100 * area:.0f} % of the picture" in report.message
    assert abs(100 * area - int(percent)) < 5
    alone = burst_report(replace(solution, two_layer_error=0.01), "removed", 5, (), 2)
    assert alone.method == "single photo"
    clear = burst_report(solution_of(frame_errors=hole(0)), "removed", 5, (), 2)
    assert "of the picture" not in alone.message + clear.message


@pytest.mark.parametrize(("rows", "is_told"), [(20, True), (8, False)])
def test_a_small_doubtful_part_is_not_told(rows, is_told):
    """Less than 2 % of the picture."""
    errors = np.full((40, 60), 0.002, np.float32)
    errors[:rows, 0] = 0.3
    report = burst_report(solution_of(frame_errors=errors), "removed", 5, (), 2)
    assert 0.01 < report.doubtful_area < 0.03
    assert ("of the picture" in report.message) == is_told == (report.doubtful_area > 0.02)


def test_scenes_side_by_side_are_doubtful_everywhere_but_only_if_layers_were_found():
    solution = solution_of(side_by_side=side_by_side())
    report = burst_report(solution, "removed", 5, (), 2)
    assert (report.method, report.doubtful_area) == ("unchanged", 1)
    alone = burst_report(replace(solution, two_layer_error=0.01), "removed", 5, (), 2)
    assert (alone.method, alone.is_side_by_side) == ("single photo", False)


@pytest.mark.parametrize(("change", "pixels", "is_found"), [
    (0.032, 2400, True), (0.028, 2400, False), (0.1, 30, True), (0.1, 18, False),
])  # fmt: skip
def test_little_is_found_if_little_of_the_picture_changes_visibly(change, pixels, is_found):
    """By 0.03, sRGB-encoded, in 1 % of 2,400 pixels."""
    transmission = np.full((40, 60, 3), 0.2, np.float32)
    reflection = np.zeros_like(transmission)
    reflection.reshape(-1, 3)[:pixels] = to_linear(to_encoded(np.array(0.2)) + change) - 0.2
    layers = np.stack([transmission, reflection])
    report = burst_report(solution_of(measured=layers, predicted=layers), "removed", 5, (), 2)
    assert (report.measured_verdict != "little found") == is_found


def test_a_black_second_layer_is_little_found():
    layers = solution_of().measured.copy()
    layers[1] = 1e-4
    report = burst_report(solution_of(measured=layers, predicted=layers), "removed", 5, (), 2)
    assert (report.method, report.measured_verdict) == ("burst", "little found")


@given(st.floats(0, 0.9))
def test_the_doubtful_area_is_that_without_confidence(area):
    solution = solution_of(frame_errors=hole(area))
    report = burst_report(solution, "removed", 5, (), 2)
    assert report.doubtful_area == pytest.approx(float(solution.doubtful.mean()), abs=1e-4)
    assert solution.confidence[solution.doubtful == 1].max(initial=0) == 0
    assert solution.confidence[solution.doubtful == 0].min(initial=1) > 0
    everywhere = replace(solution, side_by_side=side_by_side())
    assert everywhere.doubtful.min() == 1
    assert not everywhere.confidence.any()


def fitted_of(solution):
    """A burst with this solution, whose single photo the model leaves as it is."""
    photo = Photo.from_array(solution.measured.sum(0), encoding="linear")
    return FittedBurst(
        photo=photo,
        report=burst_report(solution, "little found", 5, (), 2),
        seconds={},
        _solution=solution,
        _single=Separator(lambda tile: (tile, np.zeros_like(tile)), name="none"),
        _hints=None,
    )


def separated(fitted, **options):
    return fitted.separate(lambda _done: None, **options)


def recorded_in(layer, folder):
    """The history of a layer in its file."""
    layer.save(folder / "layer.png", overwrite=True)
    return recorded_parameters(folder / "layer.png", PROGRAM)


@pytest.mark.parametrize("explained", [0.6, 0.15])
def test_the_separation_and_its_layers_carry_the_verdict_of_the_film(tmp_path, explained):
    solution = solution_of(two_layer_error=0.01 * (1 - explained))
    result = separated(fitted_of(solution))
    verdict = "removed" if explained > 0.5 else "partly removed"
    assert result.assessment.verdict == result.burst.measured_verdict == verdict
    for layer in result:
        assert recorded_in(layer, tmp_path)["verdict"] == verdict
    assert result.swapped().assessment.verdict == verdict


def test_no_strength_finds_little_and_a_film_that_was_not_used_has_the_verdict_of_the_model(
    tmp_path,
):
    fitted = fitted_of(solution_of())
    assert separated(fitted, strength=0.0).assessment.verdict == "little found"
    mask = np.zeros((40, 60), np.uint8)
    assert separated(fitted, mask=mask).assessment.verdict == "little found"
    alone = separated(fitted.chosen("single", swap=False))
    assert alone.burst.measured_verdict == "removed"
    assert alone.assessment.verdict == "little found"
    assert "verdict" not in recorded_in(alone.transmission, tmp_path)


def test_two_scenes_side_by_side_stay_as_they_are_unless_the_layers_are_requested():
    fitted = fitted_of(solution_of(side_by_side=side_by_side()))
    result = separated(fitted)
    assert (result.burst.method, result.assessment.verdict) == ("unchanged", "doubtful")
    assert (result.transmission.pixels == fitted.photo.pixels).all()
    assert not result.reflection.pixels.any()
    forced = separated(fitted.chosen("motion", swap=False))
    assert forced.assessment.verdict == "doubtful"
    assert (forced.transmission.pixels != fitted.photo.pixels).any()
    assert not forced.confidence.pixels.any()


def test_where_there_is_no_glass_the_photo_is_the_transmission_at_every_strength():
    outside = np.zeros((40, 60, 1), np.float32)
    outside[:, 40:] = 1
    fitted = fitted_of(solution_of(without_glass=outside))
    result = separated(fitted, strength=0.6)
    # the upsampler mixes neighbouring pixels
    np.testing.assert_allclose(
        result.transmission.pixels[:, 46:], fitted.photo.pixels[:, 46:], atol=2e-3
    )
    changed = result.transmission.pixels[:, :34] - fitted.photo.pixels[:, :34]
    assert np.abs(changed).mean() > 0.05
    assert fitted.kept[:, 41:].min() == 1
    exchanged = fitted.chosen("motion", swap=True)  # then this light is all R
    assert not exchanged.kept.any()


def test_a_photo_and_its_film_are_not_separated_by_the_light():
    fitted = fitted_of(solution_of())
    film = PhotoFilmReport("beside", seconds=2.0, frames=60, sha256="0" * 64, nearest_frame=30)
    of_photo = replace(fitted, report=replace(fitted.report, film=film))
    with pytest.raises(PhotoError, match="light"):
        of_photo.chosen("light", swap=False)
