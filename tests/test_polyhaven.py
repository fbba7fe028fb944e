"""Downloads of maps from a fake Poly Haven server on this machine, with faults of server,
connection and disk.
"""

import csv
import hashlib
import json
from functools import partial

import pytest

from brewster.base.download import Downloader
from brewster.errors import DownloadError, OutputError
from brewster.render.environments import polyhaven
from brewster.render.environments.polyhaven import DownloadRequest, pull
from cli_helpers import error_lines, list_files
from file_server import FileHandler, Files, on_loopback

pytestmark = pytest.mark.loopback

INDOOR = {"categories": ["indoor", "urban"]}
OUTDOOR = {"categories": ["outdoor", "night"]}
BOTH = {"categories": ["outdoor", "indoor"]}
BY_ATTRIBUTE = {"attributes": {"environment": "outdoor"}}
SIZE = 100_000


@pytest.fixture(autouse=True)
def retry_delays(monkeypatch):
    """The delays before retries in seconds. They are recorded, and the test does not wait."""
    delays = []
    monkeypatch.setattr(polyhaven, "Downloader", partial(Downloader, sleep=delays.append))
    return delays


class FakePolyHaven(Files):
    """The content of the server: assets by id, each at `/file/ID`."""

    def __init__(self, url):
        super().__init__(url)
        self.assets = {"b_hall": INDOOR, "a_room": INDOOR, "street": OUTDOOR, "atrium": BOTH}
        self.assets |= {"sky": BY_ATTRIBUTE, "desk": {}}
        self.resolutions = dict.fromkeys(self.assets, "4k")

    @staticmethod
    def content(name):
        return (hashlib.sha256(name.encode()).digest() * SIZE)[:SIZE]

    def description(self, name):
        content = self.content(name)
        sums = {"size": SIZE, "md5": hashlib.md5(content).hexdigest()}
        file = {"url": f"{self.url}/file/{name}"} | sums
        return {"hdri": {self.resolutions.get(name, "4k"): {"hdr": file}}}

    def body(self, path):
        kind, _, name = path[1:].partition("/")
        if kind == "assets":
            authors = {"authors": {'Ann, "A."': "All", "Bo": "Sky"}}
            return json.dumps(
                {asset: authors | record for asset, record in self.assets.items()}
            ).encode()
        if name not in self.assets:
            return None
        return self.content(name) if kind == "file" else json.dumps(self.description(name)).encode()

    def ranges(self, name):
        return [byte_range for path, byte_range in self.requests if path == f"/file/{name}"]


@pytest.fixture
def haven():
    with on_loopback(FileHandler, FakePolyHaven) as haven:
        yield haven
        haven.stop.set()


@pytest.fixture
def fetch(haven, tmp_path):
    """Downloads into a folder. Returns the result for each asset."""

    def fetch(indoor=1, outdoor=0, **options):
        request = DownloadRequest(
            indoor=indoor, outdoor=outdoor, **({"server": haven.url} | options)
        )
        return list(pull(request, tmp_path / "maps"))

    return fetch


@pytest.fixture
def maps(tmp_path):
    return tmp_path / "maps"


def statuses(results):
    return [(result.asset, result.status) for result in results]


def manifest(maps):
    return list(csv.DictReader((maps / "manifest.csv").read_text().splitlines()))


def test_maps_are_downloaded_in_the_order_of_their_ids_and_indoor_maps_first(fetch, maps):
    found = fetch(indoor=2, outdoor=9)
    categories = {"a_room": "indoor", "atrium": "indoor", "sky": "outdoor", "street": "outdoor"}
    expected = [(*row, "downloaded") for row in categories.items()]
    assert [(result.asset, result.category, result.status) for result in found] == expected
    assert (maps / "a_room_4k.hdr").read_bytes() == FakePolyHaven.content("a_room")


def test_the_manifest_has_a_row_for_each_map_with_authors_and_licence(fetch, maps):
    fetch(indoor=1, outdoor=1)
    old = (maps / "manifest.csv").read_text()
    (maps / "manifest.csv").write_text(
        old.replace("Ann", "Zoe").replace("CC0", "CC0,noted by hand")
    )
    fetch(indoor=2, outdoor=1)
    rows = manifest(maps)
    assert [row["file"] for row in rows] == ["a_room_4k.hdr", "atrium_4k.hdr", "sky_4k.hdr"]
    md5 = hashlib.md5(FakePolyHaven.content("sky")).hexdigest()
    row = ("sky_4k.hdr", "sky", "outdoor", "4k", md5, 'Ann, "A."; Bo', "CC0")
    assert tuple(rows[2].values()) == row
    (maps / "sky_4k.hdr").unlink()
    fetch(indoor=3)
    assert [row["asset"] for row in manifest(maps)] == ["a_room", "atrium", "b_hall"]


def test_an_asset_without_the_resolution_is_reported_and_replaced_by_the_next(haven, fetch):
    haven.resolutions["a_room"] = "2k"
    assert statuses(fetch(indoor=1)) == [("a_room", "missing"), ("atrium", "downloaded")]
    missing = [(name, "missing") for name in ("a_room", "atrium", "b_hall")]
    assert statuses(fetch(indoor=1, format="exr")) == missing


def test_finished_maps_are_skipped_and_other_files_are_not_replaced(haven, fetch, maps):
    fetch()
    assert statuses(fetch()) == [("a_room", "skipped")]
    assert len(haven.ranges("a_room")) == 1
    other_file = b"own!" * (SIZE // 4)
    (maps / "a_room_4k.hdr").write_bytes(other_file)
    [result] = fetch()
    assert result.status == "failed"
    assert "move or delete it" in result.error
    assert (maps / "a_room_4k.hdr").read_bytes() == other_file


def test_an_id_cannot_write_outside_the_folder(haven, fetch, tmp_path):
    haven.assets = dict.fromkeys(("../../escaped", "/etc/passwd", "..", "a\\b", "a_room"), INDOOR)
    found = fetch(indoor=9)
    assert [result.status for result in found] == ["failed"] * 4 + ["downloaded"]
    assert list_files(tmp_path) == ["maps/a_room_4k.hdr", "maps/manifest.csv"]
    assert {path for path, *_ in haven.requests} == {"/assets", "/files/a_room", "/file/a_room"}


@pytest.mark.parametrize(("faults", "ranges"), [
    (["cut", "no range"], [None, "bytes=50000-"]),
    ([FakePolyHaven.content("a_room") + b"and more"], [None]),
])  # fmt: skip
def test_a_server_that_ignores_the_range_or_sends_too_much_is_handled(
    haven, fetch, maps, faults, ranges
):
    haven.faults["/file/a_room"] = faults
    assert statuses(fetch()) == [("a_room", "downloaded")]
    assert haven.ranges("a_room") == ranges
    assert (maps / "a_room_4k.hdr").read_bytes() == FakePolyHaven.content("a_room")


@pytest.mark.parametrize(("size", "ranges"), [(SIZE, []), (SIZE + 1, [None])])
def test_a_complete_part_is_not_downloaded_but_one_that_is_too_long(
    haven, fetch, maps, size, ranges
):
    maps.mkdir()
    (maps / "a_room_4k.hdr.part").write_bytes((FakePolyHaven.content("a_room") + b"?")[:size])
    assert statuses(fetch()) == [("a_room", "downloaded")]
    assert haven.ranges("a_room") == ranges


def test_bytes_received_before_a_timeout_are_kept(haven, fetch, monkeypatch):
    monkeypatch.setattr(polyhaven, "Downloader", partial(polyhaven.Downloader, timeout_s=0.2))
    haven.faults["/file/a_room"] = ["stall"]
    assert statuses(fetch()) == [("a_room", "downloaded")]
    assert haven.ranges("a_room") == [None, "bytes=50000-"]


@pytest.mark.parametrize("wrong", [b"x" * SIZE, b"x" * SIZE * 2])
def test_a_map_with_a_wrong_sum_is_deleted_and_reported_and_others_are_kept(
    haven, fetch, maps, wrong
):
    haven.faults["/file/a_room"] = [wrong]
    found = fetch(indoor=2)
    assert statuses(found) == [("a_room", "failed"), ("atrium", "downloaded")]
    assert "md5" in found[0].error
    assert list_files(maps) == ["atrium_4k.hdr", "manifest.csv"]


def test_a_retry_waits_as_long_as_a_busy_server_requests(haven, fetch, retry_delays):
    haven.faults = {"/assets": [429], "/file/a_room": [503, 500, 429]}
    assert statuses(fetch()) == [("a_room", "downloaded")]
    assert retry_delays == [7, 1, 2, 7]


def test_after_five_failures_in_a_row_no_further_map_is_requested(haven, tmp_path):
    haven.assets = {f"room_{i}": INDOOR for i in range(9)}
    haven.faults = {f"/file/room_{i}": [404] for i in range(9)}
    with pytest.raises(DownloadError, match="5 downloads in a row"):
        list(pull(DownloadRequest(server=haven.url), tmp_path))
    assert haven.ranges("room_4")
    assert not haven.ranges("room_5")
    haven.faults = {f"/file/room_{i}": [404] for i in (0, 1, 2, 3, 5, 6, 7, 8)}
    assert len(list(pull(DownloadRequest(server=haven.url), tmp_path))) == 9


@pytest.mark.parametrize("body", [b"<html>", b"", b"\xff", b"[" * 100_000, b"[]", b"null"])
def test_a_response_that_is_no_json_object_is_reported(haven, fetch, body):
    haven.faults["/files/a_room"] = [body]
    found = fetch(indoor=2)
    assert statuses(found) == [("a_room", "failed"), ("atrium", "downloaded")]
    assert "the response of http://" in found[0].error
    haven.faults["/assets"] = [body]
    with pytest.raises(DownloadError, match="the response of http://"):
        fetch()


def test_json_that_was_cut_is_requested_again(haven, fetch, monkeypatch):
    haven.assets |= {f"z{i}": {"tags": ["x" * 1000]} for i in range(99)}
    haven.faults["/assets"] = ["cut"]
    assert statuses(fetch()) == [("a_room", "downloaded")]


@pytest.mark.parametrize("wrong", [{"md5": None}, {"size": "big"}, {"size": 0}, {"url": 3}])
def test_a_description_without_url_size_or_sum_is_refused(haven, fetch, wrong):
    description = haven.description("a_room")
    description["hdri"]["4k"]["hdr"] |= wrong
    haven.faults["/files/a_room"] = [json.dumps(description).encode()]
    assert "is incomplete" in fetch()[0].error


@pytest.mark.parametrize("tree", [[], "map", {"hdri": []}, {"hdri": {"4k": "x"}}, {"hdri": None}])
def test_a_list_of_files_may_have_any_shape(haven, fetch, tree):
    haven.faults["/files/a_room"] = [json.dumps(tree).encode()]
    assert fetch()[0].status in ("missing", "failed")


def test_redirections_are_followed_to_http_urls_only(haven, fetch):
    haven.faults["/file/a_room"] = [f"{haven.url}/file/a_room"]
    haven.faults["/file/atrium"] = ["ftp://127.0.0.1/file/atrium"]
    haven.faults["/file/b_hall"] = ["file:///etc/hosts"]
    assert [result.status for result in fetch(indoor=3)] == ["downloaded", "failed", "failed"]


def test_a_manifest_of_another_program_is_refused_before_any_download(haven, fetch, maps):
    maps.mkdir()
    (maps / "manifest.csv").write_bytes(b"name,price\n\xff,1\n")
    with pytest.raises(OutputError, match="is another table"):
        fetch()
    assert haven.requests == []


@pytest.fixture
def command(run_without_model, haven):
    return lambda *args: run_without_model(
        "assets", "pull", "polyhaven", "--server", haven.url, *args
    )


def test_the_command_prints_results_and_how_many_maps_are_missing(command, tmp_path):
    code, out, err = command("maps", "--indoor", 2, "--outdoor", 5)
    assert (code, out) == (0, b"")
    assert "2 of 5 outdoor maps" in err
    assert "Poly Haven" in err  # the attribution that its terms ask for
    assert len(list_files(tmp_path / "maps")) == 5


def test_failed_maps_are_listed_at_the_end_and_the_exit_code_is_1(command, haven):
    haven.faults["/file/a_room"] = [b"wrong"] * 5
    code, out, err = command("maps", "--indoor", 2, "--outdoor", 0, "--quiet")
    assert (code, out) == (1, b"")
    assert [line.split(": ")[1] for line in error_lines(err)] == ["a_room"]
    assert error_lines(err) == err.splitlines()


def test_a_dry_run_prints_what_would_be_downloaded_and_writes_nothing(command, haven, tmp_path):
    code, out, _ = command("maps", "--dry-run", "--indoor", 1, "--outdoor", 0)
    assert (code, out.decode()) == (0, f"{haven.url}/file/a_room -> maps/a_room_4k.hdr\n")
    assert list_files(tmp_path) == []


def test_maps_go_to_the_cache_folder_by_default(command, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert command("--indoor", 1, "--outdoor", 0)[0] == 0
    assert "a_room_4k.hdr" in list_files(tmp_path / "cache" / "brewster" / "maps")
