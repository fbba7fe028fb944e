"""Files from a server on this machine, and all that can go wrong on the way; more of it stands in test_polyhaven."""

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from brewster.download import Downloader, RemoteFile, file_digest
from brewster.errors import DownloadError, TargetError
from file_server import loopback_only, served, unheard

BODY = hashlib.sha256(b"light").digest() * 10_000


@pytest.fixture(autouse=True)
def _network_off(monkeypatch):
    loopback_only(monkeypatch)


@pytest.fixture
def server():
    with served() as files:
        files.bodies["/map"] = BODY
        yield files


@pytest.fixture
def remote(server):
    return RemoteFile(f"{server.url}/map", len(BODY), "sha256", hashlib.sha256(BODY).hexdigest())


@pytest.fixture
def delays():
    return []


@pytest.fixture
def downloader(delays):
    return Downloader(sleep=delays.append)


@pytest.fixture
def target(tmp_path):
    return tmp_path / "new" / "map"


def test_a_file_comes_whole_and_alone(downloader, remote, target):
    downloader.fetch(remote, target)
    assert target.read_bytes() == BODY
    assert [path.name for path in target.parent.iterdir()] == ["map"]


@pytest.mark.parametrize("algorithm", ["md5", "sha256"])
def test_either_sum_can_be_promised(downloader, remote, target, algorithm):
    digest = hashlib.new(algorithm, BODY).hexdigest()
    downloader.fetch(remote._replace(algorithm=algorithm, digest=digest), target)
    assert file_digest(target, algorithm) == digest


def test_a_line_that_breaks_is_taken_up_where_it_was(server, downloader, remote, target, delays):
    server.faults = ["cut", 503, "cut"]
    downloader.fetch(remote, target)
    assert target.read_bytes() == BODY
    assert delays == [1, 2, 4]
    assert [start for _, start in server.asked] == [None, "bytes=160000-", "bytes=160000-", "bytes=240000-"]


def test_what_came_of_half_a_file_is_kept_for_the_next_call(server, remote, target):
    server.faults = ["cut"]
    with pytest.raises(DownloadError, match="ended after 160000 of 320000 bytes"):
        Downloader(retry_delays_s=()).fetch(remote, target)
    assert [path.name for path in target.parent.iterdir()] == ["map.part"]
    Downloader(retry_delays_s=()).fetch(remote, target)
    assert server.asked[-1] == ("/map", "bytes=160000-")


def test_a_file_that_is_another_is_dropped(server, downloader, remote, target):
    server.bodies["/map"] = BODY[::-1]
    with pytest.raises(DownloadError, match=r"SHA256 sum .* was promised; run again"):
        downloader.fetch(remote, target)
    assert list(target.parent.iterdir()) == []


def test_a_server_that_is_not_there_is_asked_five_times(downloader, delays):
    with pytest.raises(DownloadError, match=r"in 5 attempts .*refused.*check the connection"):
        downloader.read(unheard())
    assert delays == [1, 2, 4, 8]


def test_what_is_not_found_is_asked_for_once(server, downloader, delays):
    with pytest.raises(DownloadError, match="404"):
        downloader.read(f"{server.url}/none")
    assert delays == []
    assert downloader.read(f"{server.url}/map") == BODY


@pytest.mark.parametrize("url", ["file:///etc/hosts", "ftp://127.0.0.1/map", "map", "", "http://a b/"])
def test_only_the_web_is_opened(downloader, url, delays):
    with pytest.raises(DownloadError, match="https://; check the address"):
        downloader.read(url)
    assert delays == []


def test_a_folder_that_cannot_be_made_is_explained(downloader, remote, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(TargetError, match="a folder of yours"):
        downloader.fetch(remote, tmp_path / "file" / "map")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a disk that is always full")
def test_a_full_disk_is_explained(downloader, remote, tmp_path):
    (tmp_path / "map.part").symlink_to("/dev/full")
    with pytest.raises(TargetError, match=r"No space left .* free some space"):
        downloader.fetch(remote, tmp_path / "map")


def test_downloading_wakes_no_torch():
    code = "import brewster.download, sys; assert not {'torch', 'numpy', 'click'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
