"""A file is a video by its content, whatever its name."""

import numpy as np
import pytest

from brewster import Photo
from brewster.base.image_formats import FORMATS, format_of_content, is_video_content
from brewster.base.remote_path import is_video_file
from brewster.errors import UnsupportedPhoto
from motion_photos import heic, jpeg
from picture_files import exr_of, file_of, smooth, tiff_with
from video_files import write_audio, write_video

VIDEOS = {
    "mp4": "mpeg4",
    "mov": "mpeg4",
    "3gp": "mpeg4",
    "mkv": "mpeg4",
    "webm": "libvpx",
    "avi": "mpeg4",
    "ts": "mpeg2video",
    "m2ts": "mpeg2video",
    "mpg": "mpeg2video",
    "flv": "flv",
    "wmv": "wmv2",
    "ogv": "libvpx",
}
"""The codec of a film for each suffix by which FFmpeg chooses a container."""


@pytest.fixture(scope="module", params=VIDEOS)
def video(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / f"film.{request.param}"
    frames = [np.roll(smooth(), step, axis=1) for step in range(30)]
    options = {"pixel_format": "yuv420p", "rate": 25}
    return write_video(path, frames, codec=VIDEOS[request.param], **options)


def test_each_container_is_a_video_by_its_content(video, tmp_path):
    assert is_video_content(video.read_bytes())
    for name in ("film", "film.MP", "GX010001.LRV", "VID.insv", "film.MV"):
        path = tmp_path / name
        path.write_bytes(video.read_bytes())
        assert is_video_file(path)
        with pytest.raises(UnsupportedPhoto):
            Photo.open(path)


STILLS = {
    "jpeg": jpeg,
    "heic": heic,
    "avif": lambda: file_of(smooth(), "AVIF"),
    "png": lambda: file_of(smooth(), "PNG"),
    "webp": lambda: file_of(smooth(), "WEBP"),
    "gif": lambda: file_of(smooth()[..., 0], "GIF"),
    "tiff": lambda: tiff_with(smooth()),
    "exr": lambda: exr_of({name: smooth()[..., 0].astype(np.float32) for name in "RGB"}),
}


@pytest.mark.parametrize("name", STILLS)
def test_a_still_is_no_video(name, tmp_path):
    data = STILLS[name]()
    assert format_of_content(data) == FORMATS[name]
    assert not is_video_content(data)
    (tmp_path / "still").write_bytes(data)
    assert not is_video_file(tmp_path / "still")


@pytest.mark.parametrize("brand", [b"crx ", b"mif1", b"heic", b"avis", b"jp2 ", b"M4A "])
def test_files_of_boxes_with_images_or_sound_are_no_videos(brand):
    assert not is_video_content(b"\0\0\0\x18ftyp" + brand + bytes(600))


@pytest.mark.parametrize("brand", [b"isom", b"mp41", b"avc1", b"qt  ", b"3gp4", b"new9"])
def test_files_of_boxes_with_other_brands_are_videos(brand):
    assert is_video_content(b"\0\0\0\x18ftyp" + brand + bytes(600))


@pytest.mark.parametrize("data", [b"", b"G" * 100, b"OggS" + bytes(30) + b"vorbis", b"{}" * 500])
def test_other_bytes_are_no_videos(data):
    assert not is_video_content(data)


def test_sound_is_no_video(tmp_path):
    assert not is_video_content(write_audio_file(tmp_path / "sound.flac"))


def write_audio_file(path):
    write_audio(path)
    return path.read_bytes()


def test_a_file_that_cannot_be_read_is_no_video(tmp_path):
    assert not is_video_file(tmp_path / "missing")
    assert not is_video_file(tmp_path)
