"""The photographs on which the default model is trained: their licences and authors, and their
download.

    for result in pull(Path("photos")):
        print(result.status, result.file, result.url)

`training_photos.csv` has a row for each photo. The origin is a file of a public repository at a
fixed commit, or unknown. Training uses reduced copies, of at most 1,024 px. Their origins cannot be
verified by a digest, because only the copies were kept when the table was made. Instead, the table
has a difference hash of each copy, which also recognises an enlarged, reduced or recompressed
version.
"""

import csv
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

import numpy as np

from brewster.base.download import Downloader, output_errors
from brewster.base.files import write_atomically
from brewster.base.tables import csv_table
from brewster.errors import BrewsterError, DownloadError
from brewster.photo import Photo
from brewster.photo.srgb import REC709_LUMINANCE
from brewster.render.environments.polyhaven import (
    DownloadResult,
    read_manifest,
    stop_after_failures,
)

TABLE: Final = Path(__file__).with_name("training_photos.csv")
SERVER: Final = "https://github.com"
MAX_DIFFERENT_BITS: Final = 10
"""Of 64. Other sizes and compressions change a few bits; the hashes of different photos differ in
about 32.
"""


class TrainingPhoto(NamedTuple):
    """A row of the table. The origin is REPOSITORY@COMMIT:PATH, or empty if it is unknown."""

    file: str
    width: str
    height: str
    source: str
    licence: str
    attribution: str
    origin: str
    difference_hash: str

    def url(self, server: str = SERVER) -> str:
        """The URL of the original file. GitHub accepts abbreviated commits in this form."""
        commit, _, path = self.origin.partition(":")
        repository, _, commit = commit.partition("@")
        return f"{server.rstrip('/')}/{repository}/raw/{commit}/{quote(path)}"


COLUMNS: Final = TrainingPhoto._fields


def read_table() -> list[TrainingPhoto]:
    """Returns the rows of all training photos."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        return [TrainingPhoto(**row) for row in csv.DictReader(file)]


def pull(out: Path, *, server: str = SERVER, dry_run: bool = False) -> Iterator[DownloadResult]:
    """Downloads the photos with a known origin, reduces them to their size in training, and lists
    them in manifest.csv.

    Existing photos are skipped. Yields a result for each photo with an origin. Raises DownloadError
    if several photos in a row failed; OutputError if the folder cannot be written to, or has
    another manifest.csv.
    """
    read_manifest(out, COLUMNS)  # refuses another table before any download
    downloader = None if dry_run else Downloader()
    photos = [photo for photo in read_table() if photo.origin]
    by_repository = defaultdict[str, list[TrainingPhoto]](list)
    for photo in photos:
        by_repository[photo.origin.partition("@")[0]].append(photo)
    # One photo of each repository after the other: a deleted repository must not look like a broken
    # connection.
    order = [photo for row in zip_longest(*by_repository.values()) for photo in row if photo]
    try:
        yield from stop_after_failures(
            _pull_photo(photo, out, server, downloader) for photo in order
        )
    finally:
        present = [photo for photo in photos if (out / photo.file).exists()]
        if present and not dry_run:
            with output_errors(out / "manifest.csv"):
                table = csv_table([COLUMNS, *present])
                write_atomically(out / "manifest.csv", table.encode(), overwrite=True)


def _pull_photo(
    photo: TrainingPhoto, out: Path, server: str, downloader: Downloader | None
) -> DownloadResult:
    """Downloads a photo; without a downloader, only plans it."""
    target = out / photo.file
    result = DownloadResult(
        photo.file, photo.source, "skipped", file=str(target), url=photo.url(server)
    )
    if target.exists():
        return result
    if downloader is None:
        return replace(result, status="planned")
    try:
        data = downloader.read(photo.url(server))
        prepared = _prepared(photo, data)
    except BrewsterError as error:
        return replace(result, status="failed", error=str(error))
    with output_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, prepared, overwrite=False)
    return replace(result, status="downloaded", bytes=len(data))


def _prepared(photo: TrainingPhoto, data: bytes) -> bytes:
    """Returns the file of the reduced photo. Raises BrewsterError for no image, or another
    photo.
    """
    linear = Photo.open(data).resized(int(photo.width), int(photo.height))
    reduced = Photo.from_array(np.clip(linear, 0, 1), encoding="linear")
    different_bits = (difference_hash(reduced) ^ int(photo.difference_hash, 16)).bit_count()
    if different_bits > MAX_DIFFERENT_BITS:
        raise DownloadError(
            f"{photo.origin} shows another photo ({different_bits} of 64 bits of its difference "
            "hash differ)",
            f"expected at most {MAX_DIFFERENT_BITS} bits",
            "leave it out",
        )
    return reduced.encode(Path(photo.file).suffix[1:], depth=8, quality=92)


def difference_hash(photo: Photo) -> int:
    """Returns 64 bits: whether each of 8 x 8 areas is darker than its right neighbour."""
    luminance = photo.resized(9, 8) @ np.asarray(REC709_LUMINANCE, np.float32)
    bits = luminance[:, 1:] > luminance[:, :-1]
    return int.from_bytes(np.packbits(bits).tobytes(), "big")
