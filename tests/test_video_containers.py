"""Films as containers hold them: damaged packets, hidden borders, several streams, interlaced
fields, animations, and files without a suffix.
"""

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
