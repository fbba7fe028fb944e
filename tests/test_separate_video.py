"""Every frame of a film: motions, layers, and the videos, on small films."""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from time import sleep
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from brewster.batch import plan_files, separate_files
from brewster.batch.layer_names import name_videos
from brewster.batch.plan import plan_bursts
from brewster.errors import BrewsterError, OutputError, PhotoError
from brewster.film import separate_video
from brewster.film.fitted_burst import window_means
from brewster.film.motion.model.joint_model import pixel_grid
from brewster.film.motion.model.kernels import MARGIN
from brewster.film.motion.model.levels import Level
from brewster.film.motion.solver import solve
from brewster.film.separate import fit_burst
from brewster.film.separate_video import _FrameLayers, _separated
from brewster.film.tracking import Tracker, coverage, followed, solved_motions
from brewster.film.video.decoding import decoded
from brewster.options import Options
from brewster.photo import Photo
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.guided_upsampling import GeneratedOverride, GuidedUpsampler, box_mean
from simulated_bursts import linear_pictures, psnr_db
from video_files import turn_display_matrix, write_audio

SIZE = 128, 96
COUNT = 24
ANGLES = 2 * np.pi * np.arange(COUNT) / COUNT
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)
RADII = 7, 2
"""Of the circles of T and R, in pixels."""
TICKS = [2 * k + (k % 3 == 0) for k in range(COUNT)]
"""The times of the frames, in units of 1/60 s: a variable rate."""


@pytest.fixture(scope="module")
def film():
    """The frames of a film, 8-bit, and their true T, in linear light.

    T moves along a circle, R less; the exposure changes by 30 %.
    """
    layers = linear_pictures((192, 144))
    frames = []
    truth = []
    for place, gain in zip(CIRCLE, 0.7 * np.exp(0.15 * CIRCLE[:, 1]), strict=True):
        behind, mirrored = (
            view(layer, radius * place) for layer, radius in zip(layers, RADII, strict=True)
        )
        truth.append(gain * behind)
        encoded = to_encoded((gain * (behind + 0.6 * mirrored)).clip(0, 1))
        frames.append(np.rint(255 * encoded).astype(np.uint8))
    return frames, truth


def view(picture, shift):
    x, y = shift
    matrix = np.float32([[1, 0, -32 - x], [0, 1, -24 - y]])
    return np.maximum(cv2.warpAffine(picture, matrix, SIZE, flags=cv2.INTER_CUBIC), 0)


def write_film(path, frames, *, rotation=0, ticks=TICKS, sound_rate=8000, sound="aac", sound_s=1):
    """Writes a film with sound. `rotation` is in steps of 90 degrees."""
    with av.open(str(path), "w") as container:
        video = container.add_stream(
            "libx264", rate=60, options={"crf": "8", "preset": "ultrafast"}
        )
        video.height, video.width = frames[0].shape[:2]
        video.pix_fmt = "yuv420p"
        audio = container.add_stream(sound, rate=sound_rate, layout="mono") if sound else None
        for number, frame in zip(ticks, frames, strict=False):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts = number
            picture.time_base = Fraction(1, 60)
            container.mux(video.encode(picture))
        container.mux(video.encode())
        if audio:
            samples = np.sin(np.arange(sound_rate) / 5).astype(np.float32)[None]
            block = av.AudioFrame.from_ndarray(samples, format="fltp", layout="mono")
            block.sample_rate = sound_rate
            container.mux(audio.encode(block))
            container.mux(audio.encode())
    if rotation:
        turn_display_matrix(path, rotation)
    return path


def frames_of(path):
    return [frame.picture() for frame in decoded(path, 10**8, is_complete=True)]


def times_of(path):
    """The times from the first frame on, in ms."""
    times = np.array([frame.time_s for frame in decoded(path, 10**8, is_complete=True)])
    return np.rint(1000 * (times - times[0])).tolist()


def sound_of(path):
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(audio=0) if packet.size]


@pytest.fixture(scope="module")
def fitted(film):
    photos = [Photo.from_array(frame, encoding="srgb") for frame in film[0][::4]]
    with pytest.MonkeyPatch.context() as patch:
        levels = (Level(128, 60, (4, 6), density=1.5),)
        patch.setattr("brewster.film.measuring.solve", partial(solve, levels=levels))
        return fit_burst(photos).chosen("motion", swap=False)


def test_the_transmission_of_every_frame_is_clearer_and_flickers_less(film, fitted):
    frames, truth = film
    exposures = np.exp(0.15 * CIRCLE[:, 1] / 2.4)
    motions = followed(fitted.model, frames)
    layers = _FrameLayers(fitted, SIZE[::-1], 1.0)
    clear = [layers.of(frame, motion)[0] for frame, motion in zip(frames, motions, strict=True)]
    before, after = (
        [
            psnr_db(to_linear(picture / 255), true)
            for picture, true in zip(pictures, truth, strict=True)
        ]
        for pictures in (frames, clear)
    )
    assert np.subtract(after, before).min() > 3
    flickers = []
    for pictures in (frames, clear):
        encoded = [picture / gain for picture, gain in zip(pictures, exposures, strict=True)]
        aligned = [
            cv2.warpAffine(picture, np.float32([[1, 0, x], [0, 1, y]]), SIZE)[20:-20, 20:-20]
            for picture, (x, y) in zip(encoded, RADII[0] * CIRCLE, strict=True)
        ]
        flickers.append(np.abs(np.diff(aligned, axis=0)).mean())
    assert flickers[1] < flickers[0]


def test_the_motion_of_frames_that_were_not_solved_is_followed(film, fitted):
    motions = np.array(followed(fitted.model, film[0])).mean((3, 4)) * (SIZE[0] / 2, SIZE[1] / 2)
    # In few small frames, the place of R in the reference frame is less certain than its motion
    # between the others
    motions -= motions.mean(0)
    errors = [motions[:, layer] - radius * CIRCLE for layer, radius in enumerate(RADII)]
    assert np.abs(errors[0]).max() < 0.3
    assert np.abs(errors[1]).mean() < 0.5


def test_a_known_motion_is_recovered_from_a_wrong_start(fitted):
    tracker = Tracker(fitted.model, (90, 120))
    motion = solved_motions(fitted.model)[1]
    gain = np.float32(0.8)
    frame = gain * tracker.total(motion)
    start = motion + np.array([0.03, -0.02])[None, :, None, None]
    found = tracker.aligned(frame, start, 8)
    gains, errors = tracker.fit(frame, found)
    assert errors.mean() < 0.3 * tracker.fit(frame, start)[1].mean()
    np.testing.assert_allclose(gains, gain, rtol=0.05)


def test_the_motions_of_the_solution_are_those_of_the_model(fitted):
    model = fitted.model
    size = (90, 120)
    tracker = Tracker(model, size)
    # Images of coordinates instead of layers
    canvases = [np.moveaxis(pixel_grid(*size) * (1 + 2 * MARGIN), 0, -1).astype(np.float32)] * 2
    for k, motion in enumerate(solved_motions(model)):
        for layer, positions in enumerate(tracker.samples(tracker.places(motion), canvases)):
            expected = np.moveaxis(model.positions(0, layer, k, *size), 0, -1)
            assert np.abs(positions - expected)[9:-9, 9:-9].max() < 0.02


def test_places_that_one_frame_shows_are_not_covered(fitted):
    for cover in coverage(fitted.model):
        height, width, _ = cover.shape
        assert cover[height // 3 : -height // 3, width // 3 : -width // 3].min() == 1
        assert cover[0].max() == cover[:, 0].max() == 0
        assert np.abs(np.diff(cover[..., 0], axis=1)).max() < 0.5  # no hard seam


def test_a_frame_of_another_scene_is_its_own_transmission(fitted):
    other = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    other = cv2.resize(other, SIZE, interpolation=cv2.INTER_NEAREST)
    motion = solved_motions(fitted.model)[2]
    transmission, reflection = _FrameLayers(fitted, SIZE[::-1], 1.0).of(other, motion)
    assert np.abs(transmission.astype(int) - other).mean() < 3
    assert reflection.mean() < 5


def test_strength_zero_is_the_film(film, fitted):
    motion = solved_motions(fitted.model)[2]
    transmission, reflection = _FrameLayers(fitted, SIZE[::-1], 0.0).of(film[0][8], motion)
    assert np.abs(transmission.astype(int) - film[0][8]).max() <= 1
    assert reflection.max() == 0


def test_the_command_writes_videos_with_times_rotation_and_sound(
    run_without_model, tmp_path, film, few_steps
):
    write_film(tmp_path / "window.mp4", film[0], rotation=1)
    options = "--all-frames", "--method", "motion", "--swap"
    command = "burst", "window.mp4", *options, "-o", "clear.mp4", "--json"
    code, out, err = run_without_model(*command)
    assert code == 0, err
    report = json.loads(out)
    assert (report["status"], report["frames_written"]) == ("separated", COUNT)
    assert report["outputs"] == {"transmission": "clear.mp4", "reflection": "clear.reflection.mp4"}
    original = frames_of(tmp_path / "window.mp4")
    assert original[0].shape == (SIZE[0], SIZE[1], 3)  # upright
    for name in ("clear.mp4", "clear.reflection.mp4"):
        assert [picture.shape for picture in frames_of(tmp_path / name)] == [
            original[0].shape
        ] * COUNT
        assert times_of(tmp_path / name) == times_of(tmp_path / "window.mp4")
        sound = sound_of(tmp_path / name)
        assert len(sound) > 3
        assert sound == sound_of(tmp_path / "window.mp4")[: len(sound)]
    layers = (frames_of(tmp_path / name) for name in ("clear.mp4", "clear.reflection.mp4"))
    for transmission, reflection, frame in zip(
        *layers, original, strict=True
    ):  # the layers add up to the film
        total = to_linear(transmission / 255) + to_linear(reflection / 255)
        assert np.abs(to_encoded(total.clip(0, 1)) * 255 - frame).mean() < 8
    assert not list(tmp_path.glob(".brewster-*"))
    assert json.loads(run_without_model(*command)[1])["status"] == "skipped"


def test_a_film_is_decoded_twice_and_opened_once_more_for_each_sound(
    tmp_path, film, few_steps, monkeypatch
):
    path = write_film(tmp_path / "window.mp4", film[0])
    opened = []
    counts = []

    def counting_openings(file, *arguments, **options):
        opened.append(os.fspath(file) if isinstance(file, Path | str) else file)
        return av_open(file, *arguments, **options)

    def counting_frames(*arguments, **options):
        counts.append(0)
        for frame in decoded(*arguments, **options):
            counts[-1] += 1
            yield frame

    av_open = av.open
    monkeypatch.setattr(av, "open", counting_openings)
    monkeypatch.setattr("brewster.film.video.film.decoded", counting_frames)
    outputs = tmp_path / "clear.mp4", tmp_path / "mirrored.mp4"
    separation = separate_video(path, *outputs, method="motion")
    assert separation.frames == COUNT
    assert counts == [COUNT, COUNT]
    # Twice for the frames, once to look at the sound, and to copy it into each of both videos
    assert opened.count(os.fspath(path)) == 5


def test_exchanged_layers_are_exchanged(film, fitted):
    motion = followed(fitted.model, film[0][:4])[2]
    plain, swapped = (
        _FrameLayers(fitted.chosen("motion", swap=swap), SIZE[::-1], 1.0).of(film[0][2], motion)
        for swap in (False, True)
    )
    inner = slice(20, -20), slice(20, -20)
    for layer, other in zip(plain, swapped[::-1], strict=True):
        assert np.abs(layer.astype(int) - other)[inner].mean() < 6
    assert np.abs(plain[0].astype(int) - swapped[0])[inner].mean() > 20


def test_cancelling_leaves_no_file(tmp_path, film, few_steps):
    write_film(tmp_path / "a.mp4", film[0])

    def stop(done):
        if done > 0.8:
            raise KeyboardInterrupt

    paths = [tmp_path / name for name in ("a.mp4", "t.mp4", "r.mp4")]
    with pytest.raises(KeyboardInterrupt):
        separate_video(*paths, method="motion", on_progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize(("arguments", "message"), [
    (("a.jpg", "b.jpg"), "a.jpg is a photo; expected a video"),
    (("a.mp4", "b.mp4", "-o", "clear.mp4"), "There are 2 bursts"),
    (("a.mp4", "-o", "clear.webm"), "writes no videos with this suffix"),
    (("a.mp4", "-o", "clear.jpg"), "writes no videos with this suffix"),
    (("a.mp4", "-o", "a.mp4", "--overwrite"), "is itself a photo of the batch"),
    (("a.mp4", "--method", "single"), "requested with method single"),
    (("a.mp4", "--layers", "confidence", "--mask", "a.jpg"), "requested with mask, layers"),
    (("sound.mp4", "-o", "clear.mp4"), "it has no video stream"),
    (("text.mp4", "-o", "clear.mp4"), "cannot be read as a video"),
    (("still.gif", "-o", "clear.mp4"), "1 frame can be decoded"),
])  # fmt: skip
def test_bad_arguments_for_all_frames_are_refused(
    run_without_model, tmp_path, film, arguments, message
):
    for name in ("a.mp4", "b.mp4"):
        write_film(tmp_path / name, film[0][:3])
    for name in ("a.jpg", "b.jpg", "still.gif"):
        Image.fromarray(film[0][0]).save(tmp_path / name)
    (tmp_path / "text.mp4").write_bytes(b"no video" * 1000)
    write_audio(tmp_path / "sound.mp4")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    code, _, err = run_without_model("burst", *arguments, "--all-frames")
    assert code != 0
    assert message in err
    assert (
        run_without_model("burst", "a.mp4", "-o", "clear.mp4")[0] == 2
    )  # a video needs all frames
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}


def test_refused_layers_are_not_written_and_a_way_out_is_named(
    run_without_model, tmp_path, film, few_steps
):
    write_film(tmp_path / "a.mp4", film[0])
    code, _, err = run_without_model("burst", "a.mp4", "--all-frames", "-o", "clear.mp4")
    assert (code, list(tmp_path.glob("*clear*"))) == (1, [])
    assert err.count("--method motion") == 1
    with pytest.raises(PhotoError, match="does not separate the layers"):
        separate_video(tmp_path / "a.mp4", tmp_path / "clear.mp4")


@pytest.mark.parametrize("name", ["clear.avi", "a.mp4"])
def test_python_refuses_other_suffixes_and_existing_files(tmp_path, film, name):
    write_film(tmp_path / "a.mp4", film[0][:3])
    with pytest.raises(OutputError, match=f"{name} (ends in .avi|exists)"):
        separate_video(tmp_path / "a.mp4", None, tmp_path / name)


def test_a_film_that_was_cut_off_or_covered_or_is_a_gif_is_written_with_notes(
    tmp_path, film, few_steps
):
    frames = film[0]
    hand = [np.full_like(frames[0], 20)] * 6
    ticks = range(0, 120, 2)
    write_film(tmp_path / "whole.mkv", [*hand, *frames, *frames], ticks=ticks, sound=None)
    content = (tmp_path / "whole.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(content[: len(content) // 2])
    result = separate_video(tmp_path / "cut.mkv", tmp_path / "t.mp4", method="motion")
    assert 10 < result.frames < 50
    assert result.frames == len(frames_of(tmp_path / "t.mp4"))
    assert result.note.startswith("only the first ")
    for picture in frames_of(tmp_path / "t.mp4")[:5]:  # the hand
        assert np.abs(picture.astype(int) - 20).mean() < 4
    pictures = [Image.fromarray(np.ascontiguousarray(frame[:95, :127])) for frame in frames]
    pictures[0].save(tmp_path / "a.gif", save_all=True, append_images=pictures[1:], duration=40)
    result = separate_video(tmp_path / "a.gif", tmp_path / "gif.mp4", method="motion")
    assert "256 colours" in result.note
    assert "127 x 95 pixels" in result.note
    assert frames_of(tmp_path / "gif.mp4")[0].shape == (94, 126, 3)
    assert times_of(tmp_path / "gif.mp4") == times_of(tmp_path / "a.gif")


def test_sound_that_a_format_cannot_contain_is_left_out_with_a_note(tmp_path, film, few_steps):
    write_film(tmp_path / "a.mkv", film[0], sound="pcm_u8")
    result = separate_video(tmp_path / "a.mkv", tmp_path / "t.mp4", method="motion")
    assert result.note == "the sound (pcm_u8) was left out, because .mp4 cannot contain it"
    with av.open(str(tmp_path / "t.mp4")) as container:
        assert not container.streams.audio


def test_a_film_of_a_batch_is_separated_with_the_options_of_a_burst(tmp_path, film):
    write_film(tmp_path / "a.mp4", film[0])
    arguments = tmp_path / "a.mp4", tmp_path / "out"
    options = Options(frames=3, method="single", quality="draft")
    (result,) = separate_files(*arguments, options)
    assert (result.error, result.burst.frames, result.burst.method) == (None, 3, "single photo")
    with pytest.raises(BrewsterError, match="all frames were requested"):
        plan_files(*arguments, Options(all_frames=True))


def test_a_gif_is_a_film_in_the_plan_and_each_film_is_separated_alone(tmp_path):
    films = [tmp_path / name for name in ("a.gif", "a.mp4", "b.mp4")]
    for film in films:
        film.touch()
    tasks = plan_bursts(films, options=Options(all_frames=True))
    assert all(task.burst.is_from_video for task in tasks)
    names = [task.outputs["reflection"].name for task in tasks]
    assert names == ["a.gif.reflection.mp4", "a.mp4.reflection.mp4", "b.reflection.mp4"]


@pytest.mark.parametrize(("name", "layer"), [
    *((name, name) for name in ("a.mp4", "a.m4v", "a.mov", "a.mkv", "a.MP4", "a.MOV", "a.Mkv")),
    *((name, "a.mp4") for name in ("a.webm", "a.avi", "a.AVI", "a.gif", "a.MTS", "a.3gp")),
])  # fmt: skip
def test_the_layers_of_a_film_have_its_suffix_if_it_can_be_written(tmp_path, name, layer):
    (tmp_path / name).touch()
    [(_, outputs)] = name_videos([(tmp_path / name, tmp_path)], Options())
    stem, suffix = layer.split(".")
    assert {key: path.name for key, path in outputs.items()} == {
        key: f"{stem}.{key}.{suffix}" for key in ("transmission", "reflection")
    }


def test_layers_as_linear_functions_are_those_of_the_upsampler():
    rng = np.random.default_rng(0)
    photo, layer = rng.random((2, 12, 16, 3), np.float32)
    change = 0.3 * (layer - photo)
    reflection = 0.2 * layer * photo
    override = GeneratedOverride.weighted_by_detail(0.5 * photo, 0.3 * layer)
    fitted = GuidedUpsampler.fit(photo, change, reflection, override)
    mask = rng.random((12, 16, 1), np.float32)
    expected = fitted.apply(photo, 0, 12, mask)
    for (slope, offset), layer in zip(fitted.as_linear(mask), expected, strict=True):
        limited = np.clip(slope * photo + offset, 0, None if layer is expected[0] else photo)
        np.testing.assert_allclose(limited, layer, atol=1e-5)


@pytest.mark.parametrize("shape", [(12, 16, 3), (9, 30, 1), (2, 5, 3), (1, 1, 1)])
def test_the_means_of_a_film_are_those_of_a_photo(shape):
    image = np.random.default_rng(3).random(shape, np.float32)
    np.testing.assert_allclose(window_means(image), box_mean(image), atol=1e-6)


def test_what_the_layers_do_not_explain_is_the_film_in_every_frame(film, fitted):
    """As in the reference frame, where it is that of the single photo."""
    solution = fitted._solution
    errors = np.full_like(solution.frame_errors, 0.001)
    height, width = errors.shape
    errors[height // 3 : -height // 3, width // 3 : -width // 3] = 0.2
    doubted = replace(fitted, _solution=replace(solution, frame_errors=errors))
    motions = followed(fitted.model, film[0][:6])
    inside = slice(45, -45), slice(58, -58)
    for frame, motion in zip(film[0], motions, strict=False):
        clear, kept = (
            _FrameLayers(each, SIZE[::-1], 1.0).of(frame, motion) for each in (fitted, doubted)
        )
        assert np.abs(kept[0].astype(int) - frame)[inside].max() <= 2
        assert kept[1][inside].max() <= 2
        assert np.abs(clear[0].astype(int) - frame)[inside].mean() > 10
        np.testing.assert_array_equal(kept[0][:, :16], clear[0][:, :16])


def test_a_thing_in_one_frame_only_stays_as_it_is_and_the_rest_is_separated(film, fitted):
    frame = film[0][8].copy()
    motion = followed(fitted.model, film[0][:9])[8]
    layers = _FrameLayers(fitted, SIZE[::-1], 1.0)
    frame[30:66, 40:76] = (200, 30, 120)
    transmission, _ = layers.of(frame, motion)
    assert np.abs(transmission.astype(int) - frame)[38:58, 48:68].mean() < 3
    assert np.abs(transmission.astype(int) - frame)[:, 96:].mean() > 5


def test_a_film_that_becomes_three_times_as_bright_is_separated_in_every_frame(film, fitted):
    frames, truth = film
    motions = followed(fitted.model, frames)
    layers = _FrameLayers(fitted, SIZE[::-1], 1.0)
    gains = np.geomspace(0.4, 1.2, COUNT)
    for frame, true, motion, gain in zip(frames, truth, motions, gains, strict=True):
        brighter = np.rint(255 * to_encoded(gain * to_linear(frame / 255)).clip(0, 1))
        transmission, _ = layers.of(brighter.astype(np.uint8), motion)
        before, after = (
            psnr_db(to_linear(picture / 255), gain * true) for picture in (brighter, transmission)
        )
        assert after > before + 3


@pytest.mark.parametrize("at_once", [1, 2, 3])
def test_few_frames_are_computed_at_once_and_all_come_in_their_order(at_once, monkeypatch):
    running = set()
    counts = set()

    class Frames:
        def every_frame(self):
            for number in range(12):
                yield SimpleNamespace(stream=number, picture=partial(int, number))

    class Layers:
        def of(self, picture, motion):
            running.add(picture)
            counts.add(len(running))
            sleep(0.02 + 0.02 * (picture % 3))
            running.remove(picture)
            return [picture, motion]

    with ThreadPoolExecutor(5) as pool:
        monkeypatch.setitem(_separated.__globals__, "POOL", pool)
        monkeypatch.setitem(_separated.__globals__, "_AT_ONCE", at_once)
        made = list(_separated(Frames(), Layers(), range(100, 112)))
    assert made == [(number, [number, 100 + number]) for number in range(12)]
    assert max(counts) == at_once
