"""Layers that move apart by a few pixels of 1,000, as in a film of a trembling hand."""

import cv2
import numpy as np
import pytest

from brewster.film.motion.model.joint_model import JointModel
from brewster.film.motion.model.levels import SEARCH, Level
from brewster.film.motion.registration.candidates import MotionCandidate
from brewster.film.motion.registration.fourier_search import (
    SMALL_MOTIONS,
    find_translations,
    remaining_change,
)
from brewster.film.motion.registration.homographies import normalised
from brewster.film.motion.registration.tracks import layer_tracks
from brewster.film.motion.small_motions import (
    aligned_frames,
    changes_of,
    find_small_motion,
    without_local_change,
)
from brewster.film.motion.solution import Solution
from brewster.film.motion.solver import solve
from brewster.film.self_check import burst_report
from brewster.photo.srgb import to_linear
from simulated_bursts import linear_pictures, psnr_db, simulate_burst

SIZE = 320, 240
"""A motion of 2 px is 6 px of 1,000."""


def tremor(strength, **options):
    """The frames of a film in linear light, and its layers."""
    film = simulate_burst(
        *linear_pictures((400, 300)),
        size=SIZE,
        relative_px=2.0,
        common_px=3.0,
        strength=strength,
        noise=0.002,
        **options,
    )
    return [to_linear(np.float32(frame) / 255) for frame in film.frames], film


def to_reference(matrices):
    """Motions in normalised coordinates of homographies from the reference frame in pixels."""
    return normalised(np.linalg.inv(np.stack(matrices)), SIZE[::-1], SIZE[::-1])


def shifted(image, x, y):
    """An image that is moved by a part of a pixel."""
    matrix = np.array([[1, 0, x], [0, 1, y]], np.float32)
    size = image.shape[1::-1]
    return cv2.warpAffine(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("seed", range(2))
def test_the_search_finds_small_translations_of_the_second_layer(seed):
    transmission, reflection = linear_pictures((500, 375))
    places = np.random.default_rng(seed).uniform(-3, 3, (4, 2))
    places[2] = 0
    frames = [0.6 * transmission + 0.4 * shifted(reflection, *place) for place in places]
    found = find_translations(frames, 2, searched=SMALL_MOTIONS)[0]
    np.testing.assert_allclose(found.offsets, places, atol=0.3)
    assert found.explained > 0.8


def test_frames_aligned_with_their_motion_are_equal():
    image, _ = linear_pictures((320, 240))
    angle = 0.01
    matrix = np.array([[1, -angle, 3.2], [angle, 1, -1.7], [0, 0, 1]])
    moved = cv2.warpPerspective(image, matrix, SIZE, flags=cv2.INTER_CUBIC)
    motions = to_reference([matrix, np.eye(3)])
    frames = np.stack([moved, image])
    model = JointModel.start(
        np.pad(frames, ((0, 0), (0, 0), (0, 0), (0, 1))),
        np.stack([motions, motions])[None],
        np.array([True]),
        1,
        1.0,
    )
    (first, second), _ = aligned_frames(frames, model, SIZE[0])
    inside = slice(10, -10), slice(10, -10)
    before = np.abs(moved - image)[inside].mean()
    assert np.abs(first - second)[inside].mean() < 0.15 * before


def remaining_share(frames):
    """The energy of the change that no local motion or exposure explains."""
    is_known = np.ones(frames[0].shape[:2], bool)
    return remaining_change(
        changes_of(frames, is_known), without_local_change(frames, is_known), SMALL_MOTIONS
    )


def test_parallax_is_removed_and_a_second_layer_remains():
    transmission, reflection = linear_pictures((500, 375))
    places = np.array([(-1.5, 0.5), (0, 0), (0.7, 1.2)], np.float32)
    depth = np.linspace(-1, 1, 500, dtype=np.float32)
    rows, columns = np.mgrid[:375, :500].astype(np.float32)
    bent = [
        cv2.remap(transmission, columns + x * depth, rows + y * depth, cv2.INTER_CUBIC)
        for x, y in places
    ]
    second = [transmission + 0.3 * shifted(reflection, *place) for place in places]
    assert remaining_share(bent) < 0.1
    assert remaining_share(second) > 0.4


def test_an_exposure_that_changes_from_place_to_place_is_no_second_layer():
    transmission, _ = linear_pictures((500, 375))
    slope = np.linspace(-0.2, 0.2, 500, dtype=np.float32)[:, None]
    brighter = [transmission * (1 + k * slope) for k in (-1, 0, 0.6)]
    assert remaining_share(brighter) < 0.05


def test_equal_frames_show_no_small_motion():
    image, _ = linear_pictures((320, 240))
    identity = np.tile(np.eye(3), (3, 1, 1))
    small = find_small_motion([image] * 3, 1, 0.9 * image, identity)
    assert method_of(small.evidence, is_small=True) == ("single photo", False)


def test_a_film_of_a_trembling_hand_is_separated_with_a_gain():
    frames, film = tremor(strength=0.4)
    frame = frames[2]
    smooth, smooth_frame = (
        cv2.GaussianBlur(image, (0, 0), 12) for image in (film.transmission, frame)
    )
    # A model that knows the light of large areas, and tells no edges apart
    prior = (frame * smooth / (smooth_frame + 1e-3)).clip(0, frame).astype(np.float32)
    motions = to_reference(layer_tracks(frames, 2, prior)[0].motions)
    candidates = [
        MotionCandidate("one layer", motions, motions, is_locked=True),
        MotionCandidate("shift", motions, motions @ np.diag([1.1, 1, 1])),
    ]
    levels = (Level(320, 20, (4, 6)),)
    solution = solve(frames, 2, prior, candidates, search=SEARCH[:1], levels=levels)
    assert solution.is_small
    assert 4 < 1000 * solution.relative_motion < 9
    report = burst_report(solution, "reflection remains", 5, (), 2)
    assert report.method == "burst"
    truth = film.transmission, film.reflection
    predicted = prior, frame - prior
    gains = [
        psnr_db(layer, true) - psnr_db(start, true)
        for layer, true, start in zip(solution.measured, truth, predicted, strict=True)
    ]
    assert min(gains) > 1.5, gains


def test_the_light_of_large_areas_does_not_name_the_layers_of_a_small_motion():
    frames, _ = tremor(strength=0.4)
    prior = 0.95 * cv2.GaussianBlur(frames[2], (0, 0), 12)  # bright, and without any detail
    motions = to_reference(layer_tracks(frames, 2, frames[2])[0].motions)
    candidates = [
        MotionCandidate("one layer", motions, motions, is_locked=True),
        MotionCandidate("shift", motions, motions @ np.diag([1.1, 1, 1])),
    ]
    levels = (Level(320, 3, (4, 6)),)
    solution = solve(frames, 2, prior, candidates, search=SEARCH[:1], levels=levels)
    assert solution.is_small
    assert not burst_report(solution, "reflection remains", 5, (), 2).are_names_certain


def test_a_film_with_one_layer_and_parallax_shows_no_small_motion():
    frames, _ = tremor(strength=0.0, parallax_px=1.5)
    tracks = layer_tracks(frames, 2, frames[2])
    motions = to_reference(tracks[0].motions)
    small = find_small_motion(frames, 2, frames[2], motions)
    assert method_of(small.evidence, is_small=True) == ("single photo", False)


@pytest.mark.parametrize(("share", "is_seen"), [(0.4, False), (0.7, True)])
def test_a_second_layer_must_show_in_most_of_the_picture(share, is_seen):
    without, _ = tremor(0.0, frames=7)
    mirrored, _ = tremor(0.8, frames=7)
    is_changed = (np.arange(SIZE[0]) < share * SIZE[0])[:, None]
    frames = [np.where(is_changed, *both) for both in zip(mirrored, without, strict=True)]
    motions = to_reference(layer_tracks(without, 3, without[3])[0].motions)
    small = find_small_motion(frames, 3, frames[3], motions)
    assert method_of(small.evidence, is_small=True)[1] == is_seen


def test_somebody_who_passes_by_hides_no_second_layer_elsewhere():
    frames, _ = tremor(0.4, frames=7)
    motions = to_reference(layer_tracks(frames, 3, frames[3])[0].motions)
    for k, frame in enumerate(frames):
        frame[:, 20 * k : 20 * k + 15] = 0.1
    small = find_small_motion(frames, 3, frames[3], motions)
    assert method_of(small.evidence, is_small=True) == ("burst", True)


def report_of(evidence, *, is_small, motion=0.006, naming=0.5, edges=0.2, explained=0.5):
    layers = np.ones((2, 2, 2, 3), np.float32)
    solution = Solution(
        measured=layers,
        predicted=layers,
        frame_errors=layers[0, ..., 0],
        relative_motion=motion,
        naming=naming,
        edge_correlation=edges,
        one_layer_error=0.01,
        two_layer_error=0.01 * (1 - explained),
        small_motion_evidence=evidence,
        is_small=is_small,
    )
    return burst_report(solution, "reflection remains", 5, (), 2)


def method_of(evidence, *, is_small, motion=0.006):
    report = report_of(evidence, is_small=is_small, motion=motion)
    return report.method, report.is_second_motion_seen


@pytest.mark.parametrize(("is_small", "naming", "is_certain"), [
    (True, 0.53, False),  # the largest of wrong names
    (True, 0.65, True),
    (False, 0.32, True),
    (False, 0.2, False),
])  # fmt: skip
def test_names_of_a_small_motion_are_asked_earlier(is_small, naming, is_certain):
    report = report_of(0.6, is_small=is_small, naming=naming)
    assert report.are_names_certain == is_certain


@pytest.mark.parametrize(("evidence", "is_small", "motion", "expected"), [
    (0.6, True, 0.006, ("burst", True)),
    (0.6, True, 0.001, ("single photo", True)),  # less than a pixel of most photos
    (0.11, True, 0.006, ("single photo", True)),
    (0.05, True, 0.006, ("single photo", False)),
    (0.0, False, 0.02, ("burst", True)),
    (0.4, False, 0.008, ("burst", True)),  # found by the other search
    (0.1, False, 0.008, ("single photo", True)),
])  # fmt: skip
def test_small_motions_count_by_their_evidence(evidence, is_small, motion, expected):
    assert method_of(evidence, is_small=is_small, motion=motion) == expected


@pytest.mark.parametrize("is_small", [True, False])
@pytest.mark.parametrize(("motion", "edges", "explained", "method"), [
    (0.006, 0.2, 0.05, "burst"),  # its evidence counts, not what it explains,
    (0.006, 0.3, 0.9, "single photo"),  # and both layers have edges of their own
    (0.012, 0.2, 0.05, "burst"),
])  # fmt: skip
def test_a_small_motion_with_evidence_separates_layers_with_edges_of_their_own(
    is_small, motion, edges, explained, method
):
    report = report_of(0.3, is_small=is_small, motion=motion, edges=edges, explained=explained)
    assert report.method == method


def test_evidence_of_a_small_motion_says_nothing_about_a_large_one():
    assert report_of(0.3, is_small=False, motion=0.03, explained=0.05).method == "single photo"
