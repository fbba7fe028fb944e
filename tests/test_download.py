"""Downloads from a server on this machine, and their errors. test_polyhaven.py has more tests."""

import hashlib

import pytest

from brewster.base.download import Downloader, RemoteFile
from brewster.base.files import file_digest
from brewster.errors import DownloadError
from file_server import served, unused_address

pytestmark = pytest.mark.loopback

BODY = hashlib.sha256(b"light").digest() * 10_000


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


@pytest.mark.parametrize("algorithm", ["md5", "sha256"])
def test_md5_and_sha256_digests_are_supported(downloader, remote, target, algorithm):
    digest = hashlib.new(algorithm, BODY).hexdigest()
    downloader.fetch(remote._replace(algorithm=algorithm, digest=digest), target)
    assert (target.read_bytes(), file_digest(target, algorithm)) == (BODY, digest)
    assert [path.name for path in target.parent.iterdir()] == ["map"]


def test_a_lost_connection_is_resumed(server, downloader, remote, target, delays):
    server.faults = {"/map": ["cut", 503, "cut"]}
    downloader.fetch(remote, target)
    assert target.read_bytes() == BODY
    assert delays == [1, 2, 4]
    starts = [start for _, start in server.requests]
    assert starts == [None, "bytes=160000-", "bytes=160000-", "bytes=240000-"]


def test_a_partial_download_is_kept_for_the_next_call(server, remote, target):
    server.faults = {"/map": ["cut"]}
    with pytest.raises(DownloadError, match="ended after 160000 of 320000 bytes"):
        Downloader(retry_delays_s=()).fetch(remote, target)
    assert [path.name for path in target.parent.iterdir()] == ["map.part"]
    Downloader(retry_delays_s=()).fetch(remote, target)
    assert server.requests[-1] == ("/map", "bytes=160000-")


def test_a_file_with_a_wrong_digest_is_deleted(server, downloader, remote, target):
    server.bodies["/map"] = BODY[::-1]
    with pytest.raises(DownloadError, match=r"sha256 digest .* expected the digest .*; run again"):
        downloader.fetch(remote, target)
    assert list(target.parent.iterdir()) == []


def test_a_stated_wait_lengthens_the_back_off_and_never_shortens_it(server, downloader, delays):
    server.faults = {"/map": [429] * 4}  # each states 7 seconds
    assert downloader.read(f"{server.url}/map") == BODY
    assert delays == [7, 7, 7, 8]


def test_an_unreachable_server_is_tried_five_times(downloader, delays):
    with pytest.raises(DownloadError, match=r"in 5 attempts .*refused.*check the connection"):
        downloader.read(unused_address())
    assert delays == [1, 2, 4, 8]


def test_a_missing_file_is_requested_once(server, downloader, delays):
    with pytest.raises(DownloadError, match="404"):
        downloader.read(f"{server.url}/none")
    assert delays == []
    assert downloader.read(f"{server.url}/map") == BODY


@pytest.mark.parametrize(
    "url", ["file:///etc/hosts", "ftp://127.0.0.1/map", "map", "", "http://a b/"]
)
def test_only_http_urls_are_opened(downloader, url, delays):
    with pytest.raises(DownloadError, match="https://; check the URL"):
        downloader.read(url)
    assert delays == []
