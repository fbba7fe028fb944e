"""Finding input images and writing results: names, trees, link loops, atomic writes."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brewster.base import files
from brewster.base.files import check_output_folder, images_in, write_atomically
from brewster.base.image_formats import SUFFIXES
from brewster.batch.layer_names import name_layers
from brewster.errors import OutputError
from brewster.options import Options


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    return folder


LAYERS = ("transmission", "reflection", "confidence")


def find(*sources, output=None, format_name=None):
    """Returns the names of the images, in their order, with the paths of their layers, relative to
    image or output.
    """
    images = (pair for source in sources for pair in images_in(source, output))
    found = {}
    for image, targets in name_layers(images, Options(LAYERS, format=format_name)):
        root = output or image.parent
        found[image.name] = {
            layer: os.path.relpath(target, root) for layer, target in targets.items()
        }
    return found


def transmissions(*sources, format_name=None):
    return {
        name: row["transmission"] for name, row in find(*sources, format_name=format_name).items()
    }


def test_layers_are_next_to_their_image_and_keep_its_suffix(tmp_path):
    path = touch(tmp_path, "view.jpg") / "view.jpg"
    assert find(path)["view.jpg"] == {
        "transmission": "view.transmission.jpg",
        "reflection": "view.reflection.jpg",
        "confidence": "view.confidence.png",
    }
    assert find(path, format_name="tiff")["view.jpg"]["reflection"] == "view.reflection.tiff"


@pytest.mark.parametrize(
    ("name", "suffix"), [("view.gif", "png"), ("view.ora", "png"), ("view.DNG", "tiff")]
)
def test_if_a_format_is_not_written_another_one_replaces_it(tmp_path, name, suffix):
    assert transmissions(touch(tmp_path, name) / name) == {name: f"view.transmission.{suffix}"}


BEGINNINGS = {
    ".jpg": b"\xff\xd8\xff\xe0",
    ".webp": b"RIFF\0\0\0\0WEBP",
    ".heic": b"\0\0\0\x18ftypmif1" + bytes(100) + b"hvcC",
    ".avif": b"\0\0\0\x18ftypmif1" + bytes(100),
    ".tiff": b"II*\0",
    ".dng": b"FUJIFILMCCD-RAW",
    ".gif": b"GIF89a",
    ".png": b"unknown",
}
"""The first bytes of files by suffix. Layers of a file that is no known image are named as those of
a PNG file.
"""


@pytest.mark.parametrize("suffix", BEGINNINGS)
@pytest.mark.parametrize("name", ["photo", "x.jpg_large", "a.b", "2026.11", ".jpg"])
@pytest.mark.parametrize("options", [Options(), Options(format="avif"), Options(additive=True)])
def test_without_an_image_suffix_the_format_of_the_content_names_the_layers(
    tmp_path, name, suffix, options
):
    """The layers are those of the same file with the suffix of its format."""
    for path in (tmp_path / name, tmp_path / f"{name}{suffix}"):
        path.write_bytes(BEGINNINGS[suffix])
        ((_, targets),) = name_layers([(path, tmp_path)], options)
        assert path.name.startswith(name)
        expected = options.suffix("transmission", suffix)
        assert targets["transmission"].name == f"{name}.transmission{expected}"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders")
def test_every_list_of_a_folder_has_regular_files_only_and_broken_links(tmp_path):
    touch(tmp_path, "a.jpg", "x/b.jpg")
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "device.jpg").symlink_to("/dev/zero")
    (tmp_path / "broken.jpg").symlink_to("nothing")
    (tmp_path / "link.jpg").symlink_to("a.jpg")
    regular = ["a.jpg", "broken.jpg", "link.jpg"]
    assert [path.name for path in files.folder_entries(tmp_path)] == [*regular, "x"]
    assert [path.name for path in files.walk(tmp_path, lambda _: True)] == [*regular, "b.jpg"]
    skipped: list[files.Location] = []
    assert [image.name for image, _ in images_in(tmp_path, skipped=skipped)] == [*regular, "b.jpg"]
    assert [path.name for path in skipped] == ["device.jpg", "pipe.jpg"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders")
def test_a_pipe_is_not_read_to_name_its_layers(tmp_path):
    os.mkfifo(tmp_path / "photo")  # reading a pipe without a writer would wait forever
    assert transmissions(tmp_path / "photo") == {"photo": "photo.transmission.png"}


def test_a_known_suffix_names_the_layers_whatever_the_content_and_a_photo_without_one_has_one_name(
    tmp_path,
):
    for name in ("photo", "photo.jpg", "a.tif"):
        (tmp_path / name).write_bytes(BEGINNINGS[".jpg"])
    assert transmissions(tmp_path / "photo.jpg", tmp_path / "photo", tmp_path / "a.tif") == {
        "photo.jpg": "photo.jpg.transmission.jpg",
        "photo": "photo.transmission.jpg",
        "a.tif": "a.transmission.tif",
    }


def test_a_folder_is_searched_in_order_and_its_tree_is_mirrored(tmp_path):
    touch(tmp_path / "in", "b.jpg", "a.PNG", "deep/er/c.webp", "notes.txt")
    found = find(tmp_path / "in", output=tmp_path / "out")
    assert list(found) == ["a.PNG", "b.jpg", "c.webp"]
    assert found["c.webp"]["transmission"] == "deep/er/c.transmission.webp"


def test_every_visible_file_of_a_folder_is_an_image_or_skipped(tmp_path):
    touch(
        tmp_path, "a.jpg", "b.mp4", "c.bmp", "d", ".e", "x/f.txt", ".y/g.txt", "a.transmission.jpg"
    )
    (tmp_path / "h.jp2").symlink_to("nothing")
    skipped: list[files.Location] = []
    images = [image.name for image, _ in images_in(tmp_path, skipped=skipped)]
    assert images == ["a.jpg"]
    assert [path.name for path in skipped] == ["b.mp4", "c.bmp", "d", "h.jp2", "f.txt"]


def test_masks_are_skipped_if_their_photo_is_in_the_same_folder(tmp_path):
    touch(
        tmp_path,
        "a.jpg",
        "a.mask.png",
        "b.mask.png",
        "x/a.mask.png",
        "x/c.mask.png",
        "x/c.tif",
        "mask.png",
    )
    touch(tmp_path, "d.mask.png", "d.transmission.jpg")  # the photo itself is in another folder
    found = [image.relative_to(tmp_path).as_posix() for image, _ in images_in(tmp_path)]
    assert found == ["a.jpg", "b.mask.png", "d.mask.png", "mask.png", "x/a.mask.png", "x/c.tif"]
    assert list(find(tmp_path / "a.mask.png")) == ["a.mask.png"]


def test_a_file_given_by_name_is_always_listed(tmp_path):
    file_names = ["a.transmission.jpg", ".hidden.jpg", "missing.jpg"]
    touch(tmp_path, *file_names[:2])
    assert list(find(*(tmp_path / name for name in file_names))) == file_names


@pytest.mark.parametrize("format_name", [None, "tiff", "png", "jpeg"])
def test_an_image_that_is_added_to_a_folder_does_not_change_the_layers_of_the_others(
    tmp_path, format_name
):
    before = find(touch(tmp_path, "a.jpg"), format_name=format_name)["a.jpg"]
    touch(
        tmp_path,
        "a.CR2",
        "a.dng",
        "a.jpg.png",
        "a.tif",
        "a.tiff",
        "a.png",
        "a.jpg.transmission.jpg",
    )
    for source in (tmp_path / "a.jpg", tmp_path):
        assert find(source, format_name=format_name)["a.jpg"] == before
    assert before["confidence"] == "a.confidence.png"


def test_images_of_one_stem_use_their_full_name_only_if_they_would_write_the_same_file(tmp_path):
    touch(tmp_path, "a.gif", "a.jpg", "a.png")
    names = {image: list(layers.values()) for image, layers in find(tmp_path).items()}
    assert names == {
        "a.gif": ["a.gif.transmission.png", "a.gif.reflection.png", "a.gif.confidence.png"],
        "a.jpg": ["a.transmission.jpg", "a.reflection.jpg", "a.confidence.png"],
        "a.png": ["a.transmission.png", "a.reflection.png", "a.png.confidence.png"],
    }
    assert transmissions(tmp_path / "a.gif") == {"a.gif": "a.transmission.png"}


def test_the_case_of_a_suffix_does_not_separate_two_files(tmp_path):
    touch(tmp_path, "a.JPG", "a.dng")
    assert transmissions(tmp_path, format_name="jpeg")["a.dng"] == "a.dng.transmission.jpg"
    assert transmissions(tmp_path / "a.JPG") == {"a.JPG": "a.transmission.JPG"}


STEMS = st.lists(st.sampled_from(["a", "b", "jpg", "png"]), min_size=1, max_size=3).map(".".join)
FILE_NAMES = st.tuples(STEMS, st.sampled_from([*sorted(SUFFIXES), "", ".jpg_large"])).map("".join)


@settings(max_examples=50, deadline=None, database=None)
@given(st.sets(FILE_NAMES, max_size=8), st.sampled_from([None, "png"]))
def test_no_two_images_of_a_folder_share_a_target(tmp_path_factory, files, format_name):
    folder = touch(tmp_path_factory.mktemp("images"), *files)
    found = find(*(folder / name for name in files), format_name=format_name)
    targets = {target for row in found.values() for target in row.values()}
    assert len(found) == len(files)
    assert len(targets) == len(LAYERS) * len(files)


def test_link_loops_end_and_linked_folders_are_searched_once(tmp_path):
    touch(tmp_path, "deep/a.jpg")
    (tmp_path / "deep" / "loop").symlink_to(tmp_path)
    (tmp_path / "self.jpg").symlink_to(tmp_path / "self.jpg")
    (tmp_path / "also").symlink_to(tmp_path / "deep")
    found = [image.relative_to(tmp_path).as_posix() for image, _ in images_in(tmp_path)]
    assert found == ["also/a.jpg", "self.jpg"]


def test_an_image_given_twice_is_listed_once(tmp_path):
    touch(tmp_path, "a.jpg")
    images = (pair for name in (".", "a.jpg", "./a.jpg") for pair in images_in(tmp_path / name))
    assert len(name_layers(images, Options())) == 1


def test_an_unreadable_folder_is_listed_so_that_opening_it_reports_the_error(tmp_path, monkeypatch):
    touch(tmp_path, "locked/a.jpg", "z.jpg")
    listing = Path.iterdir

    def iterdir(path):
        if path.name == "locked":
            raise PermissionError(errno.EACCES, "Permission denied")
        return listing(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert list(find(tmp_path)) == ["locked", "z.jpg"]


def test_a_file_that_appears_during_writing_is_not_replaced(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    fsync = os.fsync

    def write_other_file(descriptor):
        path.write_bytes(b"other")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", write_other_file)
    with pytest.raises(OutputError, match="exists"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"other"


@pytest.mark.parametrize(
    ("code", "word"),
    [(errno.ENOSPC, "free some space"), (errno.EROFS, "writable"), (errno.EIO, "was not written")],
)
def test_a_full_or_failing_disk_is_an_error_and_leaves_nothing(tmp_path, monkeypatch, code, word):
    def fail(descriptor):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OutputError, match=word):
        write_atomically(tmp_path / "a.png", b"layer")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_leaves_the_old_file_and_no_partial_one(tmp_path, monkeypatch):
    def interrupt(descriptor):
        raise KeyboardInterrupt

    (tmp_path / "a.png").write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "a.png", b"new", overwrite=True)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a.png", b"old")]


def test_a_read_only_target_is_kept_even_with_overwrite(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(b"old")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root ignores the permission bits
    with pytest.raises(OutputError, match="writable"):
        write_atomically(tmp_path / "a.png", b"new", overwrite=True)
    assert (tmp_path / "a.png").read_bytes() == b"old"


def test_files_are_written_on_file_systems_without_hard_links(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    write_atomically(tmp_path / "a.png", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    with pytest.raises(OutputError, match="overwrite"):
        write_atomically(tmp_path / "a.png", b"new")
    assert (tmp_path / "a.png").read_bytes() == b"whole"


def test_ctrl_c_just_after_the_rename_leaves_nothing_else(tmp_path, monkeypatch):
    """The interrupt comes before the hidden file is deleted, as on a machine with a high load."""
    discard = files.discard
    calls = []

    def interrupted(path):
        calls.append(path)
        if len(calls) == 1:
            raise KeyboardInterrupt
        discard(path)

    monkeypatch.setattr(files, "discard", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "a", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_the_check_of_an_output_folder_creates_nothing(tmp_path):
    touch(tmp_path, "file")
    (tmp_path / "link").symlink_to("nowhere")
    before = sorted(tmp_path.iterdir())
    for good in (".", "new", "new/below/it"):
        check_output_folder(tmp_path / good)
    reasons = {"file": "a file", "file/new": "a file", "link": "a file", "x" * 300: "shorter name"}
    for bad, reason in reasons.items():
        with pytest.raises(OutputError, match=rf"{bad} was not written \(.*; expected .*{reason}"):
            check_output_folder(tmp_path / bad)
    assert sorted(tmp_path.iterdir()) == before
