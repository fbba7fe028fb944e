"""Files in object stores. The store is fsspec's memory://, which behaves like S3 without a
network.
"""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from brewster import Photo
from brewster.base.files import write_atomically
from brewster.base.remote_path import RemotePath, check_readable, location
from brewster.batch import plan_files
from brewster.errors import BrewsterError, OutputError, UnreadablePhoto
from brewster.options import Options

pytestmark = pytest.mark.usefixtures("store")


def fail(*_, **__):
    raise OSError("503 Slow Down\nrequest 7")


def test_a_url_has_the_operations_of_a_path():
    path = RemotePath("s3://bucket/scans")
    photo = path / "box 4" / "a.jpg"
    assert str(photo) == "s3://bucket/scans/box 4/a.jpg"
    assert (photo.name, photo.stem, photo.suffix) == ("a.jpg", "a", ".jpg")
    assert photo.parent == RemotePath("s3://bucket/scans/box 4")
    assert photo.relative_to(path).parts == ("box 4", "a.jpg")
    assert pickle.loads(pickle.dumps(photo)) == photo
    assert not isinstance(photo, Path)


def test_a_location_is_a_path_or_a_url():
    assert location("scans/a.jpg") == Path("scans/a.jpg")
    assert location(Path("a")) == Path("a")
    assert location("file:///scans/box%204/a.jpg") == Path("/scans/box 4/a.jpg")
    assert location("file://localhost/scans/a.jpg") == Path("/scans/a.jpg")
    assert str(location("memory://bucket/a.jpg")) == "memory://bucket/a.jpg"


@pytest.mark.parametrize("url", ["https://example.org/a.jpg", "HTTP://example.org/a.jpg"])
def test_a_web_address_is_refused_with_what_to_do(url):
    for read in (location, Photo.open):
        with pytest.raises(BrewsterError, match=f"{url} is a web address"):
            read(url)


@pytest.mark.parametrize(
    "url", ["file://server/scans/a.jpg", "file://a.jpg", "file://localhosts/a.jpg"]
)
def test_a_file_of_another_machine_is_refused(url):
    host = url.split("/")[2]
    with pytest.raises(
        BrewsterError, match=f"is a file on the machine {host}; expected a file on this"
    ):
        location(url)


def test_a_photo_is_saved_to_the_url_of_an_object_store():
    photo = Photo.from_array(np.full((4, 5, 3), 90, np.uint8), encoding="srgb")
    photo.save("memory://saved/a.png")
    assert Photo.open("memory://saved/a.png").size == (5, 4)


def test_a_file_in_a_store_is_written_once():
    path = location("memory://bucket/a.jpg")
    write_atomically(path, b"first")
    with pytest.raises(OutputError, match=r"memory://bucket/a\.jpg was not written .*exists"):
        write_atomically(path, b"second")
    assert path.read_bytes() == b"first"
    write_atomically(path, b"second", overwrite=True)
    assert path.read_bytes() == b"second"


def test_photos_in_a_store_are_found_like_those_in_a_folder(tmp_path):
    names = "b/c.png a.jpg a.mask.png b/c.jpg .hidden/d.jpg a.transmission.jpg notes.txt b/d.mp4"
    root = location("memory://bucket/in")
    for name in names.split():
        (root / name).write_bytes(b"")
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    output = location("memory://out")

    def found(folder):
        skipped = []
        tasks = plan_files(folder, output, Options(layers=("reflection",)), skipped=skipped)
        assert [path.relative_to(folder).as_posix() for path in skipped] == ["b/d.mp4", "notes.txt"]
        return {
            task.source.relative_to(folder).as_posix(): str(task.outputs["reflection"])
            for task in tasks
        }

    assert found(root) == found(tmp_path)
    assert found(root)["b/c.png"] == "memory://out/b/c.reflection.png"
    assert sorted(found(root)) == ["a.jpg", "b/c.jpg", "b/c.png"]
    (single,) = plan_files(root / "a.jpg", tmp_path)
    assert single.outputs["transmission"] == tmp_path / "a.transmission.jpg"


def test_a_file_is_checked_without_reading_it(store, monkeypatch):
    folder = location("memory://bucket/in")
    (folder / "a.jpg").write_bytes(b"x")
    (folder / "empty.jpg").write_bytes(b"")
    monkeypatch.setattr(type(store), "cat_file", fail)
    check_readable(folder / "a.jpg")
    with pytest.raises(UnreadablePhoto, match="the file is empty; expected an image file"):
        check_readable(folder / "empty.jpg")
    with pytest.raises(UnreadablePhoto, match=r"in/b\.jpg cannot be read \(it does not exist\)"):
        check_readable(folder / "b.jpg")
    with pytest.raises(
        UnreadablePhoto, match=r"memory://bucket/in cannot be read \(it is a folder\)"
    ):
        check_readable(folder)
    monkeypatch.setattr(type(store), "info", fail)
    with pytest.raises(UnreadablePhoto, match=r"cannot be read \(503 Slow Down\)"):
        check_readable(folder / "a.jpg")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders")
def test_a_pipe_is_not_opened_to_check_it(tmp_path):
    os.mkfifo(tmp_path / "photo.jpg")  # opening a pipe without a writer would wait forever
    check_readable(tmp_path / "photo.jpg")
