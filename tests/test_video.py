"""Videos of a window: colours, orientation, damaged and unusual files, and the choice of the
frames.
"""

import gc
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from brewster.errors import PhotoTooLarge, UnreadablePhoto
from brewster.film import read_video
from brewster.film.video.choosing import best_part, choose, measure_film
from brewster.film.video.colour import to_picture
from brewster.film.video.decoding import decoded
from brewster.film.video.film import Film
from simulated_bursts import PICTURES
from video_files import film_of, turn_display_matrix, write_audio, write_video

PATCHES = ((200, 30, 30), (30, 180, 40), (40, 60, 200), (128, 128, 128))


@pytest.fixture(scope="module")
def pictures():
    return [
        cv2.resize(cv2.imread(str(path)), (480, 360), interpolation=cv2.INTER_AREA)
        for path in PICTURES[:3]
    ]


def ycbcr_frame(code, kr, kb, matrix, *, is_full=False, size=(64, 64)):
    """A uniform 10-bit frame with the R'G'B' values `code`, 0 to 1."""
    red, green, blue = code
    luma = kr * red + (1 - kr - kb) * green + kb * blue
    chroma = ((blue - luma) / 2 / (1 - kb), (red - luma) / 2 / (1 - kr))
    scales = (0, 1023, 1023) if is_full else (64, 876, 896)
    values = [scales[0] + scales[1] * luma, *(512 + scales[2] * c for c in chroma)]
    width, height = size
    planes = np.repeat(np.rint(values), [width * height, width * height // 4, width * height // 4])
    planes = planes.astype(np.uint16).reshape(height * 3 // 2, width)
    frame = av.VideoFrame.from_ndarray(planes, format="yuv420p10le")
    frame.colorspace = matrix
    frame.color_range = 2 if is_full else 1
    return frame


BT601 = (0.299, 0.114)
BT709 = (0.2126, 0.0722)
BT2020 = (0.2627, 0.0593)


def corner_patches(picture):
    return [picture[y, x].astype(int) for y, x in ((30, 30), (30, -30), (-30, 30), (-30, -30))]


@pytest.mark.parametrize(("name", "size", "order"), [
    ("hlg-10bit", (400, 300), (0, 1, 2, 3)),
    ("mirrored-display-matrix", (400, 300), (1, 0, 3, 2)),
    ("pixel-aspect-2-1", (800, 300), (0, 1, 2, 3)),
])  # fmt: skip
def test_the_videos_from_the_field_have_the_right_colours_and_sizes(data, name, size, order):
    photo = read_video(data / f"field/{name}.mp4", 3)[0]
    assert (photo.size, photo.pixels.dtype) == (size, np.uint8)
    assert (photo.file_info.note == "the HDR video (HLG) was converted to SDR") == (
        name == "hlg-10bit"
    )
    np.testing.assert_allclose(corner_patches(photo.pixels), [PATCHES[i] for i in order], atol=4)


@pytest.mark.parametrize(("transfer", "code"), [(18, 0.75), (16, 0.5806)])
def test_the_reference_white_of_hdr_is_nearly_white_and_brighter_light_is_not_clipped(
    transfer, code
):
    levels = [
        to_picture(ycbcr_frame((value,) * 3, *BT2020, 9), 1, transfer, 9)[0, 0].tolist()
        for value in (0, code, code + 0.1, 1)
    ]
    assert all(len(set(level)) == 1 for level in levels)
    black, white, brighter, peak = (level[0] for level in levels)
    assert (black, 240 <= white < brighter <= peak <= 255) == (0, True)


def test_hlg_and_pq_of_the_same_light_look_the_same():
    # A grey of 50 cd/m2, by the formulas of BT.2100 and a display of 1000 cd/m2
    scene = (50 / 1000) ** (1 / 1.2)
    hlg = (
        np.sqrt(3 * scene)
        if scene <= 1 / 12
        else 0.17883277 * np.log(12 * scene - 0.28466892) + 0.55991073
    )
    power = (50 / 10_000) ** (2610 / 16384)
    pq = ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    for code, transfer in ((hlg, 18), (pq, 16)):
        level = to_picture(ycbcr_frame((code,) * 3, *BT2020, 9), 1, transfer, 9)[0, 0]
        np.testing.assert_allclose(level, 255 * (50 / 203) ** (1 / 2.4), atol=1)


@pytest.mark.parametrize("is_full", [False, True])
@pytest.mark.parametrize(("weights", "matrix", "size"), [
    (BT709, 1, (64, 64)),
    (BT601, 6, (1280, 720)),
    (BT601, 2, (64, 64)),  # untagged
    (BT709, 2, (1280, 720)),
    (BT2020, 9, (64, 64)),
])  # fmt: skip
def test_the_matrix_and_the_range_of_a_video_are_honoured(weights, matrix, size, is_full):
    code = np.array(PATCHES[0]) / 255
    frame = ycbcr_frame(code, *weights, matrix, is_full=is_full, size=size)
    np.testing.assert_allclose(to_picture(frame, 1, 1, 1)[5, 5], PATCHES[0], atol=2)


def test_display_p3_is_converted_to_srgb():
    # Display P3 (0.8, 0.4, 0.3) in sRGB, from the matrices of SMPTE EG 432-1 and IEC 61966-2-1
    frame = ycbcr_frame((0.8, 0.4, 0.3), *BT709, 1)
    np.testing.assert_allclose(to_picture(frame, 1, 13, 12)[5, 5], (217, 97, 69), atol=3)


def test_pixels_become_square(tmp_path, pictures):
    for aspect, size in ((Fraction(4, 3), (320, 180)), (Fraction(1, 2), (240, 360))):
        write_video(tmp_path / "a.mp4", film_of(pictures[0], 3), aspect=aspect)
        assert read_video(tmp_path / "a.mp4", 2)[0].size == size
    with pytest.raises(PhotoTooLarge, match="240 x 360"):
        read_video(tmp_path / "a.mp4", 2, max_pixels=240 * 200)


def test_slow_motion_and_long_videos_are_read_to_the_20th_second_with_30_frames_each(
    tmp_path, pictures
):
    frame = film_of(pictures[0], 1, (64, 48))
    write_video(tmp_path / "slow.mp4", frame * 480, rate=240)
    assert len(list(decoded(tmp_path / "slow.mp4", 10**6))) == pytest.approx(60, abs=2)
    # One frame in a second, for a minute; the second one is a part of a longer film
    for first in (0, 15):
        times = range(30 * first, 30 * (first + 60), 30)
        write_video(tmp_path / "long.mkv", frame * 60, times=times)
        found = [film_frame.time_s for film_frame in decoded(tmp_path / "long.mkv", 10**6)]
        assert found == pytest.approx(range(first, first + 21), abs=1e-3)


def test_every_frame_of_slow_motion_is_passed_on_and_the_same_frames_are_measured(
    tmp_path, pictures
):
    frames = film_of(pictures[0], 48)
    write_video(tmp_path / "slow.mp4", frames, rate=120)
    times = []
    film = Film.read(tmp_path / "slow.mp4", on_frame=lambda frame: times.append(frame.time_s))
    assert times == pytest.approx(np.arange(48) / 120, abs=1e-3)
    alone = Film.read(tmp_path / "slow.mp4")
    assert 10 < len(film.times) < 16
    assert film.times == alone.times
    assert np.array_equal(film.measurements.positions, alone.measurements.positions)
    assert [frame.time_s for frame in film.every_frame()] == times


def test_frames_are_freed_while_the_next_ones_are_decoded(tmp_path, pictures):
    write_video(tmp_path / "a.mp4", film_of(pictures[0], 40))
    turn_display_matrix(tmp_path / "a.mp4", 1)
    gc.collect()
    gc.disable()
    try:
        for frame in decoded(tmp_path / "a.mp4", 10**6):
            assert frame.picture().shape == (240, 180, 3)
            # A decoder gives several at once
            assert sum(type(thing) is av.VideoFrame for thing in gc.get_objects()) < 10
    finally:
        gc.enable()


def test_a_video_with_a_variable_rate_and_odd_sizes_is_read(tmp_path, pictures):
    frames = film_of(pictures[0], 12, (241, 179))
    times = [0, 1, 2, 9, 10, 11, 30, 31, 32, 33, 90, 91]
    write_video(tmp_path / "a.mkv", frames, codec="ffv1", times=times, pixel_format="bgr0")
    photos = read_video(tmp_path / "a.mkv", 5)
    assert [photo.size for photo in photos] == [(241, 179)] * 5
    assert any(np.array_equal(photos[0].pixels, frame) for frame in frames)  # full range, no matrix


def test_a_video_that_ends_in_the_middle_of_a_frame_is_used_up_to_there(tmp_path, pictures):
    write_video(tmp_path / "a.mpg", film_of(pictures[0], 20), codec="mpeg2video")
    content = (tmp_path / "a.mpg").read_bytes()
    (tmp_path / "a.mpg").write_bytes(content[: len(content) // 2])
    assert len(read_video(tmp_path / "a.mpg", 4)) == 4


@pytest.mark.parametrize("has_cover", [False, True])
def test_an_audio_file_is_refused_also_with_a_cover_picture(tmp_path, pictures, has_cover):
    path = tmp_path / ("a.flac" if has_cover else "a.wav")
    write_audio(path, pictures[0] if has_cover else None)
    with pytest.raises(UnreadablePhoto, match="it has no video stream"):
        read_video(path, 5)


@pytest.mark.parametrize("content", [bytes(100_000), b"no video\n" * 1000])
def test_zeros_and_text_are_refused(tmp_path, content):
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(UnreadablePhoto, match="cannot be read as a video"):
        read_video(tmp_path / "a.mp4", 5)


def test_an_unknown_codec_and_a_video_of_one_frame_are_refused(tmp_path, pictures):
    path = write_video(
        tmp_path / "a.mkv", film_of(pictures[0], 3), codec="ffv1", pixel_format="bgr0"
    )
    path.write_bytes(path.read_bytes().replace(b"V_FFV1", b"V_XXX1").replace(b"FFV1", b"XXX1"))
    with pytest.raises(UnreadablePhoto, match="its codec is unknown"):
        read_video(path, 5)
    write_video(tmp_path / "a.mp4", film_of(pictures[0], 1))
    with pytest.raises(UnreadablePhoto, match="1 frame can be decoded"):
        read_video(tmp_path / "a.mp4", 5)


def test_an_animated_gif_and_a_video_with_alpha_are_read(tmp_path, pictures):
    frames = film_of(pictures[0], 6)
    write_video(tmp_path / "a.gif", frames, codec="gif", rate=10, pixel_format="rgb8")
    assert [photo.size for photo in read_video(tmp_path / "a.gif", 5)] == [(240, 180)] * 5
    write_video(tmp_path / "a.mov", frames, codec="png", pixel_format="rgba")
    assert np.array_equal(read_video(tmp_path / "a.mov", 6)[0].pixels, frames[0])


def test_only_frames_of_the_first_size_are_used(tmp_path, pictures):
    films = [film_of(pictures[0], 8, size) for size in ((240, 180), (160, 96))]
    files = [
        write_video(tmp_path / f"{len(film[0])}.mpg", film, codec="mpeg2video") for film in films
    ]
    (tmp_path / "a.mpg").write_bytes(b"".join(file.read_bytes() for file in files))
    assert {photo.size for photo in read_video(tmp_path / "a.mpg", 15)} == {(240, 180)}


def test_a_film_that_stands_still_gives_equal_frames(tmp_path, pictures):
    write_video(tmp_path / "a.mp4", film_of(pictures[0], 1) * 20)
    assert len(read_video(tmp_path / "a.mp4", 5)) == 5


def grey(frames):
    return [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in frames]


def moved_texture(size, path):
    """Grey pictures (h, w) of a texture that moves along `path`, places (x, y) in whole pixels."""
    rng = np.random.default_rng(0)
    texture = sum(cv2.resize(rng.normal(0, 12, (800 >> k, 800 >> k)), (800, 800)) for k in range(6))
    texture = np.clip(texture + 128, 0, 255).astype(np.uint8)
    width, height = size
    return [texture[100 - y : 100 - y + height, 100 - x : 100 - x + width] for x, y in path]


# Of 240 pixels, as thumbnails have: films of phones, 16:9, 4:3, 3:2, 1:1, 18:9, 19.5:9, 20:9, 21:9
# and 17:9, and upright; films for the cinema; sizes of which one or both are odd
PHONE_SIZES = [
    *((240, height) for height in (135, 180, 160, 240, 120, 111, 108, 103, 127, 100, 130, 75)),
    *((240, height) for height in (427, 320, 360, 480, 520, 533, 560, 453)),
    (135, 240),
    (135, 75),
    (225, 135),
]


@pytest.mark.parametrize("size", PHONE_SIZES)
def test_the_path_of_the_camera_is_the_motion_of_the_texture_at_all_sizes(size):
    still = measure_film(moved_texture(size, [(3, 2)] * 5))
    np.testing.assert_allclose(still.positions, 0, atol=1e-6)
    np.testing.assert_allclose(still.zoom, 0, atol=1e-6)
    np.testing.assert_allclose(still.difference, 0, atol=1e-3)
    for step in ((0, 4), (0, -4), (4, 0), (-4, 0), (3, -3), (-3, 3)):
        path = [(step[0] * i, step[1] * i) for i in range(5)]
        film = measure_film(moved_texture(size, path))
        expected = np.hypot(*step) * np.arange(5) / size[0]
        np.testing.assert_allclose(film.positions, expected, atol=0.3 / size[0])
        assert film.difference.max() < 12


def with_noise(picture, count):
    """Thumbnails of `count` frames of one view, with the noise of a camera."""
    rng = np.random.default_rng(1)
    return [
        np.clip(picture + rng.normal(0, 1, picture.shape), 0, 255).astype(np.uint8)
        for _ in range(count)
    ]


def test_a_film_from_a_tripod_has_no_path():
    film = measure_film(with_noise(moved_texture((240, 135), [(0, 0)])[0], 60))
    assert film.positions[-1] < 0.01
    assert np.abs(film.zoom).max() < 0.001


def test_frames_are_chosen_where_the_camera_moves():
    # 16:9, with 20 still frames before the motion and after it
    moving = moved_texture((240, 135), [(i, 0) for i in range(21)])
    film = measure_film([*with_noise(moving[0], 20), *moving, *with_noise(moving[-1], 20)])
    chosen = choose(film, 7)
    # The first and the last place of the path are still ones
    assert all(20 <= i <= 40 for i in chosen[1:-1])


def test_the_longest_scene_is_chosen_and_a_covered_lens_is_left_out(pictures):
    hand = list(
        np.random.default_rng(0).normal(20, 1, (10, 180, 240, 3)).clip(0, 255).astype(np.uint8)
    )
    first = film_of(pictures[0], 15)
    second = film_of(pictures[1], 40)
    film = measure_film(grey([*hand, *first, *second]))
    assert best_part(film, 5) == slice(25, 65)
    assert min(choose(film, 5)) >= 25
    assert best_part(measure_film(grey([*hand, *second])), 5) == slice(10, 50)
    assert best_part(measure_film(grey([*hand[:4], *first[:4]])), 7) == slice(
        0, 8
    )  # too short: all frames


def test_the_dark_frames_of_a_fade_are_left_out(pictures):
    frames = film_of(pictures[0], 40)
    frames[:10] = [(0.02 * frame).astype(np.uint8) for frame in frames[:10]]
    assert best_part(measure_film(grey(frames)), 5) == slice(10, 40)
    assert best_part(measure_film(grey(frames[::-1])), 5) == slice(0, 30)


def test_what_comes_before_a_cut_does_not_change_the_choice(pictures):
    # The frames of the second scene cover more than is used of a path
    before = film_of(pictures[0], 25, step=6)
    scene = film_of(pictures[1], 60, step=3)
    alone = choose(measure_film(grey(scene)), 7)
    assert max(alone) - min(alone) > 20
    assert choose(measure_film(grey([*before, *scene])), 7) == [25 + i for i in alone]


def test_a_strong_reflection_that_moves_otherwise_does_not_cut_the_film(pictures):
    frames = []
    for angle in np.linspace(0, 2 * np.pi, 60):
        x, y = 20 * np.cos(angle), 20 * np.sin(angle)
        layers = (
            cv2.warpAffine(picture, np.float32([[1, 0, -60 + dx], [0, 1, -60 + dy]]), (240, 180))
            for picture, dx, dy in ((pictures[0], x, y), (pictures[2], -1.5 * x, -1.5 * y))
        )
        frames.append(cv2.addWeighted(next(layers), 0.5, next(layers), 0.5, 0))
    assert best_part(measure_film(grey(frames)), 7) == slice(0, 60)


def zoomed(frame, factor):
    matrix = cv2.getRotationMatrix2D((120, 90), 0, factor)
    return cv2.warpAffine(frame, matrix, (240, 180), borderMode=cv2.BORDER_REFLECT)


def test_frames_during_a_zoom_are_left_out(pictures):
    frames = film_of(pictures[0], 80)
    factors = [1.0] * 20 + [1.015**i for i in range(1, 21)] + [1.015**20] * 40
    film = measure_film(grey(map(zoomed, frames, factors)))
    assert min(choose(film, 5)) >= 37


@pytest.mark.parametrize("visible", [range(20, 40, 3), range(28, 31)])
def test_frames_without_a_passing_person_are_preferred(pictures, visible):
    frames = film_of(pictures[0], 60)
    for number in visible:
        left = 10 * (number - 20)
        cv2.rectangle(frames[number], (left, 40), (left + 60, 180), (20, 200, 230), -1)
    chosen = choose(measure_film(grey(frames)), 7)
    assert len(chosen) == 7
    assert not set(chosen) & set(visible)


@pytest.mark.parametrize("count", [5, 7])
def test_a_video_with_few_frames_is_returned_whole(data, count):
    for path in sorted((data / "bursts").glob("*/*.mp4")):
        assert len(read_video(path, count)) == 5


@pytest.fixture
def decoded_frames(monkeypatch):
    """The indices of all frames that are decoded, in order."""
    indices = []

    def counting(*arguments, **options):
        for index, frame in enumerate(decoded(*arguments, **options)):
            indices.append(index)
            yield frame

    monkeypatch.setattr("brewster.film.video.film.decoded", counting)
    return indices


def test_the_frames_of_a_short_film_are_decoded_once(tmp_path, pictures, decoded_frames):
    frames = film_of(pictures[0], 40)
    write_video(tmp_path / "a.mkv", frames, codec="ffv1", pixel_format="bgr0")
    content = (tmp_path / "a.mkv").read_bytes()
    assert len(read_video(content, 5)) == 5
    assert decoded_frames == list(range(40))
    film = Film.read(content)
    assert film.size == (180, 240)
    assert film.times == pytest.approx([i / 30 for i in range(40)], abs=1e-3)
    for picture, index in zip(film.pictures([30, 3, 3]), [30, 3, 3], strict=True):
        assert np.array_equal(picture, frames[index])
    assert film.pictures([7], 120)[0].shape == (90, 120, 3)
    assert len(decoded_frames) == 80


@pytest.mark.parametrize(("rate", "size"), [(8, (240, 180)), (30, (1040, 60))])
def test_a_long_or_large_film_is_decoded_again_up_to_the_last_chosen_frame(
    tmp_path, pictures, decoded_frames, rate, size
):
    frames = [cv2.resize(frame, size) for frame in film_of(pictures[0], 40)]
    write_video(tmp_path / "a.mkv", frames, codec="ffv1", rate=rate, pixel_format="bgr0")
    film = Film.read(tmp_path / "a.mkv")
    chosen = film.pictures([4, 20])
    assert np.array_equal(chosen, [frames[4], frames[20]])
    assert decoded_frames == [*range(40), *range(21)]


def test_the_first_seconds_of_a_film_are_read(tmp_path, pictures):
    write_video(tmp_path / "a.mp4", film_of(pictures[0], 1, (64, 48)) * 60)
    assert len(Film.read(tmp_path / "a.mp4", seconds=1).times) == 31


@pytest.mark.parametrize("field", [
    "hlg-10bit", "mirrored-display-matrix", "pixel-aspect-2-1",
])  # fmt: skip
@pytest.mark.parametrize("is_large", [False, True])
def test_kept_frames_have_the_colours_and_the_orientation_of_the_film(
    data, field, is_large, monkeypatch
):
    whole = Film.read(data / f"field/{field}.mp4").pictures([2])[0]
    if is_large:  # for the limit, so that the kept frames are reduced
        monkeypatch.setattr("brewster.film.video.film.WORKING_PX", max(whole.shape) // 2)
    film = Film.read(data / f"field/{field}.mp4")
    assert film.size == whole.shape[:2]
    assert np.array_equal(film.pictures([2])[0], whole)
    small = film.pictures([2], max(whole.shape) // 2)[0]
    assert small.shape == (whole.shape[0] // 2, whole.shape[1] // 2, 3)
    enlarged = cv2.resize(small, whole.shape[1::-1])
    np.testing.assert_allclose(corner_patches(enlarged), corner_patches(whole), atol=4)


def test_kept_frames_with_untagged_colours_are_converted_as_the_film(tmp_path, pictures):
    # HD is BT.709, and stays so when it is reduced; limited and full range
    frames = [cv2.resize(pictures[0], (1280, 720))] * 3
    for pixel_format in ("yuv420p", "yuvj420p"):
        codec = "mjpeg" if pixel_format == "yuvj420p" else "libx264"
        write_video(tmp_path / "a.mov", frames, codec=codec, pixel_format=pixel_format)
        film = Film.read(tmp_path / "a.mov")
        whole = cv2.resize(film.pictures([1])[0], (640, 360), interpolation=cv2.INTER_AREA)
        small = film.pictures([1], 640)[0]
        assert np.abs(whole.astype(int) - small).mean() < 1


@pytest.mark.parametrize("seconds", [1, 6])
def test_all_pictures_are_those_that_are_read_together(tmp_path, pictures, seconds):
    frames = film_of(pictures[0], 10, (320, 240))
    write_video(tmp_path / "a.mp4", frames, rate=10 // seconds or 1)
    film = Film.read(tmp_path / "a.mp4")
    every = film.all_pictures(160)
    assert len(every) == len(film.times)
    together = film.pictures(range(len(film.times)), 160)
    assert max(every[3].shape) == 160
    for one, other in zip(every, together, strict=True):  # reduced before and after the conversion
        assert np.abs(one.astype(int) - other).mean() < 2
    assert np.array_equal(every[1:3][1], every[2])
