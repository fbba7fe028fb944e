"""Photos of one scene by a camera that stands while the light changes: gains, layers, reports."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import brewster
from brewster import separate_burst
from brewster.errors import PhotoError
from brewster.film import fit_burst
from brewster.film.light.changing_light import shared_light, solve_light
from brewster.film.light.fit import aligned_photos, fit_light
from brewster.film.light.flash import solve_flash
from brewster.film.light.gains import fit_gains, noise_level
from brewster.film.light.registration import align
from brewster.film.motion.registration.tracks import Track, layer_tracks
from brewster.film.self_check import burst_report
from brewster.photo.camera_settings import CameraSettings
from brewster.photo.srgb import to_encoded

SHAPE = (120, 160)


def scene(seed, cell=10):
    """Random patches of light, (h, w, 3)."""
    rng = np.random.default_rng(seed)
    height, width = SHAPE
    coarse = rng.uniform(0.02, 0.6, (height // cell + 2, width // cell + 2, 3)).astype(np.float32)
    large = cv2.resize(coarse, None, fx=cell, fy=cell, interpolation=cv2.INTER_NEAREST)
    top, left = rng.integers(0, cell, 2)
    return cv2.GaussianBlur(large[top : top + height, left : left + width], (0, 0), 0.7)


def noisy(light, seed):
    rng = np.random.default_rng(seed)
    return np.clip(light + rng.normal(0, 1, light.shape) * 0.003, 0, 1).astype(np.float32)


def polariser_photos(contrast=0.9, gains=(1.0, 0.8, 1.0, 1.1, 0.9)):
    """T, R and five photos in which R has 1 - `contrast` to 1 times its light."""
    transmission = scene(1)
    reflection = 0.35 * scene(2, cell=14)
    strengths = 1 - contrast * np.cos(np.linspace(0, np.pi, 5, endpoint=False)) ** 2
    photos = [
        noisy(gain * (transmission + strength * reflection), k)
        for k, (gain, strength) in enumerate(zip(gains, strengths, strict=True))
    ]
    return transmission, strengths[2] * reflection, np.stack(photos)


def cloth_photos():
    """T, and three photos in which a cloth covers a third of R each."""
    transmission = scene(1)
    reflection = 0.35 * scene(2, cell=14)
    photos = []
    for k in range(3):
        covered = reflection.copy()
        covered[:, k * 54 : (k + 1) * 54] = 0
        photos.append(noisy(transmission + covered, k))
    return transmission, np.stack(photos)


def flash_photos(exposure=0.8):
    """T, and a photo with and one without flash, whose light falls from left to right."""
    transmission = scene(1)
    reflection = 0.35 * scene(2, cell=14)
    fall = np.linspace(1.2, 0.3, SHAPE[1], dtype=np.float32)[None, :, None]
    lit = exposure * (transmission * (1 + fall) + reflection)
    return transmission, np.stack([noisy(lit, 0), noisy(transmission + reflection, 1)])


NOTHING = brewster.Separator(lambda tile: (tile, np.zeros_like(tile)))
"""A model that finds no reflection."""


def as_photos(frames):
    return [
        brewster.Photo.from_array(
            np.rint(255 * to_encoded(frame.clip(0, 1))).astype(np.uint8), encoding="srgb"
        )
        for frame in frames
    ]


def error(image, truth):
    return float(np.sqrt(np.mean(np.square(image - truth))))


@settings(deadline=None, max_examples=5)
@given(st.lists(st.floats(0.5, 2.0), min_size=3, max_size=3))
def test_gains_are_those_of_the_scene_whatever_is_mirrored(factors):
    scale = 0.5 / max(*factors, 1.0)
    gains = scale * np.array([1.0, *factors])
    frames = [
        noisy(gain * (scene(1) + 0.3 * scene(seed)), seed)
        for seed, gain in enumerate(gains, start=5)
    ]
    found = fit_gains(np.stack(frames), 0)
    assert np.abs(np.log(found / (gains / gains[0])[:, None])).max() < 0.08


def test_noise_is_measured_and_not_the_scene():
    frames = np.stack([noisy(np.full((*SHAPE, 3), 0.25), k) + 0 * scene(1) for k in range(5)])
    structured = np.stack([noisy(0.2 + 0.3 * scene(1), k) for k in range(5)])
    # sqrt: noise of 0.003 at 0.25 is 0.003 / (2 * 0.5)
    assert noise_level(frames) == pytest.approx(0.003, rel=0.3)
    assert noise_level(structured) < 0.006


def test_a_turned_polariser_separates_the_layers():
    transmission, reflection, photos = polariser_photos()
    solution = solve_light(photos, 2)
    assert solution.kind == "one reflection"
    assert solution.contrast > 0.7
    assert error(solution.layers[0], transmission) < 0.2 * error(photos[2], transmission)
    assert error(solution.layers[1], reflection) < 0.25 * reflection.mean()


def test_light_that_is_clipped_in_some_photos_is_measured_in_the_others():
    """A bright part of R, and a lamp that is clipped in all photos and stays as it is."""
    transmission, _, _ = polariser_photos()
    reflection = 0.35 * scene(2, cell=14)
    bright = np.s_[25:55, 25:55]
    lamp = np.s_[75:95, 95:125]
    reflection[20:60, 20:60] = 0.8
    transmission[70:100, 90:130] = 1.5
    strengths = 1 - 0.9 * np.cos(np.linspace(0, np.pi, 5, endpoint=False)) ** 2
    photos = np.stack([noisy(transmission + s * reflection, k) for k, s in enumerate(strengths)])
    clipped = [(photo[bright] > 0.98).mean() for photo in photos]
    assert max(clipped) > 0.5
    assert max(clipped[0], clipped[1]) == 0
    measured, _ = solve_light(photos, 1).layers
    wrong = error(photos[1][bright], transmission[bright])
    assert error(measured[bright], transmission[bright]) < 0.25 * wrong
    np.testing.assert_allclose(measured[lamp], photos[1][lamp], atol=0.01)


def wide_polariser_photos():
    """T, R of the middle photo, and five photos whose angle of incidence and direction of
    polarisation differ within the photo.
    """
    transmission = scene(1)
    reflection = 0.5 * scene(2, cell=14)
    height, width = SHAPE
    y, x = np.mgrid[:height, :width] / np.array(SHAPE)[:, None, None] - 0.5
    photos = []
    layers = []
    for k in range(5):
        share = np.cos(0.4 + np.pi * k / 5 - 0.4 * y)[..., None] ** 2
        layer = (0.15 + 0.2 * x[..., None]) * (1 - share) + share
        layers.append(((1 - 0.2 * share) * transmission, layer * reflection))
        photos.append(noisy(sum(layers[-1]), k))
    return *layers[2], np.stack(photos)


def test_two_photos_are_no_evidence_that_one_mirrored_scene_changed():
    transmission, _, photos = polariser_photos()
    solution = solve_light(photos[[2, 0]], 0)
    assert solution.kind == "changing reflection"
    assert error(solution.layers[0], transmission) < error(photos[2], transmission)


def test_a_polariser_may_act_differently_within_the_photo():
    transmission, reflection, photos = wide_polariser_photos()
    solution = solve_light(photos, 2)
    assert solution.kind == "one reflection"
    assert error(solution.layers[0], transmission) < 0.25 * error(photos[2], transmission)
    assert error(solution.layers[1], reflection) < 0.25 * reflection.mean()


def test_an_automatic_exposure_that_follows_the_reflection_does_not_exchange_the_layers():
    transmission, reflection = 0.4 * scene(1), scene(2, cell=14)
    strengths = 1 - 0.9 * np.cos(np.linspace(0, np.pi, 5, endpoint=False) + 0.3) ** 2
    photos = [transmission + strength * reflection for strength in strengths]
    gains = [0.2 / photo.mean() for photo in photos]
    frames = np.stack(
        [noisy(g * photo, k) for k, (g, photo) in enumerate(zip(gains, photos, strict=True))]
    )
    solution = solve_light(frames, 2)
    truth = gains[2] * transmission
    assert solution.kind == "one reflection"
    assert error(solution.layers[0], truth) < 0.25 * error(frames[2], truth)


def exposed_for_the_reflection():
    """T of the middle photo, and five photos whose automatic exposure keeps the light of R about
    the same, so that T becomes brighter and darker.
    """
    transmission, reflection = scene(1), scene(2, cell=14)
    strengths = 1 - 0.7 * np.cos(np.linspace(0, np.pi, 5, endpoint=False) + 0.3) ** 2
    gains = 0.4 / strengths**0.8
    photos = [
        noisy(gain * (0.3 * transmission + strength * 0.6 * reflection), k)
        for k, (gain, strength) in enumerate(zip(gains, strengths, strict=True))
    ]
    return gains[2] * 0.3 * transmission, gains, np.stack(photos)


def test_the_single_photo_names_layers_whose_light_changes_the_wrong_way():
    transmission, _, photos = exposed_for_the_reflection()
    by_light = solve_light(photos, 2)
    blurred = cv2.GaussianBlur(transmission, (0, 0), 2)
    named = solve_light(photos, 2, single=blurred)
    assert named.kind == by_light.kind == "one reflection"
    assert error(named.layers[0], transmission) < 0.3 * error(by_light.layers[0], transmission)
    assert error(named.layers[1], by_light.layers[0]) < 0.1 * by_light.layers[0].mean()


def test_exposures_of_exif_name_layers_whose_light_changes_the_wrong_way():
    transmission, gains, photos = exposed_for_the_reflection()
    by_light = solve_light(photos, 2)
    exif = 7 * gains * np.array([1.05, 0.95, 1, 1.03, 0.97])
    named = solve_light(photos, 2, exposures=exif, single=by_light.layers[0])
    assert named.kind == "one reflection"
    assert error(named.layers[0], transmission) < 0.3 * error(by_light.layers[0], transmission)


def test_names_are_asked_where_the_single_photo_and_the_light_disagree():
    transmission, gains, photos = exposed_for_the_reflection()
    blurred = cv2.GaussianBlur(transmission, (0, 0), 2)
    unlike = blurred + 0.6 * photos[2]  # nearer to T, but not decisively
    certain = [
        solve_light(photos, 2, **cues).are_names_certain
        for cues in ({"single": unlike}, {"single": blurred}, {"exposures": gains})
    ]
    assert certain == [False, True, True]
    aligned = aligned_photos(list(photos), 2, [])
    report = fit_light(aligned, lambda light: light, single=unlike, is_forced=True).report(2)
    assert not report.are_names_certain
    assert "swap" in report.next_step


def test_exposures_of_exif_tell_whose_edges_are_those_of_the_scene():
    """The edges of R are stronger, and an automatic exposure keeps them as they are."""
    strengths = np.array([1.0, 0.7, 0.3, 0.8, 0.5])
    gains = 0.4 / strengths
    photos = [
        noisy(gain * (0.3 * scene(1) + strength * scene(2, cell=14)), k)
        for k, (gain, strength) in enumerate(zip(gains, strengths, strict=True))
    ]
    exif = 7 * gains * np.array([1.1, 0.95, 1, 1.05, 0.9])
    without, found = (
        np.log(fit_gains(np.stack(photos), 2, exposures).mean(1) * gains[2] / gains)
        for exposures in (None, exif)
    )
    assert np.abs(without).max() > 0.2
    assert np.abs(found).max() < 0.06


def test_exposures_of_exif_with_which_no_edges_agree_are_not_used():
    _, _, photos = polariser_photos()
    wrong = np.array([1.0, 30.0, 1.0, 0.03, 1.0])
    assert fit_gains(photos, 2, wrong) == pytest.approx(fit_gains(photos, 2))


def test_the_layers_have_the_exposure_of_the_reference_photo():
    transmission, _, photos = polariser_photos(gains=(1.0, 0.8, 0.5, 1.1, 0.9))
    solution = solve_light(photos, 2)
    assert solution.layers[0].mean() == pytest.approx(0.5 * transmission.mean(), rel=0.05)
    assert solution.layers.sum(0) == pytest.approx(photos[2], abs=0.05)


def test_a_cloth_uncovers_the_scene_without_a_border():
    transmission, photos = cloth_photos()
    solution = solve_light(photos, 1)
    assert solution.kind == "changing reflection"
    difference = np.abs(solution.layers[0] - transmission)
    assert np.median(difference) < 0.004
    borders = difference[:, [53, 54, 107, 108]]
    assert borders.mean() < 2 * difference.mean() + 0.003


@settings(deadline=None, max_examples=5)
@given(st.integers(0, 1000), st.integers(2, 6))
def test_the_transmission_is_no_brighter_than_any_photo(seed, count):
    frames = np.stack([noisy(scene(1) + 0.4 * scene(seed + k), seed + k) for k in range(count)])
    solution = solve_light(frames, 0)
    gains = fit_gains(frames, 0)
    least = (frames / gains[:, None, None]).min(0)
    if solution.kind == "changing reflection":
        assert (solution.layers[0] <= least + 0.06).all()
    assert (solution.layers >= 0).all()


def test_the_minimum_has_less_noise_than_the_darkest_pixel():
    truth = scene(1)
    frames = np.stack([noisy(truth, k) for k in range(6)])
    light = shared_light(frames, noise_level(frames))
    assert error(light, truth) < 0.5 * error(frames.min(0), truth)


def test_clipped_light_of_an_overexposed_photo_is_not_the_scene():
    transmission = 0.3 + 0.5 * scene(1)
    photos = [noisy(transmission + 0.3 * scene(k), k) for k in (3, 4)]
    photos.append(np.clip(3 * (transmission + 0.3 * scene(5)), 0, 1).astype(np.float32))
    solution = solve_light(np.stack(photos), 0)
    is_clipped = (photos[2] >= 1).any(-1)
    assert is_clipped.mean() > 0.3
    assert solution.layers[0][is_clipped].mean() > 0.95 * transmission[is_clipped].mean()


def test_light_that_is_clipped_in_all_photos_stays_white():
    _, _, photos = polariser_photos()
    photos[:, 40:80, 60:120] = 1
    solution = solve_light(photos, 2)
    assert solution.layers[0][45:75, 65:115] == pytest.approx(1)


def test_a_model_takes_no_haze_from_a_scene_that_the_photos_show_without_reflection():
    transmission, photos = cloth_photos()
    solution = solve_light(photos, 1, refine=lambda light: 0.5 * light)
    assert error(solution.layers[0], transmission) < 0.2 * error(0.5 * transmission, transmission)


def test_the_model_decides_where_little_of_the_reflection_changes():
    transmission = scene(1)
    reflection = 0.5 * scene(2, cell=14)
    photos = []
    for k in range(3):
        changed = reflection.copy()
        changed[:, k * 54 : (k + 1) * 54] *= 0.8
        photos.append(noisy(transmission + changed, k))
    solution = solve_light(np.stack(photos), 1, refine=lambda _: transmission)
    assert solution.kind == "changing reflection"
    assert error(solution.layers[0], transmission) < 0.1 * error(photos[1], transmission)
    aligned = aligned_photos(photos, 1, [])
    report = fit_light(aligned, lambda _: transmission, is_forced=True).report(1)
    assert report.light.contrast < 0.5
    assert "steeper" in report.message


def test_the_model_decides_where_no_light_changes():
    transmission, photos = cloth_photos()
    right = slice(110, None)
    photos[:, :, right] = noisy(transmission + 0.2, 3)[:, right]
    seen = []
    solution = solve_light(photos, 1, refine=lambda light: seen.append(light) or 0.5 * light)
    assert solution.layers[0][:, 140:] == pytest.approx(0.5 * seen[0][:, 140:], abs=0.02)


@pytest.mark.parametrize(("exposure", "share"), [(0.8, 0.85), (None, 1.0)])
def test_a_flash_tells_which_edges_are_behind_the_glass(exposure, share):
    transmission, photos = flash_photos()
    single = transmission + 0.5 * (photos[1] - transmission)
    solution = solve_flash(photos, 1, 0, single, exposure)
    assert solution.kind == "flash"
    assert error(solution.layers[0], transmission) < share * error(single, transmission)


def test_the_layers_of_a_photo_with_flash_have_its_light():
    transmission, photos = flash_photos()
    single = transmission + 0.5 * (photos[1] - transmission)
    solution = solve_flash(photos, 0, 0, single, 0.8)
    assert solution.layers.sum(0) == pytest.approx(photos[0], abs=0.01)
    reflection = 0.8 * 0.35 * scene(2, cell=14)
    assert error(solution.layers[1], reflection) < 0.5 * reflection.mean()


def test_a_flash_that_reaches_nothing_is_no_evidence():
    _, photos = flash_photos()
    still = np.stack([noisy(photos[1], 5), photos[1]])
    assert solve_flash(still, 1, 0, photos[1], 1.0) is None


def test_the_settings_of_the_camera_decide_whether_a_flash_fired():
    transmission, photos = flash_photos()
    for has_flash, kind in ((True, "flash"), (False, None)):
        settings = [CameraSettings(has_flash, 0.8), CameraSettings(False, 1.0)]
        aligned = aligned_photos(photos, 1, layer_tracks(photos, 1, transmission))
        fit = fit_light(aligned, lambda light: light, settings=settings, is_forced=True)
        assert (fit.light.kind == "flash") is (kind == "flash")


def test_a_still_pair_stays_as_it_is():
    photos = as_photos([noisy(scene(1) + 0.3 * scene(2), k) for k in range(2)])
    result = separate_burst(photos, separator=NOTHING)
    assert (result.burst.method, result.burst.light.kind) == ("unchanged", "nothing")
    assert (result.transmission.pixels == photos[1].pixels).all()


def test_a_series_of_exposures_is_named():
    light = 0.2 * (scene(1) + 0.3 * scene(2))
    photos = as_photos([noisy(gain * light, k) for k, gain in enumerate((0.5, 1, 2, 4))])
    report = separate_burst(photos, separator=NOTHING).burst
    assert (report.method, report.light.kind) == ("unchanged", "exposure")
    assert "HDR" in report.message


def exposures(stops, scale=4):
    """Photos of one scene with details of less than a pixel, which are clipped before they are
    reduced, as in a camera.
    """
    rng = np.random.default_rng(1)
    height, width = SHAPE
    light = cv2.resize(0.5 * scene(1) + 0.2 * scene(2, cell=14), (scale * width, scale * height))
    light *= np.exp(0.3 * rng.standard_normal(light.shape[:2])[..., None]).astype(np.float32)
    recorded = [np.clip(2.0**stop * light, 0, 1).astype(np.float32) for stop in stops]
    reduced = [cv2.resize(each, (width, height), interpolation=cv2.INTER_AREA) for each in recorded]
    return np.stack([noisy(each, k) for k, each in enumerate(reduced)])


@pytest.mark.parametrize("reference", [0, 1])
def test_clipped_details_do_not_change_the_exposure(reference):
    photos = exposures((0, -2, 2))
    assert (photos[2] > 0.5).mean() > 0.3
    gains = fit_gains(photos, reference)
    assert gains[2] / gains[1] == pytest.approx(16, rel=0.1)
    assert solve_light(photos, reference).kind == "exposure"


def test_a_burst_finds_by_itself_that_the_light_changed():
    transmission, _, photos = polariser_photos()
    fitted = fit_burst(as_photos(photos), separator=NOTHING)
    result, exchanged = (
        fitted.chosen("auto", swap=swap).separate(lambda _done: None) for swap in (False, True)
    )
    assert (result.burst.method, result.burst.light.kind) == ("light", "one reflection")
    assert error(result.transmission.linear(), transmission) < 0.4 * error(photos[2], transmission)
    assert result.swapped().burst.is_swapped
    assert exchanged.burst.is_swapped
    layers = [layer.linear() for layer in (*result, *exchanged)]
    assert error(layers[2], layers[1]) < 0.1 * error(layers[0], layers[1])
    assert error(layers[3], layers[0]) < 0.1 * error(layers[0], layers[1])


def test_motion_is_measured_on_request_although_the_light_changed():
    _, _, photos = polariser_photos()
    report = separate_burst(as_photos(photos[:2]), separator=NOTHING, method="single").burst
    assert (report.method, report.light) == ("single photo", None)


def test_a_touched_tripod_is_aligned_and_another_scene_is_left_out():
    transmission, _, photos = polariser_photos()
    turned = cv2.warpAffine(
        photos[1], np.array([[1, 0.004, 1.7], [-0.004, 1, -1.2]]), SHAPE[::-1], borderMode=1
    )
    frames = [photos[0], turned, photos[2], scene(77)]
    aligned = align(frames, 2, layer_tracks(frames, 2, transmission))
    assert aligned.left_out == (3,)
    assert aligned.travel_px > 5
    inner = slice(10, -10), slice(10, -10)
    before = error(turned[inner], photos[1][inner])
    assert error(aligned.frames[1][inner], photos[1][inner]) < 0.4 * before


@pytest.mark.parametrize("is_moved", [True, False])
@pytest.mark.parametrize("count", [2, 3])
def test_a_second_motion_counts_if_what_changes_agrees_with_it(is_moved, count):
    shifts = 6 * (np.arange(count) - count // 2)
    mirrored = 0.35 * scene(2, cell=14)
    frames = [
        noisy(scene(1) + (np.roll(mirrored, shift, axis=1) if is_moved else 0.6 * scene(9 + k)), k)
        for k, shift in enumerate(shifts)
    ]
    motions = [np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1.0]]) for shift in shifts]
    place = np.zeros((1, 2), np.int64)
    tracks = [Track([np.eye(3)] * count, place), Track(motions, place)]
    aligned = align(frames, count // 2, tracks)
    assert (aligned.is_still, aligned.has_other_motion) == (True, is_moved)


@settings(deadline=None, max_examples=20)
@given(st.integers(40, 200), st.integers(40, 200), st.floats(-9, 9), st.floats(-9, 9))
def test_the_motion_of_a_layer_is_that_of_the_resized_photos(width, height, x, y):
    track = Track([np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])], np.array([[20, 10]]))
    resized = track.resized((100, 80), (height, width))
    motion = resized.motions[0]
    assert motion is not None
    assert motion @ (0, 0, 1) == pytest.approx([x * width / 80, y * height / 100, 1])
    assert resized.places.tolist() == [[20 * width // 80, 10 * height // 100]]


@pytest.mark.parametrize("change", ["focus", "zoom"])
def test_a_photo_with_another_focus_or_zoom_is_left_out(change):
    transmission, _, photos = polariser_photos()
    height, width = SHAPE
    changed = (
        cv2.GaussianBlur(photos[4], (0, 0), 4)
        if change == "focus"
        else cv2.resize(photos[4], None, fx=1.3, fy=1.3)[18 : 18 + height, 24 : 24 + width]
    )
    frames = [*photos[:4], changed]
    aligned = align(frames, 2, layer_tracks(frames, 2, transmission))
    assert aligned.left_out == (4,)


def test_sharp_photos_do_not_separate_one_out_of_focus():
    transmission, _, photos = polariser_photos()
    soft = cv2.GaussianBlur(photos[2], (0, 0), 4)
    frames = [photos[0], soft]
    assert align(frames, 1, layer_tracks(frames, 1, transmission)).left_out == (0,)


def test_a_burst_that_motion_does_not_separate_says_that_the_light_changed():
    refused = burst_report(None, "little found", 3, (), 1)
    transmission, photos = cloth_photos()
    still = np.stack([noisy(transmission, k) for k in range(3)])
    for frames, has_hint in ((photos, True), (still, False)):
        aligned = aligned_photos(frames, 1, layer_tracks(frames, 1, transmission))
        fit = fit_light(aligned, lambda light: light, is_forced=False)
        assert ('"light"' in (fit.with_hint(refused).next_step or "")) is has_hint


@pytest.mark.parametrize("case", ["nothing", "exposure", "scene", "hand"])
def test_the_method_light_says_what_to_do_where_it_cannot_separate(case):
    _, photos = cloth_photos()
    other = noisy(
        {
            "nothing": photos[1],
            "exposure": 0.4 * photos[1],
            "scene": scene(77),
            "hand": np.roll(photos[0], 12, axis=1),
        }[case],
        7,
    )
    report = separate_burst(as_photos([other, photos[1]]), separator=NOTHING, method="light").burst
    step = {"nothing": "single", "exposure": "single"}.get(case, "motion")
    assert f'"{step}"' in (report.next_step or "")


def test_a_changing_reflection_says_where_no_light_changed():
    _, photos = cloth_photos()
    part = photos[1].copy()
    part[:40] = photos[0][:40]
    static, whole = (
        separate_burst(as_photos(frames), separator=NOTHING).burst
        for frames in ([noisy(photos[1], 3), part], photos)
    )
    assert "no light changed" in static.message
    assert "no light changed" not in whole.message


def test_one_photo_twice_counts_once_and_does_not_stop_the_others():
    transmission, _, photos = polariser_photos()
    solution = solve_light(np.stack([*photos, photos[0]]), 2)
    assert error(solution.layers[0], transmission) < 0.5 * error(photos[2], transmission)


def test_many_photos_need_the_method_light():
    photos = as_photos([noisy(scene(1) + 0.3 * scene(k), k) for k in range(16)])
    with pytest.raises(PhotoError, match="expected 2 to 15"):
        separate_burst(photos, separator=NOTHING)
    report = separate_burst(photos, method="light", separator=NOTHING).burst
    assert (report.method, report.frames) == ("light", 16)
