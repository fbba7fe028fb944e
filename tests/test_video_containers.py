"""Films as containers hold them: damaged packets, hidden borders, several streams, interlaced
fields, animations, and files without a suffix.
"""

from fractions import Fraction

import av
import cv2
import pytest

from brewster.burst.video import Film
from brewster.burst.video_decoding import decoded
from simulated_bursts import PICTURES
from video_files import copy_packets, film_of, write_video


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
