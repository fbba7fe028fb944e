"""`brewster info`: what a photo or a video contains."""

import json
import re

import numpy as np
import pytest
from PIL import ImageCms

from brewster.errors import UnreadablePhoto
from brewster.film import read_video
from brewster.photo.contents import profile_name, read_contents
from motion_photos import (
    IDENTIFIER,
    apple_exif,
    google_xmp,
    heic,
    jpeg,
    live_photo_archive,
    small_film,
)
from picture_files import P3, dng_file, exif_block, exr_of, file_of, mosaic, png_with, smooth
from video_files import film_of, write_video


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return small_film(tmp_path_factory.mktemp("film") / "film.mp4")


def described(run, *paths):
    """Returns the exit code, and the lines of JSON of `brewster info`."""
    code, out, _ = run("info", "--json", *map(str, paths))
    return code, [json.loads(line) for line in out.splitlines()]


def test_info_prints_the_size_the_profile_and_the_metadata(run_without_model, tmp_path):
    (tmp_path / "a.jpg").write_bytes(
        file_of(smooth(48, 64), "JPEG", exif=exif_block(6), icc_profile=P3)
    )
    code, (row,) = described(run_without_model, tmp_path / "a.jpg")
    assert code == 0
    assert row["format"] == "jpeg"
    assert (row["width"], row["height"], row["bits"]) == (48, 64, 8)
    assert row["orientation"] == 6
    assert row["profile"] == ImageCms.getProfileDescription(profile_of(P3)).strip()
    assert row["metadata"] == ["EXIF"]
    assert row["bytes"] == (tmp_path / "a.jpg").stat().st_size
    assert row["films"] == []


def profile_of(icc):
    import io  # noqa: PLC0415

    return ImageCms.getOpenProfile(io.BytesIO(icc))


def test_info_prints_the_film_of_a_motion_photo(run_without_model, film, tmp_path):
    still = jpeg(google_xmp(len(film)))
    (tmp_path / "a.MP.jpg").write_bytes(still + film)
    _, (row,) = described(run_without_model, tmp_path / "a.MP.jpg")
    (found,) = row["films"]
    assert found["layout"] == "Google Motion Photo"
    assert (found["offset"], found["bytes"], found["frames"]) == (len(still), len(film), 6)
    assert found["still_time_s"] == pytest.approx(0.1)
    assert row["other_parts"] == []
    _, out, _ = run_without_model("info", str(tmp_path / "a.MP.jpg"))
    assert f"{len(film):,} bytes from byte {len(still):,}".encode() in out


def test_info_prints_a_live_photo_of_two_files_or_one(run_without_model, tmp_path):
    film = small_film(tmp_path / "a.mov", identifier=IDENTIFIER)
    still = heic(exif=apple_exif())
    (tmp_path / "a.heic").write_bytes(still)
    (tmp_path / "b.livp").write_bytes(live_photo_archive({"a.heic": still, "a.mov": film}))
    _, rows = described(run_without_model, tmp_path / "a.heic", tmp_path / "b.livp")
    assert [row["format"] for row in rows] == ["heic", "heic"]
    assert [row["films"][0]["layout"] for row in rows] == ["Apple Live Photo", "livp"]
    assert [row["films"][0]["bytes"] for row in rows] == [len(film)] * 2


@pytest.mark.parametrize("name", ["film.mp4", "film", "film.MP"])
def test_info_prints_the_frames_of_a_video(name, run_without_model, film, tmp_path):
    (tmp_path / name).write_bytes(film)
    _, (row,) = described(run_without_model, tmp_path / name)
    assert row["format"] == "video"
    assert row["films"][0]["frames"] == 6


@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
@pytest.mark.parametrize("options", [{}, {"movflags": "faststart"}], ids=["behind", "in front"])
def test_info_tells_what_a_film_that_was_cut_off_lacks(
    run_without_model, suffix, options, tmp_path
):
    picture = np.random.default_rng(0).integers(0, 256, (90, 120, 3), np.uint8)
    frames = film_of(picture, 20, step=1, size=(96, 64))
    whole = write_video(tmp_path / f"whole{suffix}", frames, container_options=options)
    data = whole.read_bytes()
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(data[: 6 * len(data) // 10])
    code, (first, second) = described(run_without_model, whole, cut)
    assert code == 0
    assert first["notes"] == []
    (note,) = second["notes"]
    assert "cut off" in note
    # The index of the frames is the only part that may be behind the pictures
    assert ("moov" in note) == (options == {})
    if options:
        assert len(read_video(cut, 3)) == 3
    else:
        with pytest.raises(UnreadablePhoto, match=re.escape(note)):
            read_video(cut, 3)


@pytest.mark.parametrize("size", [1, 7, 8, 11, 12, 40, 700])
def test_info_describes_the_first_bytes_of_a_film_without_a_traceback(
    run_without_model, film, size, tmp_path
):
    (tmp_path / "cut.mp4").write_bytes(film[:size])
    code, out, error = run_without_model("info", str(tmp_path / "cut.mp4"))
    if size < 12:  # the brand of the film is not complete
        assert code == 1
        assert error.startswith("error: ")
        assert "brewster burst" not in error
    else:
        assert code == 0
        assert b"no index of its frames" in out


FILES = {
    "png": png_with,
    "exr": lambda: exr_of({name: smooth()[..., 0].astype(np.float32) for name in "RGB"}),
    "dng": lambda: dng_file(mosaic()),
    "avif": lambda: file_of(smooth(), "AVIF"),
    "webp": lambda: file_of(smooth(), "WEBP"),
}


@pytest.mark.parametrize("suffix", FILES)
def test_info_reads_the_header_of_each_format(suffix, tmp_path):
    from brewster import Photo  # noqa: PLC0415

    path = tmp_path / f"a.{suffix}"
    path.write_bytes(FILES[suffix]())
    contents = read_contents(path)
    photo = Photo.open(path)
    assert contents.size == photo.size
    assert contents.bits == photo.file_info.bits
    assert contents.format_name == ("raw" if suffix == "dng" else suffix)
    assert contents.films == ()


def test_info_continues_after_a_file_that_cannot_be_read(run_without_model, tmp_path):
    (tmp_path / "a.jpg").write_bytes(jpeg())
    (tmp_path / "text.jpg").write_text("text")
    names = ("missing.jpg", "text.jpg", "a.jpg")
    code, rows = described(run_without_model, *(tmp_path / name for name in names), tmp_path)
    assert code == 1
    assert [row["path"] for row in rows] == [str(tmp_path / "a.jpg")]


@pytest.mark.parametrize("name", ["sRGB", "XYZ"])
def test_the_name_of_a_profile_is_its_description(name):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile(name))
    assert profile_name(profile.tobytes()) == ImageCms.getProfileDescription(profile).strip()


@pytest.mark.parametrize("size", [0, 100, 131, 140, 300])
def test_a_damaged_profile_has_no_name(size):
    assert isinstance(profile_name(P3[:size]), str)
