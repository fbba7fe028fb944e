"""Films as containers hold them: damaged packets, hidden borders, several streams, interlaced
fields, animations, and files without a suffix.
"""

import io
import shutil
import struct
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import partial

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from brewster.base import image_formats
from brewster.batch.plan import plan_bursts
from brewster.errors import PhotoTooLarge, UnreadablePhoto
from brewster.film import read_video
from brewster.film.video.container_crop import clean_aperture, pixel_crop
from brewster.film.video.decoding import decoded
from brewster.film.video.film import Film
from simulated_bursts import PICTURES
from video_files import (
    clean_aperture_box,
    copy_packets,
    film_of,
    turn_display_matrix,
    with_clean_aperture,
    write_video,
)


@pytest.fixture(scope="module")
def frames():
    picture = cv2.imread(str(PICTURES[0]))
    picture = cv2.resize(picture, (480, 360), interpolation=cv2.INTER_AREA)
    return film_of(picture, 30)


def pictures_of(path):
    return [frame.picture() for frame in decoded(path, 10**8, is_complete=True)]


# Packets


def test_one_damaged_packet_costs_one_frame(data):
    path = data / "field/film-one-damaged-packet.mp4"
    assert len(Film.read(path).times) == 29
    assert len(pictures_of(path)) == 29


@pytest.mark.parametrize(("codec", "name"), [
    ("libx264", "a.mp4"), ("libx264", "a.mkv"), ("mpeg4", "a.avi"), ("mjpeg", "a.mov"),
])  # fmt: skip
def test_the_frames_after_a_damaged_packet_are_used(tmp_path, frames, codec, name):
    # libx264 makes frames that are predicted from later ones
    pixel_format = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    whole = write_video(tmp_path / name, frames, codec=codec, pixel_format=pixel_format)
    damaged = copy_packets(
        whole,
        tmp_path / f"damaged-{name}",
        lambda index, content: bytes(len(content)) if index == 12 else content,
    )
    expected = [frame.time_s for frame in decoded(whole, 10**8)]
    times = [frame.time_s for frame in decoded(damaged, 10**8)]
    assert len(expected) == 30
    assert len(times) == 29
    assert set(times) < set(expected)
    assert times[-1] == expected[-1]


# Hidden borders


def bordered(path, frames, crop):
    """A grey film without loss, and the frames that it shows inside of a white border of `crop`
    pixels: left, top, right, bottom.
    """
    left, top, right, bottom = crop
    shown = [np.repeat(frame[..., 1:2], 3, axis=2) for frame in frames]
    stored = [
        cv2.copyMakeBorder(
            frame, top, bottom, left, right, cv2.BORDER_CONSTANT, value=(255, 255, 255)
        )
        for frame in shown
    ]
    return write_video(path, stored, codec="libx264", options={"qp": "0"}), shown


CROPS = [(16, 8, 16, 8), (2, 0, 30, 16), (0, 0, 0, 8), (7, 5, 9, 3)]


@pytest.mark.parametrize("crop", CROPS)
@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv"])
def test_the_border_that_players_hide_is_cut_off(tmp_path, frames, crop, suffix):
    path, shown = bordered(tmp_path / "a.mp4", frames[:3], crop)
    # Odd numbers are possible: the box has those of the luma
    with_clean_aperture(path, clean_aperture_box((240, 180), crop))
    if suffix != ".mp4":  # FFmpeg writes the border into the new container
        path = copy_packets(path, tmp_path / f"a{suffix}")
    film = Film.read(path)
    assert film.size == (180, 240)
    for picture, frame in zip(film.pictures([0, 2]), shown[::2], strict=True):
        assert np.abs(picture.astype(int) - frame).max() <= 3


def test_the_clean_aperture_from_the_field_is_applied(data):
    photo = read_video((data / "field/film-clap-clean-aperture.mp4").read_bytes(), 30)[0]
    same = read_video(data / "field/film-without-suffix", 30)[0]
    assert photo.size == same.size == (320, 240)
    assert np.abs(photo.pixels.astype(int) - same.pixels).mean() < 4


def test_a_turned_film_is_cut_before_it_is_turned(tmp_path, frames):
    crop = (16, 0, 0, 8)
    path, shown = bordered(tmp_path / "a.mp4", frames[:3], crop)
    with_clean_aperture(path, clean_aperture_box((240, 180), crop))
    turn_display_matrix(path, 1)
    film = Film.read(path)
    assert film.size == (240, 180)
    turned = [np.rot90(shown[0], k) for k in (1, 3)]
    errors = [np.abs(film.pictures([0])[0].astype(int) - frame).max() for frame in turned]
    assert min(errors) <= 3


@pytest.mark.parametrize("box", [
    clean_aperture_box((500, 180), (0, 0, 0, 0)),  # larger than the film
    clean_aperture_box((100, 90), (300, 0, 0, 0)),  # outside of it
    clean_aperture_box((-100, 90), (0, 0, 0, 0)),
    struct.pack(">I4s8i", 40, b"clap", 100, 0, 90, 1, 0, 1, 0, 1),
    struct.pack(">I4s4i", 24, b"clap", 100, 1, 90, 1),
])  # fmt: skip
def test_an_impossible_clean_aperture_is_ignored(tmp_path, frames, box):
    path = write_video(tmp_path / "a.mp4", frames[:3])
    with_clean_aperture(path, box)
    assert Film.read(path).size == (180, 240)


@given(
    content=st.binary(max_size=300), begin=st.sampled_from([b"", b"moov", b"\x18\x53\x80\x67\xff"])
)
def test_any_bytes_are_a_container_without_a_border(content, begin):
    length = (len(content) + 8).to_bytes(4, "big") if begin == b"moov" else b""
    file = io.BytesIO(length + begin + content)
    assert clean_aperture(file, 1, (64, 48)) is None
    assert pixel_crop(file, 0, (64, 48)) is None


# Streams


def write_streams(path, films, *, default):
    """Writes several films, each a list of frames, as streams of one file."""
    with av.open(str(path), "w") as container:
        streams = []
        for index, film in enumerate(films):
            stream = container.add_stream("mpeg4", rate=30)
            stream.height, stream.width = film[0].shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.bit_rate = 2_000_000
            stream.disposition = av.stream.Disposition.default if index in default else 0
            streams.append(stream)
        for stream, film in zip(streams, films, strict=True):
            for number, frame in enumerate(film):
                picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
                picture.pts = number
                picture.time_base = Fraction(1, 30)
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
    return path


def resized(frames, size):
    return [cv2.resize(frame, size) for frame in frames]


@pytest.mark.parametrize(("sizes", "default", "expected"), [
    ([(64, 48), (160, 120)], (1,), 1),
    ([(160, 120), (64, 48)], (1,), 1),
    ([(64, 48), (160, 120)], (), 1),
    ([(64, 48), (160, 120)], (0, 1), 1),
    ([(160, 120), (64, 48)], (0, 1), 0),
])  # fmt: skip
def test_the_default_stream_is_read_else_the_largest_one(
    tmp_path, frames, sizes, default, expected
):
    films = [resized(frames[:8], size) for size in sizes]
    # In mp4, one stream is always a default one
    for suffix in (".mp4", ".mkv") if default else (".mkv",):
        path = write_streams(tmp_path / f"a{suffix}", films, default=default)
        assert Film.read(path).size == sizes[expected][::-1]


def test_the_default_stream_from_the_field_is_read(data):
    assert Film.read(data / "field/film-two-video-streams.mp4").size == (240, 320)


@pytest.mark.parametrize("default", [(), (0, 1), (1,)])
def test_a_large_picture_next_to_a_film_is_no_film(tmp_path, frames, default):
    # As the motion photos of a Pixel have it
    films = [frames[:8], resized(frames[:1], (480, 360))]
    path = write_streams(tmp_path / "a.mp4", films, default=default)
    assert Film.read(path).size == (180, 240)


# Interlaced films


def comb(picture):
    """The share of the variation from line to line that two lines further is none."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(float)
    middle = grey[1:-1] - (grey[2:] + grey[:-2]) / 2
    return np.abs(middle).mean() / np.abs(grey[2:] - grey[:-2]).mean()


def interlaced(frames, *, top_first):
    """Weaves pairs of frames: each has the lines of two times."""
    pairs = zip(frames[::2], frames[1::2], strict=True)
    woven = []
    for first, second in pairs:
        frame = (second if top_first else first).copy()
        frame[::2] = (first if top_first else second)[::2]
        woven.append(frame)
    return woven


@pytest.mark.parametrize("top_first", [True, False])
def test_interlaced_films_are_deinterlaced(tmp_path, top_first):
    picture = cv2.resize(cv2.imread(str(PICTURES[0])), (480, 360), interpolation=cv2.INTER_AREA)
    frames = film_of(picture, 30, step=5)
    options = {"x264-params": f"{'tff' if top_first else 'bff'}=1", "crf": "10"}
    path = write_video(
        tmp_path / "a.mp4",
        interlaced(frames, top_first=top_first),
        codec="libx264",
        options=options,
    )
    pictures = pictures_of(path)
    assert len(pictures) == 15
    assert [frame.time_s for frame in decoded(path, 10**8)] == pytest.approx(
        [k / 30 for k in range(15)]
    )
    progressive = np.mean([comb(frame) for frame in frames[2:-2:2]])
    combed = np.mean([comb(frame) for frame in interlaced(frames, top_first=top_first)[1:-1]])
    found = np.mean([comb(picture) for picture in pictures[1:-1]])
    assert combed > 1.5 * progressive
    assert found < 1.1 * progressive
    # The frames show the time of their first field
    for picture, frame in zip(pictures[1:-1], frames[2:-2:2], strict=True):
        assert np.abs(picture.astype(int) - frame).mean() < 8


def test_the_interlaced_film_from_the_field_has_no_combs(data):
    combs = [comb(picture) for picture in pictures_of(data / "field/film-interlaced.mp4")]
    progressive = [comb(picture) for picture in pictures_of(data / "field/film-without-suffix")]
    assert len(combs) == 15
    assert np.mean(combs) < 1.1 * np.mean(progressive)


# Names and animations


@pytest.mark.parametrize("name", ["film-without-suffix", "film-mpegts.ts"])
def test_a_film_is_read_by_its_content(data, tmp_path, name):
    shutil.copy(data / "field" / name, tmp_path / "film")
    for source in (tmp_path / "film", (tmp_path / "film").read_bytes()):
        film = Film.read(source)
        assert (len(film.times), film.size) == (30, (240, 320))
        assert len(read_video(source, 5)) == 5


def animation(path, frames):
    """Writes frames with 10 per second, each for 100 ms."""
    if path.suffix == ".avif":
        write = partial(
            write_video,
            codec="libsvtav1",
            rate=10,
            options={"preset": "12", "svtav1-params": "lp=1"},
        )
        # As root, the encoder leaves its thread with a real-time priority; see the finding
        # av1_encoder_priority.
        with ThreadPoolExecutor(1) as encoding:
            return encoding.submit(write, path, frames).result()
    images = [Image.fromarray(frame) for frame in frames]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=100, lossless=True, loop=0
    )
    return path


@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.avif", "a.gif"])
def test_animations_are_films(tmp_path, frames, name):
    path = animation(tmp_path / name, frames[:6])
    for source in (path, path.read_bytes()):
        film = Film.read(source)
        assert film.size == (180, 240)
        assert film.times == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5], abs=0.01)
        errors = np.abs(film.pictures([3])[0].astype(int) - frames[3])
        assert errors.mean() < {"a.gif": 12, "a.avif": 6}.get(name, 0.5)
    assert image_formats.is_animation(path.read_bytes()[:65_536]) == (name != "a.gif")
    [task] = plan_bursts([path])
    assert task.burst.is_from_video


@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.avif"])
def test_single_pictures_are_no_films(tmp_path, frames, name):
    for index in (0, 1):
        Image.fromarray(frames[index]).save(tmp_path / f"{index}{name}")
    tasks = plan_bursts([tmp_path / f"{index}{name}" for index in (0, 1)])
    assert [task.burst.is_from_video for task in tasks] == [False]


@pytest.mark.parametrize(("name", "count"), [("animated.webp", 4), ("animated-apng.png", 3)])
def test_the_animations_from_the_field_are_films(data, name, count):
    film = Film.read(data / "field" / name)
    assert film.times == pytest.approx([index / 10 for index in range(count)])
    assert np.ptp(film.pictures([1])[0]) > 100


def test_a_damaged_animation_and_a_picture_are_refused(tmp_path, frames):
    path = animation(tmp_path / "a.webp", frames[:6])
    content = path.read_bytes()
    for bad in (content[:40], content[:12] + bytes(500)):
        with pytest.raises(UnreadablePhoto):
            Film.read(bad)
    with pytest.raises(PhotoTooLarge):
        Film.read(path, max_pixels=1000)
    Image.fromarray(frames[0]).save(tmp_path / "still.webp")
    with pytest.raises(UnreadablePhoto, match="1 frame can be decoded"):
        Film.read(tmp_path / "still.webp")


def test_transparent_parts_of_an_animation_are_black(tmp_path):
    images = []
    for index in range(3):
        image = np.full((24, 32, 4), 200, np.uint8)
        image[:, : 8 * (index + 1), 3] = 0
        image[:, 8 * (index + 1) :, 3] = 255
        images.append(Image.fromarray(image))
    images[0].save(
        tmp_path / "a.webp", save_all=True, append_images=images[1:], lossless=True, exact=True
    )
    picture = Film.read(tmp_path / "a.webp").pictures([1])[0]
    assert (picture[12, 2].tolist(), picture[12, -2].tolist()) == ([0] * 3, [200] * 3)
