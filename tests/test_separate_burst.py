"""Several photos of one window: the joint model, the motion candidates, videos, and both entry
points.
"""

import json
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image

import brewster
from brewster import Photo, Separator
from brewster.base.remote_path import location
from brewster.batch.plan import plan_bursts
from brewster.errors import BrewsterError, PhotoError, PhotoTooLarge, UnreadablePhoto
from brewster.film import BurstReport, read_video, separate_burst
from brewster.film.measuring import measure_layers
from brewster.film.motion.model.joint_model import JointModel, pixel_grid, with_fourth_channel
from brewster.film.motion.model.levels import LEVELS, SEARCH, Level
from brewster.film.motion.model.optimiser import Rates, optimise
from brewster.film.motion.naming import edge_correlation
from brewster.film.motion.registration.candidates import motion_candidates
from brewster.film.motion.registration.fourier_search import find_translations
from brewster.film.motion.registration.tracks import Track, layer_tracks, without_zoom
from brewster.film.motion.solution import Solution
from brewster.film.motion.solver import solve
from brewster.film.self_check import burst_report
from brewster.film.separate import fit_burst
from brewster.film.video.choosing import choose_frames
from brewster.film.working_frames import working_frames
from brewster.options import Options
from brewster.photo.srgb import to_encoded, to_linear
from cli_helpers import layer_files, list_files
from simulated_bursts import PICTURES, linear_pictures, psnr_db, read_photo, simulate_burst
from video_files import write_video


@pytest.fixture(scope="module")
def small_burst():
    """Five frames of 128 x 96 pixels, in which the reflection moves by 12 pixels."""
    motion = {"relative_px": 12, "common_px": 3, "strength": 0.4, "noise": 0}
    return simulate_burst(*linear_pictures((160, 120)), size=(128, 96), **motion)


@pytest.fixture(scope="module")
def burst_files(small_burst, tmp_path_factory):
    folder = tmp_path_factory.mktemp("burst")
    for k, frame in enumerate(small_burst.frames):
        Image.fromarray(frame).save(folder / f"{k}.png")
    return sorted(folder.iterdir())


@pytest.mark.parametrize(("is_prior_true", "least_db"), [(True, 29), (False, 25)])
def test_layers_with_known_motion_are_separated_whatever_the_prior(is_prior_true, least_db):
    first, second = linear_pictures((96, 72))
    transmission = 0.6 * first
    reflection = 0.3 * second
    shifts = [-8, -4, 0, 4, 8]
    frames = np.stack([transmission + np.roll(reflection, shift, 1) for shift in shifts])[
        :, :, 16:-16
    ]
    truth = transmission[:, 16:-16]
    motions = np.tile(np.eye(3), (1, 2, 5, 1, 1))
    motions[0, 1, :, 0, 2] = -np.array(shifts) * 2 / frames.shape[2]
    padded = with_fourth_channel(frames)
    start = JointModel.start(padded, motions, np.array([False]), 2, 1.0)
    prior = with_fourth_channel(truth if is_prior_true else frames[2])
    rates = Rates(homographies=0, splines=0, log_gains=0)
    model = optimise(start, padded, prior, 300, rates=rates, weights=LEVELS[-1].weights)
    layers = model.reference_layers(*truth.shape[:2])
    assert psnr_db(layers[0][8:-8, 8:-8], truth[8:-8, 8:-8]) > least_db
    assert model.losses[0] < 0.01


def test_a_copy_of_a_fine_texture_explains_less_than_the_true_reflection():
    """Interpolation blurs between pixels. A second layer must not explain that with a copy of T,
    moved by a pixel.
    """
    level = SEARCH[-1]
    texture = np.random.default_rng(3).random((480, 800, 3))
    reflection = linear_pictures((800, 480))[1]
    texture = cv2.GaussianBlur(texture.astype(np.float32), (0, 0), 2)
    texture = (0.5 + 0.2 * (texture - texture.mean()) / texture.std()).clip(0, 1)
    shifts = np.array([-6.0, -2.5, 0.0, 3.5, 6.0])  # four pixels are one of this level

    def view(picture, shift):
        return cv2.warpAffine(picture, np.float32([[1, 0, -80 - shift], [0, 1, 0]]), (640, 480))

    frames = [0.7 * view(texture, shift) + 0.1 * view(reflection, 3 * shift) for shift in shifts]
    small = np.stack(
        [cv2.resize(frame, (160, 120), interpolation=cv2.INTER_AREA) for frame in frames]
    )
    padded = with_fourth_channel(small)
    motions = np.tile(np.eye(3), (2, 2, 5, 1, 1))
    motions[:, :, :, 0, 2] = shifts / 320
    motions[0, 1, :, 0, 2] *= 3
    motions[1, 1, :, 0, 2] += np.sign(shifts) / 160
    start = JointModel.start(padded, motions, np.array([False, False]), 2, level.density)
    rates = Rates().scaled(0.5)
    start = start.resized(padded, level.density, level.spline_size)
    model = optimise(start, padded, padded[2], level.steps, rates=rates, weights=level.weights)
    true, copy = model.losses.tolist()
    assert true < 0.95 * copy
    assert model.relative_motion(*small.shape[1:3]).tolist()[0] == pytest.approx(24 / 640, rel=0.1)


def test_the_reflection_of_a_locked_candidate_moves_with_the_transmission():
    motions = np.tile(np.eye(3), (2, 2, 3, 1, 1))
    motions[:, 1, 0, 0, 2] = 0.3
    frames = np.random.default_rng(1).random((3, 8, 12, 4), np.float32)
    model = JointModel.start(frames, motions, np.array([True, False]), 1, 1.0)
    first = np.array([[model.positions(n, layer, 0, 8, 12) for layer in (0, 1)] for n in (0, 1)])
    assert np.array_equal(*first[0])
    assert not np.array_equal(*first[1])
    assert np.allclose(model.positions(1, 1, 1, 8, 12), pixel_grid(8, 12))  # the reference frame
    assert model.relative_motion(8, 12).tolist() == pytest.approx([0, 0.15], abs=1e-3)


TIMES = np.array([-1, -0.5, 0, 0.5, 1])
AROUND = 2 * np.pi * TIMES * 0.4


@pytest.mark.parametrize("path", [
    np.outer(TIMES, (6, 0)),
    np.outer(TIMES, (-9, 2)),
    8 * np.stack([np.cos(AROUND) - 1, np.sin(AROUND)], 1),
    7 * np.array([[1, 1], [-1, 1], [0, 0], [-1, -1], [1, -1]]),
])  # fmt: skip
def test_the_fourier_search_finds_the_translation_of_the_second_layer(path):
    transmission, reflection = linear_pictures((300, 200))
    moved = [np.roll(reflection, np.rint(offset[::-1]).astype(int), (0, 1)) for offset in path]
    found = find_translations([0.6 * transmission + 0.4 * layer for layer in moved], 2)[0].offsets
    assert np.abs(found - np.rint(path)).max() < 1


def test_unrelated_photos_have_no_motion_and_equal_ones_do_not_move():
    first, second = linear_pictures((400, 300))
    tracks = layer_tracks([first, first, second], 0, first)
    assert [track.found for track in tracks] == [[0, 1]]
    candidates = motion_candidates([first, first], 0, [tracks[0].reordered([0, 1])])
    assert candidates[0].is_locked
    assert np.allclose(candidates[0].transmission, np.eye(3), atol=1e-3)


def test_a_track_follows_one_layer_even_where_the_other_one_has_more_matches():
    pictures = linear_pictures((460, 340))
    paths = np.array([[0, 0], [6, 2], [14, -3]]), np.array([[0, 0], [-9, 4], [-20, 6]])
    shares = [(0.5, 0.5), (0.3, 0.7), (0.7, 0.3)]
    frames = []
    for share_of_each, *places in zip(shares, *paths, strict=True):
        layers = [
            share
            * cv2.warpAffine(picture, np.float32([[1, 0, x - 30], [0, 1, y - 20]]), (400, 300))
            for picture, share, (x, y) in zip(pictures, share_of_each, places, strict=True)
        ]
        frames.append(np.float32(sum(layers)))
    tracks = layer_tracks(frames, 0, frames[0] * np.float32(0.9))[:2]
    found = [[track.motions[k][:2, 2] for k in range(3)] for track in tracks]
    errors = [[np.abs(np.array(motion) - path).max() for path in paths] for motion in found]
    assert sorted(int(np.argmin(error)) for error in errors) == [0, 1]
    assert max(min(error) for error in errors) < 1


def test_a_burst_is_separated_by_its_motion(small_burst, burst_files):
    result = brewster.separate_burst(burst_files)
    report = result.burst
    assert report.method == "burst"
    assert 60 < report.relative_motion_px < 160  # 94 px in a photo of 1,000 px
    single = brewster.separate(burst_files[2])
    scores = [
        psnr_db(layers.transmission.linear(), small_burst.transmission)
        for layers in (result, single)
    ]
    assert scores[0] > scores[1]
    assert result.transmission.size == result.reflection.size == result.photo.size


def test_the_order_of_the_photos_does_not_matter(monkeypatch):
    burst = simulate_burst(*linear_pictures((144, 110)), relative_px=10, frames=3, size=(128, 96))
    frames = [to_linear(frame / 255).astype(np.float32) for frame in burst.frames]
    monkeypatch.setattr(
        "brewster.film.measuring.solve", partial(solve, levels=(Level(48, 5, None),))
    )
    results = []
    for shuffled in ([0, 1, 2], [2, 0, 1]):
        chosen = [frames[k] for k in shuffled]
        reference = shuffled.index(1)
        results.append(measure_layers(chosen, reference, frames[1] * np.float32(0.8))[0])
    assert np.allclose(results[0].layers[0], results[1].layers[0], atol=1e-5)
    assert results[0].two_layer_error == pytest.approx(results[1].two_layer_error, rel=1e-4)


def test_a_burst_without_reflection_stays_as_it_is():
    motion = {"parallax_px": 2, "common_px": 8, "strength": 0}
    burst = simulate_burst(*linear_pictures((150, 114)), frames=3, size=(128, 96), **motion)
    photos = [brewster.Photo.from_array(frame, encoding="srgb") for frame in burst.frames]
    result = separate_burst(photos)
    assert result.burst.method == "unchanged"
    assert (result.transmission.pixels == photos[1].pixels).all()


def test_the_single_photo_names_the_layers(small_burst):
    """A reflection that is brighter than the transmission takes its place, unless the single photo
    removes it.
    """
    frames = [to_linear(frame / 255).astype(np.float32) for frame in small_burst.frames]
    priors = [
        layer.astype(np.float32) for layer in (small_burst.transmission, small_burst.reflection)
    ]
    first, second = (solve_at_80(frames, prior) for prior in priors)
    assert first.naming > 0.15
    assert second.naming > 0.15
    truth = [cv2.resize(layer, first.layers.shape[2:0:-1]) for layer in priors]
    for solution, (transmission, reflection) in ((first, truth), (second, truth[::-1])):
        assert (
            psnr_db(solution.layers[0], transmission) > psnr_db(solution.layers[0], reflection) + 3
        )


def test_what_neither_layer_explains_comes_from_the_single_photo(small_burst):
    frames = [to_linear(frame / 255).astype(np.float32) for frame in small_burst.frames]
    prior = small_burst.transmission.astype(np.float32)
    alone = solve_at_80(frames, prior)
    assert not alone.unexplained.any()
    assert np.array_equal(alone.layers, alone.measured)
    passing = np.random.default_rng(3).permutation(np.linspace(0.05, 0.95, len(frames)))
    for frame, light in zip(frames, passing, strict=True):
        frame[36:60, 48:80] = light  # neither layer has this light in each frame
    prior[36:60, 48:80] = 0.7 * passing[2]
    solution = solve_at_80(frames, prior)
    height, width = solution.unexplained.shape[:2]
    inside = np.s_[height * 42 // 96 : height * 54 // 96, width * 54 // 128 : width * 74 // 128]
    for named in (solution, solution.swapped()):
        assert named.unexplained[inside].min() > 0.9
        assert named.layers[0][inside].mean() == pytest.approx(0.7 * passing[2], abs=0.02)
        assert named.layers[1][inside].mean() == pytest.approx(0.3 * passing[2], abs=0.02)
        assert named.unexplained[:, : width // 6].max() < 0.1


def test_the_measured_reflection_refines_the_prior(small_burst):
    """What the single photo gets wrong in large areas is corrected as soon as the layers are
    measured.
    """
    frames = [to_linear(frame / 255).astype(np.float32) for frame in small_burst.frames]
    wrong = frames[2] * np.float32(0.5)
    shares = []

    def refine(share):
        shares.append(share)
        return small_burst.transmission.astype(np.float32)

    levels = (Level(80, 20, None), Level(160, 25, None), Level(166, 25, None))
    so_far = []
    plain, refined = (
        solve_few(frames, wrong, levels=levels, refine_prior=each, on_layers=so_far.append)
        for each in (None, refine)
    )
    assert so_far[-1].shape == (2, 120, 160, 3)  # each level but the last one
    (share,) = shares  # not after the last level
    truth = small_burst.reflection.mean(-1) / (
        small_burst.reflection + small_burst.transmission
    ).mean(-1)
    truth = cv2.GaussianBlur(cv2.resize(truth, share.shape[1::-1]), (0, 0), 3)
    assert share.shape == (120, 160, 1)  # of the level of 160 pixels
    assert np.corrcoef(share.ravel(), truth.ravel())[0, 1] > 0.5
    truth = cv2.resize(small_burst.transmission, refined.layers.shape[2:0:-1])
    assert psnr_db(refined.layers[0], truth) > psnr_db(plain.layers[0], truth) + 0.1


@pytest.mark.parametrize("painted", [False, True])
def test_the_model_gets_the_measured_reflection_as_hint_unless_hints_exist(
    monkeypatch, burst_files, painted
):
    levels = (Level(80, 2, None), Level(160, 2, None), Level(166, 2, None))
    monkeypatch.setattr("brewster.film.measuring.solve", partial(solve, levels=levels))
    given = []
    separator = brewster.Separator.load()
    fit = separator.fit

    def spy(photo, **options):
        given.append(options.get("hints"))
        return fit(photo, **options)

    monkeypatch.setattr(separator, "fit", spy)
    hints = np.zeros((96, 128, 3), np.uint8) if painted else None
    if painted:
        hints[:9, :9, 0] = 255
    separate_burst(burst_files, separator=separator, hints=hints)
    assert given[0] is hints
    assert (len(given) == 1) is painted


@pytest.mark.parametrize("are_exchanged", [False, True])
def test_objects_count_only_if_the_layers_are_told_apart_as_clearly_with_them(
    small_burst, monkeypatch, are_exchanged
):
    def with_objects(model, *_, **__):
        first, second = model.layers[0][::-1] if are_exchanged else model.layers[0]
        motions = {name: getattr(model, name)[:, [0, 0, 1]] for name in ("homographies", "splines")}
        three = replace(model, layers=np.stack([first, 0 * first, second])[None], **motions)
        return model, (three, 0.5)

    monkeypatch.setattr("brewster.film.motion.solver.with_objects", with_objects)
    frames = [to_linear(np.float32(frame) / 255) for frame in small_burst.frames]
    solution = solve_at_80(frames, small_burst.transmission.astype(np.float32))
    assert len(solution.model.layers[0]) == (2 if are_exchanged else 3)
    assert (solution.one_layer_error == 0.5) is not are_exchanged
    assert solution.naming > 0


def solve_at_80(frames, prior):
    return solve_few(frames, prior, levels=LEVELS[:1])


def solve_few(frames, prior, **options):
    tracks = layer_tracks(frames, 2, frames[2] / 2)
    return solve(frames, 2, prior, motion_candidates(frames, 2, tracks), **options)


@pytest.mark.parametrize(("explained", "motion", "edge_correlation", "verdict", "method"), [
    (0.0, 0.02, 0.1, "reflection remains", "single photo"),
    (0.0, 0.02, 0.1, "little found", "unchanged"),
    (0.5, 0.02, 0.1, "little found", "burst"),
    (0.5, 0.012, 0.1, "little found", "unchanged"),
    (0.5, 0.012, 0.1, "reflection remains", "burst"),
    (0.11, 0.02, 0.1, "reflection remains", "single photo"),
    (0.15, 0.02, 0.1, "reflection remains", "burst"),  # a small share of a large error
    (0.5, 0.004, 0.1, "removed", "single photo"),  # too small a motion
    (0.3, 0.2, 0.1, "removed", "burst"),
    (0.3, 0.2, 0.1, "little found", "burst"),  # the measurement counts, not the single photo
    (0.5, 0.2, 0.4, "removed", "burst"),  # too large a motion for a copy
    (0.5, 0.02, 0.4, "removed", "single photo"),  # the second layer is a copy of the first
    (0.5, 0.02, 0.4, "little found", "unchanged"),
])  # fmt: skip
def test_the_self_check_chooses_the_method(explained, motion, edge_correlation, verdict, method):
    layers = np.ones((2, 2, 2, 3), np.float32)
    solution = Solution(
        measured=layers,
        predicted=layers,
        frame_errors=layers[0, ..., 0],
        relative_motion=motion,
        naming=0.5,
        edge_correlation=edge_correlation,
        one_layer_error=0.01,
        two_layer_error=0.01 * (1 - explained),
    )
    assert burst_report(solution, verdict, 5, (), 2).method == method


def test_layers_with_the_same_edges_have_edge_correlation_and_independent_ones_have_not():
    one, other = np.random.default_rng(1).random((2, 40, 60, 3))
    for second, expected in ((0.3 * one, 1.0), (other, 0.0)):
        layers = np.stack([one, second])
        assert edge_correlation(layers) == pytest.approx(expected, abs=0.1)
    assert edge_correlation(np.zeros((2, 8, 8, 3))) == 0  # no edges


def test_a_burst_keeps_depth_and_respects_strength_and_reference(small_burst, few_steps):
    frames = [frame.astype(np.uint16) * 257 for frame in small_burst.frames]
    photos = [brewster.Photo.from_array(frame, encoding="srgb") for frame in frames]
    result = separate_burst(photos, reference=1, strength=0)
    assert result.transmission.pixels.dtype == np.uint16
    assert (result.transmission.pixels == frames[1]).all()
    assert result.burst.reference == 1


def test_photos_without_relative_motion_are_not_separated_by_motion(small_burst):
    noise = np.random.default_rng(1).integers(0, 2, (3, *small_burst.frames[0].shape), np.uint8)
    still = [small_burst.frames[0] // 2 * 2 + each for each in noise]
    result = separate_burst([brewster.Photo.from_array(frame, encoding="srgb") for frame in still])
    assert result.burst.method != "burst"
    assert result.burst.relative_motion_px < 10 or result.burst.explained < 0.2


@pytest.mark.parametrize("reference", range(3))
def test_white_is_that_of_the_reference_photo(reference):
    """Of photos of 32 bits, whose light may be above 1."""
    gains = (1, 6, 0.5)
    light = np.random.default_rng(0).uniform(0, 1, (48, 64, 3)).astype(np.float32)
    photos = [Photo.from_array(gain * light, encoding="linear") for gain in gains]
    frames, white, _ = working_frames(
        photos, reference, photos[reference], 10**6, lambda _done: None
    )
    assert white == pytest.approx(max(1, np.percentile(gains[reference] * light, 99)), rel=1e-5)
    for frame, gain in zip(frames, gains, strict=True):
        np.testing.assert_allclose(frame, np.clip(gain * light / white, 0, 1), atol=1e-5)


def test_a_photo_of_another_scene_is_left_out_and_alone_gives_the_single_result():
    photos = [brewster.Photo.open(path) for path in PICTURES[:2]]
    pixels = [photo.srgb_8bit()[:300, :300] for photo in photos]
    first, second = (brewster.Photo.from_array(array, encoding="srgb") for array in pixels)
    result = separate_burst([first, second], reference=0)
    assert (result.burst.method, result.burst.left_out) == ("single photo", (1,))
    assert (result.transmission.pixels == brewster.separate(first).transmission.pixels).all()


@pytest.mark.parametrize(("zoom", "left_out"), [(0.97, ()), (1.15, (1,))])
def test_a_photo_with_another_zoom_is_left_out(zoom, left_out, few_steps):
    photo = brewster.Photo.open(PICTURES[0]).srgb_8bit()[:300, :400]
    matrix = cv2.getRotationMatrix2D((190, 160), 0, zoom)
    zoomed = cv2.warpAffine(photo, matrix, (400, 300), borderMode=cv2.BORDER_REFLECT)
    pair = [brewster.Photo.from_array(each, encoding="srgb") for each in (photo, zoomed)]
    report = separate_burst(pair, reference=0).burst
    assert report.left_out == left_out
    assert report.is_measured == (not left_out)
    assert ("zoom" in report.message) == bool(left_out)


@given(
    zoom=st.floats(0.7, 1.4),
    x=st.floats(-0.2, 0.2),
    y=st.floats(-0.2, 0.2),
    tilt=st.floats(-0.1, 0.1),
)
def test_a_zoom_is_told_by_the_scale_in_the_middle_whatever_the_camera_does_besides(
    zoom, x, y, tilt
):
    height, width = 480, 640
    to_middle = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1]])
    motion = np.array([[zoom, 0, x * width], [0, zoom, y * height], [tilt / width, 0, 1]])
    motion = np.linalg.inv(to_middle) @ motion @ to_middle
    track = Track(motions=[np.eye(3), motion, None], places=np.zeros((0, 2), int))
    assume(abs(abs(np.log(zoom)) - 0.1) > 0.02)
    kept = without_zoom([track, replace(track)], (height, width))
    assert [each.found for each in kept] == ([[0, 1]] * 2 if abs(np.log(zoom)) < 0.1 else [])


@pytest.mark.parametrize(
    ("shapes", "reference"),
    [([(8, 9)], 0), ([(8, 9), (9, 8)], 0), ([(8, 9)] * 2, 2), ([(8, 9)] * 16, 0)],
)
def test_bad_bursts_are_refused(shapes, reference):
    photos = [
        brewster.Photo.from_array(np.zeros((*shape, 3), np.uint8), encoding="srgb")
        for shape in shapes
    ]
    with pytest.raises(PhotoError):
        separate_burst(photos, reference=reference)


def test_photos_that_cannot_be_in_a_burst_are_named(burst_files, tmp_path):
    brewster.Photo.from_array(np.zeros((9, 8, 3), np.uint8), encoding="srgb").save(
        tmp_path / "small.png"
    )
    whole = burst_files[0].read_bytes()
    for photos, error, message in (
        ([whole] * 3, PhotoError, "are the same"),
        (
            [*burst_files[:2], tmp_path / "small.png"],
            PhotoError,
            r"photo 3 .*small.png\) has 8 x 9 pixels",
        ),
        ([*burst_files[1:3], whole[:200], burst_files[3]], UnreadablePhoto, "photo 3 of the burst"),
        (str(burst_files[0]), UnreadablePhoto, "1 frame"),
    ):
        with pytest.raises(error, match=message):
            separate_burst(photos)


def test_the_motion_of_tiny_photos_is_not_measured(small_burst):
    burst = separate_burst(
        [np.ascontiguousarray(frame[:72, :96]) for frame in small_burst.frames]
    ).burst
    assert (burst.method, burst.left_out) == ("single photo", ())
    assert "too small" in burst.message


def test_frames_of_a_video_are_chosen_along_its_path(tmp_path):
    picture = read_photo(PICTURES[0], (200, 96))
    encoded = np.rint(to_encoded(np.clip(picture, 0, 1)) * 255).astype(np.uint8)
    offsets = [0] * 10 + list(range(0, 40, 2)) + [38] * 10  # still, moving, still
    write_video(
        tmp_path / "a.mp4", [np.ascontiguousarray(encoded[:, x : x + 128]) for x in offsets]
    )
    photos = read_video(tmp_path / "a.mp4", 5)
    assert [photo.size for photo in photos] == [(128, 96)] * 5
    truth = [encoded[:, x : x + 128].astype(float) for x in offsets]
    nearest = [
        int(np.argmin([np.abs(photo.pixels - frame).mean() for frame in truth])) for photo in photos
    ]
    assert max(offsets[i] for i in nearest) - min(offsets[i] for i in nearest) >= 20
    with pytest.raises(PhotoTooLarge):
        read_video(tmp_path / "a.mp4", 5, max_pixels=100)
    with pytest.raises(BrewsterError):
        read_video(tmp_path / "a.mp4", 1)


def test_a_video_whose_time_begins_late_is_read_completely(tmp_path, small_burst):
    times = range(25 * 60, 25 * 60 + 5)
    write_video(tmp_path / "a.mts", small_burst.frames, codec="mpeg2video", rate=25, times=times)
    assert len(read_video(tmp_path / "a.mts", 5)) == 5


def test_the_prior_of_a_burst_does_not_depend_on_the_exposure(monkeypatch):
    scene, _ = linear_pictures((128, 96))
    frames = [np.roll(scene, shift, axis=1).astype(np.float32) for shift in (0, 3)]
    priors = []

    def keep_prior(_frames, _reference, prior, **_):
        priors.append(prior)
        return None, ()

    monkeypatch.setattr("brewster.film.separate.measure_layers", keep_prior)
    separator = Separator(lambda tile: (np.maximum(tile - 0.1, 0), np.full_like(tile, 0.1)))
    for gain in (1.5, 6):
        lights = [np.float32(gain) * frame / scene.max() for frame in frames]
        fit_burst(
            [Photo.from_array(light, encoding="linear") for light in lights], separator=separator
        )
    np.testing.assert_allclose(*priors, atol=2e-3)


@given(
    st.lists(st.tuples(st.floats(0, 0.1), st.floats(0, 1)), min_size=1, max_size=60),
    st.integers(2, 15),
)
def test_chosen_frames_are_distinct_and_ordered(steps, count):
    moves, sharpness = np.array(steps).T
    chosen = choose_frames(np.cumsum(moves), sharpness, count)
    assert chosen == sorted(set(chosen))
    assert len(chosen) == min(count, len(steps))
    assert chosen[-1] < len(steps)


@pytest.mark.parametrize("content", [b"", b"no video", None])
def test_a_damaged_video_is_refused(tmp_path, content):
    path = tmp_path / "a.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UnreadablePhoto):
        read_video(path, 5)


def test_each_folder_and_video_is_one_burst_and_named_photos_are_one(tmp_path, burst_files):
    for folder in ("a", "b/c"):
        (tmp_path / folder).mkdir(parents=True)
        for file in burst_files[:3]:
            (tmp_path / folder / file.name).write_bytes(file.read_bytes())
    tasks = plan_bursts([tmp_path], tmp_path / "out")
    assert [len(task.burst.photos) for task in tasks] == [3, 3]
    assert [task.source.name for task in tasks] == ["1.png", "1.png"]
    assert tasks[1].outputs["transmission"] == tmp_path / "out/b/c/1.transmission.png"
    (task,) = plan_bursts(burst_files, options=Options(reference=1))
    assert (task.source, len(task.burst.photos)) == (burst_files[0], 5)
    with pytest.raises(PhotoError):
        plan_bursts(burst_files, options=Options(reference=6))


def test_named_photos_of_several_folders_are_one_burst_and_the_reference_counts_repeated_ones(
    tmp_path,
):
    photos = [
        tmp_path / name for name in ("a/photo.png", "a/photo.png", "b/photo.png", "c/photo.png")
    ]
    for photo in photos:
        photo.parent.mkdir(exist_ok=True)
        photo.write_bytes(b"")
    (task,) = plan_bursts(photos, tmp_path / "out", options=Options(reference=3))
    assert (task.source, task.burst.photos) == (photos[2], tuple(photos))
    named, whole = plan_bursts([photos[0], tmp_path], tmp_path / "out")[:2]
    assert (named.burst.photos, whole.burst.photos) == ((photos[0],), (photos[2],))


def test_measured_layers_can_be_forced_exchanged_and_left_aside(small_burst, few_steps):
    photos = [Photo.from_array(frame, encoding="srgb") for frame in small_burst.frames]
    fitted = fit_burst(photos)
    assert fitted.report.method != "burst"  # after so few steps
    forced, swapped, single = (
        fitted.chosen(method, swap=swap).separate(lambda _: None)
        for method, swap in (("motion", False), ("motion", True), ("single", True))
    )
    found = [(each.burst.method, each.burst.is_swapped) for each in (forced, swapped, single)]
    assert found == [("burst", False), ("burst", True), ("single photo", False)]
    levels = [layer.linear().mean() for layer in (*forced, *reversed([*swapped]))]
    assert levels[:2] == pytest.approx(levels[2:], rel=0.2)
    assert np.array_equal(
        single.transmission.pixels, brewster.separate(photos[2]).transmission.pixels
    )
    again = forced.swapped()
    back = swapped.swapped()
    assert (again.burst.is_swapped, back.burst.is_swapped) == (True, False)
    assert np.array_equal(again.transmission.pixels, swapped.transmission.pixels)
    assert np.array_equal(back.reflection.pixels, forced.reflection.pixels)
    with pytest.raises(BrewsterError, match="no measured layers to exchange"):
        single.swapped()


def test_the_method_single_measures_nothing_and_motion_needs_a_measurement(
    small_burst, monkeypatch
):
    monkeypatch.setattr(
        "brewster.film.separate.measure_layers", lambda *_, **__: pytest.fail("measured")
    )
    photos = [Photo.from_array(frame, encoding="srgb") for frame in small_burst.frames]
    with monkeypatch.context() as patch:  # nor does it predict a start for the measurement
        patch.setattr(Separator, "fit", lambda *_, **__: pytest.fail("predicted"))
        fitted = fit_burst(photos, method="single")
    assert (
        fitted.chosen("single", swap=False).separate(lambda _: None).burst.method == "single photo"
    )
    assert separate_burst(photos, method="single").burst.method == "single photo"
    monkeypatch.setattr("brewster.film.separate.measure_layers", lambda *_, **__: (None, (0,)))
    with pytest.raises(PhotoError, match="no layers were measured"):
        separate_burst(photos, method="motion")


def test_what_cannot_be_a_burst_or_be_written_is_refused_or_planned_so(
    run_without_model, tmp_path, burst_files
):
    assert run_without_model("burst", *burst_files, "-o", "clear.bmp")[0] == 2
    (tmp_path / "alone.png").write_bytes(burst_files[0].read_bytes())
    code, out, _ = run_without_model("burst", "alone.png", "--json", "--dry-run")
    assert (code, json.loads(out)["status"]) == (1, "failed")


def test_a_burst_after_a_single_photo_names_the_other_options(
    run_without_model, burst_files, few_steps
):
    burst = ("burst", *burst_files, "-o", "out")
    run_without_model(burst_files[2], "-o", "out")
    err = run_without_model(*burst)[2]
    assert "skipped, because all layers exist, made with other options (burst=no)" in err
    run_without_model(*burst, "--overwrite")
    for other in ([burst_files[2]], ["burst", *burst_files[1:4]]):
        assert "(burst=5 photos)" in run_without_model(*other, "-o", "out")[2]


@pytest.mark.parametrize("method", ["burst", "single photo", "unchanged"])
def test_layers_record_hints_for_each_method(
    run_without_model, tmp_path, burst_files, few_steps, monkeypatch, method
):
    report = BurstReport(method, "", 5, (), 2, 0.0, 0.0, 0.0)
    monkeypatch.setattr("brewster.film.separate.burst_report", lambda *_: report)
    Image.new("RGB", (128, 96), "red").save(tmp_path / "hints.png")
    command = ("burst", *burst_files, "-o", "out")
    assert run_without_model(*command, "--hints", "hints.png")[0] == 0
    assert "made with other options (hints=yes)" in run_without_model(*command)[2]


@pytest.mark.parametrize("name", ["2.png", "link.png", "mask.png"])
def test_no_photo_of_a_burst_is_overwritten_and_no_mask(
    run_without_model, tmp_path, burst_files, name
):
    for file in burst_files[:3]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "link.png").hardlink_to(tmp_path / "0.png")
    Image.new("L", (128, 96), 255).save(tmp_path / "mask.png")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    photos = [tmp_path / file.name for file in burst_files[:3]]
    options = ("--mask", tmp_path / "mask.png", "-o", tmp_path / name, "--overwrite")
    for dry_run in ([], ["--dry-run"]):
        assert run_without_model("burst", *photos, *options, *dry_run)[0] == 1
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}


@pytest.mark.parametrize("content", [b"", b"only text in this file", None])
def test_a_dry_run_and_a_run_name_the_bad_photo_of_a_burst(
    run_without_model, tmp_path, burst_files, content
):
    bad = tmp_path / "bad.png"
    if content is not None:
        bad.write_bytes(content)
    messages = []
    for dry_run in ([], ["--dry-run"]):
        code, _, err = run_without_model("burst", *burst_files[:2], bad, "-o", "out", *dry_run)
        assert code == 1
        messages.append(err)
    assert messages[0] == messages[1]
    assert f"photo 3 of the burst ({bad})" in messages[0]


def test_a_dry_run_finds_that_a_video_is_missing_or_has_too_few_frames(run_without_model, tmp_path):
    assert run_without_model("burst", "no.mp4", "--dry-run")[0] == 1
    with pytest.raises(PhotoError, match="expected a number from 1 to 7"):
        plan_bursts([tmp_path / "no.mp4"], options=Options(reference=8))


def test_a_video_in_an_object_store_is_refused_also_in_a_dry_run(run_without_model, store):
    location("memory://window.mp4").write_bytes(b"\0\0\0\x18ftypisom")
    for dry_run in ([], ["--dry-run"]):
        code, _, err = run_without_model("burst", "memory://window.mp4", "-o", "out", *dry_run)
        assert code == 1
        assert "download the video first" in err


def test_the_command_writes_the_layers_and_the_report(
    run_without_model, tmp_path, burst_files, few_steps
):
    command = ("burst", *burst_files, "-o", "out", "--json", "--reference", "2")
    code, out, _ = run_without_model(*command)
    report = json.loads(out)
    assert (code, report["status"], report["burst"]["reference"]) == (0, "separated", 1)
    assert list_files(tmp_path / "out") == layer_files("1", suffix="png")
    _, out, err = run_without_model(*command)
    assert json.loads(out)["status"] == "skipped"
    assert "skipped, because all layers exist (" in err  # not "made with other options"
    _, _, err = run_without_model(*command, "--method", "motion", "--swap")
    assert "requested=auto, swapped=no" in err
    code, out, _ = run_without_model(*command, "--method", "motion", "--swap", "--overwrite")
    assert json.loads(out)["burst"]["is_swapped"]


def test_the_command_reports_bursts_that_cannot_be_separated(
    run_without_model, tmp_path, burst_files
):
    bad = tmp_path / "bursts/bad"
    bad.mkdir(parents=True)
    (bad / "alone.png").write_bytes(burst_files[0].read_bytes())
    (tmp_path / "window.mp4").write_bytes(b"cut")
    code, out, _ = run_without_model("burst", "bursts", "window.mp4", "-o", "out", "--json")
    reports = [json.loads(line) for line in out.splitlines()]
    assert (code, [report["status"] for report in reports]) == (1, ["failed", "failed"])
    assert "1 photo" in reports[0]["error"]
    assert "window.mp4 cannot be read as a video" in reports[1]["error"]


def test_the_command_separates_a_video(run_without_model, tmp_path, small_burst, few_steps):
    write_video(tmp_path / "window.mp4", small_burst.frames)
    command = ("burst", "window.mp4", "-o", "out", "--format", "png")
    code, out, _ = run_without_model(*command, "--json")
    assert (code, json.loads(out)["burst"]["frames"]) == (0, len(small_burst.frames))
    assert "skipped, because all layers exist (" in run_without_model(*command)[2]
    assert list_files(tmp_path / "out") == layer_files("window.mp4", suffix="png")
