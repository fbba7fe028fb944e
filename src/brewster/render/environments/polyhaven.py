"""Downloads CC0 environment maps from Poly Haven and verifies their MD5 sums.

Files are downloaded one at a time. The next call resumes a partial download (see
brewster.base.download).
"""

import csv
import io
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, final

from brewster.base.download import Downloader, RemoteFile, output_errors
from brewster.base.files import file_digest, write_atomically
from brewster.base.tables import csv_table
from brewster.errors import DownloadError, OutputError

SERVER = "https://api.polyhaven.com"
_COLUMNS = (
    "file",
    "asset",
    "category",
    "resolution",
    "md5",
    "authors",
    "licence",
)  # of manifest.csv
_SAFE_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,200}", re.ASCII)
_MAX_CONSECUTIVE_FAILURES = 5


@final
@dataclass(frozen=True)
class DownloadRequest:
    """Number of maps of each category, their resolution and format, and the server."""

    indoor: int = 140
    outdoor: int = 30
    resolution: str = "4k"
    format: str = "hdr"
    server: str = SERVER
    dry_run: bool = False


@final
@dataclass(frozen=True)
class DownloadResult:
    """The result for one asset. The status "missing" means that the asset has no file of the
    resolution and format.
    """

    asset: str
    category: str
    status: Literal["downloaded", "skipped", "planned", "missing", "failed"] = "missing"
    file: str | None = None
    url: str | None = None
    bytes: int | None = None
    md5: str | None = None
    error: str | None = None


def stop_after_failures(results: Iterable[DownloadResult]) -> Iterator[DownloadResult]:
    """Yields the results. Raises DownloadError after five failures in a row: the server or the
    connection fails.
    """
    failures = 0
    for result in results:
        yield result
        failures = failures + 1 if result.status == "failed" else 0
        if failures == _MAX_CONSECUTIVE_FAILURES:
            raise DownloadError(
                f"{failures} downloads in a row failed",
                "expected at least one successful download",
                "see their errors, and run again to resume the downloads",
            )


def pull(request: DownloadRequest, out: Path) -> Iterator[DownloadResult]:
    """Downloads maps into a folder, in the order of their ids, and lists them in its manifest.csv.
    Yields a result each.

    Existing maps are skipped. An asset without a suitable file is replaced by the next one, but not
    a failed download, so that the next call downloads the same maps. Raises DownloadError if the
    list of the server cannot be downloaded, or several assets in a row failed; OutputError if the
    folder cannot be written to, or has another manifest.csv.
    """
    read_manifest(out)  # refuses another table before any download
    yield from stop_after_failures(_download_assets(request, out))


def _download_assets(request: DownloadRequest, out: Path) -> Iterator[DownloadResult]:
    listed = sorted(_fetch_json(f"{request.server.rstrip('/')}/assets?type=hdris").items())
    for category, wanted in (("indoor", request.indoor), ("outdoor", request.outdoor)):
        assets = ((name, record) for name, record in listed if _category(record) == category)
        count = 0
        while count < wanted and (asset := next(assets, None)):
            result = _download_asset(DownloadResult(asset[0], category), asset[1], request, out)
            yield result
            count += result.status != "missing"


def _download_asset(
    result: DownloadResult, record: object, request: DownloadRequest, out: Path
) -> DownloadResult:
    try:
        name = f"{result.asset}_{request.resolution}.{request.format}"
        if not _SAFE_NAME.fullmatch(name):
            expected = "expected letters, digits, '_', '-' and '.' only"
            cure = "try another --server"
            raise DownloadError(f"{name!r} is not a safe file name", expected, cure)  # noqa: TRY301
        target = out / name
        remote = _find_remote_file(result.asset, request)
        if remote is None:
            return result
        url, size, _, md5 = remote
        result = replace(result, status="skipped", file=str(target), url=url, bytes=size, md5=md5)
        if not _is_downloaded(target, remote):
            if request.dry_run:
                return replace(result, status="planned")
            Downloader().fetch(remote, target)
            result = replace(result, status="downloaded")
    except DownloadError as error:
        return replace(result, status="failed", error=str(error))
    if not request.dry_run:
        names = _nested(record, "authors")
        authors = "; ".join(names)[:1000] if isinstance(names, dict) else ""
        row = (target.name, result.asset, result.category, request.resolution, md5, authors, "CC0")
        _add_to_manifest(out, dict(zip(_COLUMNS, row, strict=True)))
    return result


# --- the API of the server (api.polyhaven.com; swagger.yml in github.com/Poly-Haven/Public-API)


def _category(record: object) -> str | None:
    """Returns "indoor" (also for both categories), "outdoor" or None; later with `attributes` in
    the API.
    """
    categories = _nested(record, "categories")
    words = [*categories] if isinstance(categories, list) else []
    words.append(_nested(record, "attributes", "environment"))
    return next((category for category in ("indoor", "outdoor") if category in words), None)


def _find_remote_file(asset: str, request: DownloadRequest) -> RemoteFile | None:
    url = f"{request.server.rstrip('/')}/files/{asset}"
    match _nested(_fetch_json(url), "hdri", request.resolution, request.format):
        case None:
            return None
        case {"url": str(address), "size": int(size), "md5": str(md5)} if size > 0:
            return RemoteFile(address, size, "md5", md5.lower())
    happened = f"the response of {url} is incomplete"
    raise DownloadError(
        happened, "expected url, size and MD5 sum of a file", "try another --server"
    )


def _fetch_json(url: str) -> dict[str, object]:
    response = Downloader().read(url)
    try:
        value = json.loads(response)
    except (ValueError, RecursionError):
        value = response
    if isinstance(value, dict):
        return value
    raise DownloadError(
        f"the response of {url} is {value!r:.40}", "expected a JSON object", "check --server"
    )


def _nested(tree: object, *keys: str) -> object:
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _is_downloaded(target: Path, remote: RemoteFile) -> bool:
    with output_errors(target):
        exists = target.exists()
        if exists and file_digest(target, remote.algorithm) != remote.digest:
            expected = f"expected the MD5 sum {remote.digest}"
            cure = "move or delete it, and run again"
            raise DownloadError(
                f"{target} exists, but differs from the file on the server", expected, cure
            )
    return exists


def read_manifest(out: Path, columns: Sequence[str] = _COLUMNS) -> list[dict[str, str]]:
    """Returns the rows of the manifest whose files exist. Raises OutputError for other columns or
    an error.
    """
    path = out / "manifest.csv"
    with output_errors(path):
        text = path.read_text("utf-8", errors="replace") if path.exists() else ",".join(columns)
        rows = csv.DictReader(io.StringIO(text, newline=""))
        if tuple(rows.fieldnames or ()) != tuple(columns):
            expected = f"expected a table with the columns {','.join(columns)}"
            cure = "choose another folder"
            raise OutputError(f"{path} is another table", expected, cure)
        return [row for row in rows if (out / row["file"]).is_file()]


def _add_to_manifest(out: Path, row: dict[str, str]) -> None:
    """Adds a map to the manifest, or replaces its row. The file is replaced atomically: it is
    always complete.
    """
    rows = read_manifest(out)
    if row not in rows:
        rows = [other for other in rows if other["file"] != row["file"]]
        rows = sorted([*rows, row], key=lambda row: row["file"])
        table = csv_table([_COLUMNS, *([row[name] for name in _COLUMNS] for row in rows)])
        write_atomically(out / "manifest.csv", table.encode(errors="replace"), overwrite=True)
