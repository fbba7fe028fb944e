"""The table of the training photos, and their download from a local server."""

import csv
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

from brewster import Photo
from brewster.cli import main
from brewster.errors import DownloadError, OutputError
from brewster.render.environments import training_photos
from brewster.render.environments.training_photos import COLUMNS, difference_hash, pull, read_table
from file_server import served

pytestmark = pytest.mark.loopback

ROOT = Path(__file__).parents[1]


@pytest.fixture
def origins(monkeypatch, tmp_path, rng):
    """A server with three originals, and a table with them and a photo without an origin."""
    rows = [["lost.jpg", 90, 60, "somewhere", "MIT", "", "", ""]]
    with served() as files:
        for name in ("one", "two", "a three"):
            blocks = rng.integers(0, 256, (8, 12, 3)).astype(np.uint8)
            photo = Photo.from_array(
                np.kron(blocks, np.ones((25, 25, 1), np.uint8)), encoding="srgb"
            )
            path = f"/me/photos/raw/0123456789ab/p/{name.replace(' ', '%20')}.png"
            files.bodies[path] = photo.encode("png")
            prepared = Photo.from_array(photo.resized(90, 60).clip(0, 1), encoding="linear")
            origin = f"me/photos@0123456789ab:p/{name}.png"
            rows.append([f"{name}.webp", 90, 60, "me/photos", "CC BY 2.0", f"Anna {name}", origin,
                         f"{difference_hash(prepared):016x}"])  # fmt: skip
        with (tmp_path / "table.csv").open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *rows])
        monkeypatch.setattr(training_photos, "TABLE", tmp_path / "table.csv")
        yield files


def test_photos_are_fetched_reduced_and_listed_with_their_authors(origins, tmp_path, capsys):
    out = tmp_path / "photos"
    assert main(["assets", "pull", "photos", str(out), "--server", origins.url]) == 0
    assert (
        "1 of the 4 photos are left out, because their origin is not known"
        in capsys.readouterr().err
    )
    for path, body in origins.bodies.items():
        made = Photo.open(out / f"{unquote(Path(path).stem)}.webp")
        original = Photo.open(body)
        assert made.size == (90, 60)
        assert (
            np.abs(made.linear() - original.resized(90, 60)).mean() < 0.07
        )  # other photos: about 0.3
    with (out / "manifest.csv").open(newline="") as file:
        authors = [row["attribution"] for row in csv.DictReader(file)]
    assert authors == ["Anna one", "Anna two", "Anna a three"]
    count = len(origins.requests)
    assert [result.status for result in pull(out, server=origins.url)] == ["skipped"] * 3
    assert len(origins.requests) == count


def test_another_photo_or_a_missing_one_is_reported_and_the_others_are_kept(
    origins, tmp_path, capsys
):
    first, second, _ = origins.bodies
    origins.bodies[first] = origins.bodies[second]
    del origins.bodies[second]
    out = tmp_path / "photos"
    assert main(["assets", "pull", "photos", str(out), "--server", origins.url, "--quiet"]) == 1
    err = capsys.readouterr().err
    assert "one.webp: me/photos@0123456789ab:p/one.png shows another photo" in err
    assert "two.webp" in err
    assert {file.name for file in out.iterdir()} == {"a three.webp", "manifest.csv"}


def test_a_deleted_repository_does_not_stop_the_others(origins, tmp_path):
    rows = list(csv.reader((tmp_path / "table.csv").read_text().splitlines()))
    gone = [
        [f"{k}.webp", *rows[2][1:6], f"me/gone@0123456789ab:{k}.png", rows[2][7]] for k in range(8)
    ]
    with (tmp_path / "table.csv").open("w", newline="") as file:
        csv.writer(file).writerows([rows[0], *gone, *rows[1:]])
    out = tmp_path / "photos"
    statuses = []
    with pytest.raises(DownloadError, match="5 downloads in a row failed"):
        statuses += (result.status for result in pull(out, server=origins.url))
    assert statuses.count("downloaded") == 3
    with (out / "manifest.csv").open(newline="") as file:
        assert [row["file"] for row in csv.DictReader(file)] == [
            "one.webp",
            "two.webp",
            "a three.webp",
        ]


def test_another_table_in_the_folder_is_kept(origins, tmp_path):
    (tmp_path / "manifest.csv").write_text("file,asset,category\n")
    with pytest.raises(OutputError, match=r"manifest\.csv is another table"):
        list(pull(tmp_path, server=origins.url))
    assert (tmp_path / "manifest.csv").read_text() == "file,asset,category\n"
    assert not origins.requests


def test_a_dry_run_requests_nothing_and_options_of_maps_are_refused(origins, tmp_path, capfd):
    out = tmp_path / "photos"
    assert main(["assets", "pull", "photos", str(out), "--server", origins.url, "--dry-run"]) == 0
    assert len(capfd.readouterr().out.splitlines()) == 3
    assert not origins.requests
    assert not out.exists()
    assert main(["assets", "pull", "photos", str(out), "--indoor", "3"]) == 2


def test_the_table_has_a_licence_for_each_photo_and_a_hash_for_each_origin():
    photos = read_table()
    assert (len(photos), len({photo.file for photo in photos})) == (2588, 2588)
    assert all(photo.licence and photo.source for photo in photos)
    with_origin = [photo for photo in photos if photo.origin]
    assert len(with_origin) == 1345
    for photo in photos:
        assert bool(re.fullmatch(r"[0-9a-f]{16}", photo.difference_hash)) == bool(photo.origin)
        assert not photo.origin or re.fullmatch(r"[\w.-]+/[\w.-]+@[0-9a-f]{12}:.+", photo.origin)
    assert (
        with_origin[0]
        .url()
        .startswith("https://github.com/18F/18f.gsa.gov/raw/0a55c75e6d9b/assets/")
    )


def test_the_hashes_are_those_of_the_prepared_photos(data):
    for photo in [photo for photo in read_table() if photo.origin][::300]:
        prepared = Photo.open(data / "photos" / "permissive" / photo.file)
        assert prepared.size == (int(photo.width), int(photo.height))
        assert difference_hash(prepared) == int(photo.difference_hash, 16)
