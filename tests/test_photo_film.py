"""A photo is separated by the film that its phone recorded around it."""

import io
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import brewster
from brewster import Photo, Separator
from brewster.batch import plan_files, separate_files
from brewster.batch.one_photo import separate_photo
from brewster.errors import BrewsterError, UnreadablePhoto
from brewster.film.film_shares import carried, hint_strokes
from brewster.film.motion.registration.tracks import Track, likeliest_first
from brewster.film.motion.resizing import resized
from brewster.film.motion.solution import Solution
from brewster.film.photo_film import (
    _decision,
    _decoded,
    _Moving,
    _stated_frame,
    choose_around,
    fit_photo_film,
)
from brewster.film.still_registration import match_still
from brewster.film.video.choosing import FilmMeasurements, choose, measure_film
from brewster.options import Options
from brewster.photo.phone_films.motion_photo import PhotoFilm, search_films
from brewster.photo.srgb import to_8bit, to_linear
from cli_helpers import json_lines
from motion_photos import google_xmp, small_film
from simulated_bursts import linear_pictures, psnr_db, simulate_burst
from video_files import clean_aperture_box, with_clean_aperture, write_video

SIZE = (320, 240)
STILL = (640, 480)


def toned(light):
    """The tone of a still: a curve, and a local exposure of a quarter of a stop."""
    across = np.linspace(-1, 1, light.shape[1], dtype=np.float32)[None, :, None]
    return np.clip(1.1 * np.exp2(0.25 * across) * np.maximum(light, 0) ** 0.95, 0, 1)


def jpeg(codes, film=b""):
    """The bytes of a JPEG, followed by a film."""
    file = io.BytesIO()
    xmp = {"xmp": google_xmp(len(film))} if film else {}
    Image.fromarray(codes).save(file, "JPEG", quality=95, **xmp)
    return file.getvalue() + film


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """A photo of twice the size of its film, whose layers move apart by 1.6 % of the width."""
    folder = tmp_path_factory.mktemp("film")
    burst = simulate_burst(
        *linear_pictures((400, 300)),
        frames=9,
        size=SIZE,
        relative_px=5,
        common_px=4,
        strength=0.5,
        noise=0.002,
    )
    film = write_video(folder / "film.mp4", burst.frames, codec="mpeg4", rate=15).read_bytes()
    large = [
        cv2.resize(layer, STILL, interpolation=cv2.INTER_CUBIC).clip(0)
        for layer in (burst.transmission, burst.reflection)
    ]
    still = toned(large[0] + large[1])
    codes = to_8bit(still)
    path = folder / "photo.jpg"
    path.write_bytes(jpeg(codes, film))
    return SimpleNamespace(
        path=path,
        film=film,
        codes=codes,
        transmission=toned(large[0]),
        reflection=still - toned(large[0]),
    )


@pytest.fixture(scope="module")
def progress():
    """The completed fractions of `separation`."""
    return []


@pytest.fixture(scope="module")
def measured():
    """The measured layers of `separation`, in a list."""
    return []


@pytest.fixture(scope="module")
def separation(sample, progress, measured):
    def fit(*args, **options):
        measured.append(fit_photo_film(*args, **options))
        return measured[-1]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("brewster.film.photo_film.fit_photo_film", fit)
        return separate_photo(sample.path, Separator.load(), on_progress=progress.append)


def test_the_method_and_the_order_of_the_layers_can_be_chosen(
    sample, separation, measured, monkeypatch
):
    monkeypatch.setattr("brewster.film.photo_film.fit_photo_film", lambda *_, **__: measured[0])
    separator = Separator.load()
    alone = separate_photo(sample.path, separator, method="single")
    assert alone.burst.method == "single photo"
    expected = separator(sample.path)
    np.testing.assert_array_equal(alone.transmission.pixels, expected.transmission.pixels)
    swapped = separate_photo(sample.path, separator, swap=True)
    assert swapped.burst.is_swapped
    expected = separation.swapped()
    np.testing.assert_array_equal(swapped.transmission.pixels, expected.transmission.pixels)


def test_the_progress_of_a_photo_with_a_film_never_falls(separation, progress):
    assert separation.burst.method == "burst"
    assert progress == sorted(progress)
    assert 0 <= progress[0] < 0.5
    assert progress[-1] == pytest.approx(1)


def test_a_photo_with_a_film_is_separated_better_than_alone(sample, separation):
    assert separation.burst.method == "burst"
    assert separation.burst.film.layout == "Google Motion Photo"
    assert separation.burst.film.frames == 9
    assert separation.burst.film.nearest_frame == 4
    alone = brewster.separate(sample.path, film="no")
    assert alone.burst is None
    measured, guessed = (
        psnr_db(each.transmission.linear(), sample.transmission) for each in (separation, alone)
    )
    assert measured > guessed + 1
    measured, guessed = (
        psnr_db(each.reflection.linear(), sample.reflection) for each in (separation, alone)
    )
    assert measured > guessed + 3


def test_the_layers_have_the_size_and_the_metadata_of_the_photo(sample, separation):
    assert separation.transmission.size == STILL
    xmp = separation.transmission.file_info.xmp
    assert separation.burst.film.sha256[:12].encode() in xmp
    assert b"MotionPhoto=" not in xmp


def detail(photo):
    """A picture without its smooth light, (h, w, 3)."""
    small = resized(photo.linear(), 200)
    return small - cv2.GaussianBlur(small, (0, 0), 3)


def test_the_names_of_the_layers_can_be_exchanged(separation):
    other = separation.swapped()
    assert other.burst.is_swapped
    now = detail(other.transmission)
    likeness = [
        np.corrcoef(now.ravel(), detail(layer).ravel())[0, 1]
        for layer in (separation.reflection, separation.transmission)
    ]
    assert likeness[0] > 0.8
    assert likeness[1] < 0.5


def test_the_still_decides_which_of_several_motions_is_that_of_the_scene(rng):
    frame = rng.random((300, 500, 3), np.float32)
    left, right = (
        np.stack([rng.integers(*columns, count), rng.integers(20, 280, count)], axis=1)
        for columns, count in (((20, 220), 60), ((280, 480), 40))
    )
    tracks = [Track(motions=[np.eye(3)], places=places) for places in (left, right)]
    moving = _Moving(
        frames=[3],
        reference=3,
        light=[frame],
        exposures=np.ones((1, 3)),
        small=None,
        tracks=tracks,
    )
    is_all = np.ones_like(frame)
    is_right = np.where(np.arange(500) < 250, 0.0, 1.0).astype(np.float32)[:, None] * is_all
    assert not moving.is_other_scene(is_all)  # more features are on the left
    assert moving.is_other_scene(is_right)
    assert likeliest_first(tracks, frame, is_right * frame) == tracks[::-1]
    assert not replace(moving, tracks=tracks[:1]).is_other_scene(is_right)


@pytest.mark.usefixtures("few_steps")
def test_the_film_is_searched_again_if_the_motion_found_first_is_that_of_the_mirrored_scene(
    sample, monkeypatch
):
    found = []
    find = _Moving.find

    def recorded(pictures, frames, reference, prior_share=None):
        found.append(reference)
        if len(found) == 2:
            assert reference in frames
            assert prior_share.shape == pictures[reference].shape
            assert 0.3 < prior_share.mean() < 1  # the share of T in the light
        return find(pictures, frames, reference, prior_share)

    monkeypatch.setattr(_Moving, "find", recorded)
    monkeypatch.setattr(_Moving, "is_other_scene", lambda _self, _share: True)
    (own,) = search_films(sample.path).films
    film = replace(own, still_time_s=4 / 15)
    fitted = fit_photo_film(Photo.open(sample.path), film)
    assert fitted.report.film.nearest_frame == 4
    assert found == [4, 4]


@pytest.mark.usefixtures("few_steps")
def test_the_hints_of_a_person_are_not_replaced_by_those_of_the_measurement(sample, monkeypatch):
    """Without them, the model runs again with hints where the measured layers have a reflection."""
    monkeypatch.setattr(_Moving, "is_other_scene", lambda _self, _share: False)  # one search
    runs = []

    class Pane:
        takes_hints = True

        def __call__(self, tile, hints=None):
            runs.append(hints)
            return 0.7 * tile, 0.3 * tile

    strokes = np.zeros((*STILL[::-1], 3), np.uint8)
    strokes[100:150, 100:150, 0] = 255
    counts = []
    (own,) = search_films(sample.path).films
    film = replace(own, still_time_s=4 / 15)
    for hints in (None, strokes):
        runs.clear()
        photo = Photo.open(sample.path)
        fit_photo_film(photo, film, separator=Separator(Pane()), hints=hints)
        counts.append(len(runs))
    assert counts[0] > counts[1] > 0
    assert all(given is not None and given.any() for given in runs)


def test_the_time_of_the_still_counts_from_the_first_frame():
    """Films that were cut begin at any time."""
    film = PhotoFilm.of_bytes(b"")
    times = [5.0, 5.1, 5.2, 5.3, 5.4, 5.5]
    assert _stated_frame(replace(film, still_time_s=0.11), times) == 1
    assert _stated_frame(replace(film, still_time_s=9.0), times) == 5
    assert _stated_frame(film, times) == 3


def test_the_film_of_a_photo_is_used_for_ten_seconds_and_without_cropping(tmp_path):
    """The border that players hide shows what the still shows, too."""
    frames = [np.full((48, 64, 3), 10 * k, np.uint8) for k in range(24)]
    path = write_video(tmp_path / "film.mp4", frames, codec="libx264", rate=2)
    with_clean_aperture(path, clean_aperture_box((48, 32), (8, 8, 8, 8)))
    film = PhotoFilm.of_file(path)
    pictures, times, path_of_camera = _decoded(film, film.read(), 10**6, lambda _done: None)
    assert pictures[0].shape == (48, 64, 3)
    assert 9 <= times[-1] - times[0] <= 10
    assert len(pictures) == len(times) == len(path_of_camera.positions)


def moving_frames(evidence):
    """Two frames of a film, in which a second layer moves with this evidence."""
    return _Moving(
        frames=[3, 5],
        reference=5,
        light=[],
        exposures=np.ones((2, 3)),
        small=SimpleNamespace(evidence=evidence),
        tracks=[],
    )


@pytest.mark.parametrize(
    ("verdict", "evidence", "method"),
    [
        ("little found", 0.0, "unchanged"),
        ("little found", 0.5, "single photo"),
        ("partly removed", 0.0, "single photo"),
        ("partly removed", 0.5, "single photo"),
    ],
)
def test_a_photo_is_left_unchanged_only_if_neither_it_nor_its_film_shows_a_reflection(
    verdict, evidence, method
):
    report, strokes = _decision(None, moving_frames(evidence), verdict, (64, 48))
    assert report.method == method
    assert report.second_motion == evidence
    assert strokes is None


@pytest.mark.parametrize("verdict", ["little found", "partly removed"])
def test_a_reflection_that_moves_too_weakly_for_layers_gives_hints_to_a_model_that_takes_them(
    verdict,
):
    light = np.full((48, 64, 3), 0.3, np.float32)
    mirrored = np.zeros_like(light)
    mirrored[10:30, 5:25] = 0.4
    layers = np.stack([light, mirrored])
    weak = replace(solution_of(layers, layers), is_small=True, small_motion_evidence=0.1)
    report, strokes = _decision(weak, moving_frames(0.1), verdict, (128, 96))
    assert report.method == "hints"
    assert strokes.shape == (96, 128, 3)
    assert strokes[20:60, 10:50, 0].mean() > 200
    report, strokes = _decision(weak, moving_frames(0.1), verdict, None)
    assert report.method in ("single photo", "unchanged")
    assert strokes is None
    strong = replace(weak, small_motion_evidence=0.5, relative_motion=0.005)
    report, _ = _decision(strong, moving_frames(0.5), verdict, (128, 96))
    assert report.method == "burst"


def test_a_film_of_the_scene_without_a_reflection_is_not_called_one_of_another_scene(tmp_path):
    frames = views_of_a_scene(9, 6)
    film = write_video(tmp_path / "film.mp4", frames, codec="libx264", rate=15).read_bytes()
    report = brewster.separate(jpeg(cv2.resize(frames[4], STILL), film)).burst
    assert report.method in ("single photo", "unchanged")
    assert "No frame" not in report.message


def test_without_the_film_the_result_is_that_of_the_photo_alone(sample):
    alone = brewster.separate(sample.path, film="no")
    expected = Separator.load()(sample.path)
    np.testing.assert_array_equal(alone.transmission.pixels, expected.transmission.pixels)


def test_a_photo_at_strength_0_does_not_open_its_film(sample):
    assert brewster.separate(sample.path, strength=0).burst is None


def test_a_film_of_another_scene_is_not_used(sample, tmp_path):
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(jpeg(sample.codes, small_film(tmp_path / "other.mp4", 8, (320, 240))))
    separation = brewster.separate(photo)
    assert separation.burst.method in ("single photo", "unchanged")
    assert separation.burst.film.nearest_frame is None


def test_a_film_that_cannot_be_decoded_leaves_the_photo_alone_with_a_note(sample, tmp_path):
    photo = tmp_path / "photo.jpg"
    start = sample.film.index(b"mdat") + 4
    end = sample.film.index(b"moov") - 4
    damaged = sample.film[:start] + bytes(end - start) + sample.film[end:]
    photo.write_bytes(jpeg(sample.codes, damaged))
    separation = brewster.separate(photo)
    assert separation.burst is None
    assert "was not used" in separation.photo.file_info.note
    (tmp_path / "film.mp4").write_bytes(damaged)
    with pytest.raises(UnreadablePhoto, match=r"film\.mp4"):
        brewster.separate(photo, film=tmp_path / "film.mp4")


@pytest.mark.usefixtures("few_steps")
def test_a_film_next_to_the_photo_is_used_and_not_counted_as_skipped(sample, tmp_path, run):
    (tmp_path / "a.jpg").write_bytes(jpeg(sample.codes))
    (tmp_path / "a.mp4").write_bytes(sample.film)
    code, out, err = run(tmp_path, "-o", "clear/", "--json")
    (row,) = json_lines(out)
    assert code == 0
    assert row["burst"]["method"] == "burst"
    assert row["burst"]["film"]["layout"] == "beside"
    assert "film" in row["seconds"]
    assert "skipped" not in err
    for options in ((), ("--film", "no")):  # the frames of its film are no option
        _, _, err = run(tmp_path, "-o", "clear/", *options)
        assert ("other options" in err) == bool(options)


@pytest.mark.usefixtures("few_steps")
def test_a_film_can_be_given_for_one_photo_only(sample, tmp_path):
    names = [tmp_path / name for name in ("a.jpg", "b.jpg")]
    for name in names:
        name.write_bytes(jpeg(sample.codes))
    (tmp_path / "film.mp4").write_bytes(sample.film)
    options = Options(film=str(tmp_path / "film.mp4"))
    with pytest.raises(BrewsterError, match="2 photos"):
        next(separate_files(names, tmp_path / "clear", options))
    (result,) = separate_files(names[0], tmp_path / "clear", options)
    assert result.burst.film.layout == "given"
    with pytest.raises(UnreadablePhoto):
        brewster.separate(names[0], film=tmp_path / "missing.mp4")


def test_an_array_in_linear_light_may_have_a_film_too(sample, tmp_path):
    small_film(tmp_path / "other.mp4", 5, (96, 64))
    light = to_linear(sample.codes.astype(np.float32) / 255)
    separation = brewster.separate(light, encoding="linear", film=tmp_path / "other.mp4")
    assert separation.burst.film.layout == "given"
    np.testing.assert_allclose(separation.photo.linear(), light, atol=1e-6)


@pytest.mark.usefixtures("few_steps")
def test_a_film_is_a_burst_whatever_its_name(sample, tmp_path):
    for name in ("film.mp4", "PXL_1.MP", "no-suffix"):
        (tmp_path / name).write_bytes(sample.film)
        (task,) = plan_files(tmp_path / name, tmp_path / "clear")
        assert task.burst.is_from_video
    (result,) = separate_files(tmp_path / "no-suffix", tmp_path / "clear")
    assert result.error is None
    assert result.burst.frames == 7


# --- Laws of the parts


def solution_of(measured, predicted):
    return Solution(
        measured=measured,
        predicted=predicted,
        frame_errors=np.zeros(measured.shape[1:3], np.float32),
        relative_motion=0.02,
        naming=1.0,
        edge_correlation=0.0,
        one_layer_error=0.01,
        two_layer_error=0.001,
    )


def random_layers(seed, size=(24, 32)):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.01, 0.5, (2, *size, 3)).astype(np.float32)


@given(st.integers(0, 99), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(0.5, 2))
def test_carried_layers_sum_to_the_still_whatever_its_tone_and_motion(seed, x, y, exposure):
    layers = random_layers(seed)
    still = np.float32(exposure) * random_layers(seed + 100).sum(0)
    motion = np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])
    found = carried(solution_of(layers, layers), motion, still, 0.5 * still)
    np.testing.assert_allclose(found.measured.sum(0), still, rtol=1e-5)
    assert (found.measured >= 0).all()


def test_a_frame_without_motion_gives_its_shares_to_a_still_of_another_exposure():
    layers = random_layers(1)
    still = 1.7 * layers.sum(0)
    found = carried(solution_of(layers, layers), np.eye(3), still, 0.5 * still)
    inside = np.s_[:, 3:-3, 3:-3]
    np.testing.assert_allclose(found.measured[inside], 1.7 * layers[inside], rtol=1e-4)


def test_what_the_frame_does_not_show_has_the_shares_of_the_photo_alone():
    layers = random_layers(2)
    still = layers.sum(0)
    moved = np.array([[1, 0, 1.0], [0, 1, 0], [0, 0, 1.0]])  # by half of the width
    found = carried(solution_of(layers, layers), moved, still, np.float32(0.25) * still)
    right = np.s_[:, 18:]
    np.testing.assert_allclose(found.measured[0][right], 0.25 * still[right], rtol=1e-4)


def test_hints_are_red_where_the_reflection_dominates_and_absent_without_one():
    light = np.full((48, 64, 3), 0.3, np.float32)
    dark = np.zeros_like(light)
    dark[10:30, 5:15] = 0.4
    strokes = hint_strokes(
        solution_of(np.stack([light, dark]), np.stack([light, dark])), (256, 192)
    )
    assert strokes.shape == (192, 256, 3)
    assert strokes[60:100, 30:50, 0].mean() > 200
    assert not strokes[:, 128:].any()
    nothing = solution_of(np.stack([light, 0 * light]), np.stack([light, 0 * light]))
    assert hint_strokes(nothing, (256, 192)) is None


def views_of_a_scene(count, step_px):
    """Frames of a camera that moves to the right."""
    (scene, _) = linear_pictures((700, 400))
    starts = [60 + step_px * k for k in range(count)]
    return [to_8bit(scene[40:280, start : start + 320]) for start in starts]


@pytest.mark.parametrize("nearest", [0, 7, 19])
def test_the_frame_with_the_view_of_the_still_is_found_whatever_its_tone(nearest):
    frames = views_of_a_scene(20, 6)
    still = to_8bit(toned(to_linear(frames[nearest].astype(np.float32) / 255)))
    match = match_still(still, frames)
    assert abs(match.frame - nearest) <= 1
    assert match.residual_px < 0.5
    shift = 6 * (match.frame - nearest) * 2 / 320
    corner = match.homography @ [0, 0, 1]
    np.testing.assert_allclose(corner[:2] / corner[2], [-shift, 0], atol=0.01)


def test_no_frame_matches_a_still_of_another_scene():
    frames = views_of_a_scene(6, 6)
    noise = np.random.default_rng(0).integers(0, 256, frames[0].shape, dtype=np.uint8)
    assert match_still(noise, frames) is None


@pytest.mark.parametrize("size", [(240, 320), (320, 180)])
def test_a_film_may_have_another_aspect_ratio_than_the_photo(size):
    (scene, _) = linear_pictures((700, 500))
    width, height = size
    still = to_8bit(scene[100 : 100 + round(width * 0.75), 100 : 100 + width])
    frames = [to_8bit(scene[90 : 90 + height, 90 + k : 90 + k + width]) for k in (0, 10, 20)]
    match = match_still(still, frames)
    assert match is not None
    assert match.residual_px < 1


def measurements(positions):
    count = len(positions)
    ones = np.ones(count)
    return FilmMeasurements(
        positions=np.array(positions, float),
        sharpness=ones,
        contrast=20 * ones,
        response=ones,
        correlation=ones,
        difference=ones,
        zoom=0 * ones,
    )


@given(st.integers(2, 60), st.data())
def test_the_frame_of_the_still_is_always_among_the_chosen_ones(count, data):
    steps = data.draw(st.lists(st.floats(0, 0.04), min_size=count, max_size=count))
    nearest = data.draw(st.integers(0, count - 1))
    chosen = choose_around(measurements(np.cumsum(steps)), nearest)
    assert nearest in chosen
    assert chosen == sorted(set(chosen))
    assert len(chosen) == min(count, 7)


@given(
    st.lists(st.sampled_from([0.005, 0.01, 0.1]), min_size=2, max_size=60),
    st.data(),
)
def test_frames_behind_a_jump_of_the_camera_are_not_chosen(steps, data):
    positions = np.cumsum(steps)
    nearest = data.draw(st.integers(0, len(positions) - 1))
    for chosen in choose_around(measurements(positions), nearest):
        first, last = sorted((chosen, nearest))
        assert (np.diff(positions[first : last + 1]) < 0.05).all()


@given(st.integers(10, 60), st.data())
def test_the_frame_of_the_still_replaces_the_chosen_one_next_to_it(count, data):
    """The chosen frames still reach from one end of the path to the other."""
    positions = 0.004 * np.arange(count)
    nearest = data.draw(st.integers(0, count - 1))
    usual = choose(measurements(positions), 7)
    chosen = choose_around(measurements(positions), nearest)
    widest = max(np.diff(usual))
    assert all(min(abs(k - other) for other in chosen) <= widest / 2 for k in usual)


@pytest.mark.parametrize(("zoom", "is_left_out"), [(1.02, False), (1.15, True), (2.0, True)])
def test_frames_with_another_zoom_than_that_of_the_still_are_left_out(zoom, is_left_out):
    burst = simulate_burst(
        *linear_pictures((400, 300)), frames=14, size=SIZE, relative_px=5, common_px=4
    )
    matrix = cv2.getRotationMatrix2D((160, 120), 0, zoom)
    frames = [
        frame if k < 9 else cv2.warpAffine(frame, matrix, SIZE)
        for k, frame in enumerate(burst.frames)
    ]
    thumbnails = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    chosen = choose_around(measure_film(thumbnails), 4)
    compared = _Moving.find(frames, chosen, 4).frames
    assert 4 in compared
    assert len(compared) >= 5
    assert (max(compared) < 9) == is_left_out
