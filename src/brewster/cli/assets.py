"""`brewster assets`: download data that brewster does not include: environment maps, and
photographs for training.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from brewster.base.files import cache_folder
from brewster.cli.parameters import FILE, QUIET, Number, flag, json_lines
from brewster.cli.terminal import one_line, print_error, print_status, progress, write_out

if TYPE_CHECKING:
    from brewster.render.environments.polyhaven import DownloadResult

_STATUS_LINES: Final = {
    "missing": "{0.asset}: left out, because the server has no file in this resolution and format",
    "skipped": "{0.file}: skipped, because it exists",
    "downloaded": "{0.asset} -> {0.file} ({1:.1f} MB)",
}
"""The line about a result and its size in MB, by its status."""


@click.group
def assets() -> None:
    """Download data that brewster does not include."""


@assets.command
@click.argument("source", type=click.Choice(["polyhaven", "photos"]))
@click.argument("out", required=False, type=FILE)
@click.option("--indoor", type=Number(0), default=140, help="The number of indoor maps.")
@click.option("--outdoor", type=Number(0), default=30, help="The number of outdoor maps.")
@click.option(
    "--resolution",
    type=click.Choice(["1k", "2k", "4k", "8k", "16k"]),
    default="4k",
    help="The width of the maps, in units of 1024 pixels.",
)
@click.option(
    "--format",
    type=click.Choice(["hdr", "exr"]),
    default="hdr",
    help="The file format of the maps; exr files need the extra exr.",
)
@click.option(
    "--server",
    metavar="URL",
    help="The server: a mirror of https://api.polyhaven.com with the same API, or of "
    "https://github.com.",
)
@json_lines("file")
@QUIET
@flag("--dry-run", help="Print the planned downloads, and write nothing.")
@click.pass_context
def pull(
    context: click.Context,
    /,
    *,
    source: str,
    out: Path | None,
    server: str | None,
    as_json: bool,
    quiet: bool,
    dry_run: bool,
    **options: Any,  # noqa: ANN401  (the fields of DownloadRequest)
) -> None:
    """Download data into the folder OUT: environment maps, or photographs for training.

    polyhaven: CC0 environment maps (360-degree HDR images) from Poly Haven, in the order of their
    ids. OUT is brewster/maps in the user's cache folder by default. manifest.csv lists the maps,
    their authors and their MD5 checksums. Interrupted downloads are resumed.

    photos: the photographs on which the default model is trained, from public repositories, reduced
    to at most 1,024 pixels. OUT is brewster/photos in the cache folder by default. manifest.csv
    lists their licences and authors. The origin of half of the photographs is not known, and these
    are left out.

    Existing files are skipped. If a download fails, the other files are still downloaded, the
    failed file is listed at the end, and the exit code is 1.
    """
    if source == "photos":
        for name in options:
            if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
                raise click.UsageError(f"--{name} is for maps; photos have none.")
        from brewster.render.environments import training_photos  # noqa: PLC0415  (imports pyvips)

        table = training_photos.read_table()
        known = sum(bool(photo.origin) for photo in table)
        folder = out or cache_folder() / "photos"
        fetched = training_photos.pull(
            folder, server=server or training_photos.SERVER, dry_run=dry_run
        )
        results = _print_results(fetched, known, as_json=as_json, quiet=quiet)
        if not quiet:
            print_status(
                f"{len(table) - known} of the {len(table)} photos are left out, because their "
                "origin is not known"
            )
    else:
        from brewster.render.environments import polyhaven  # noqa: PLC0415  (imports urllib)

        request = polyhaven.DownloadRequest(
            **options, dry_run=dry_run, server=server or polyhaven.SERVER
        )
        fetched = polyhaven.pull(request, out or cache_folder() / "maps")
        results = _print_results(
            fetched, request.indoor + request.outdoor, as_json=as_json, quiet=quiet
        )
        for category, requested in (("indoor", request.indoor), ("outdoor", request.outdoor)):
            found = sum(
                result.category == category and result.status != "missing" for result in results
            )
            if found < requested and not quiet:
                print_status(
                    f"{found} of {requested} {category} maps found: the server has no more "
                    f"{category} maps in {request.resolution} {request.format}"
                )
        if not quiet:
            # The terms of service of Poly Haven require these words.
            print_status("powered by Poly Haven, polyhaven.com")
    context.exit(1 if any(result.error for result in results) else 0)


def _print_results(
    fetched: Iterator[DownloadResult], total: int, *, as_json: bool, quiet: bool
) -> list[DownloadResult]:
    """Downloads the files, and prints each result and, also after an interruption, a summary."""
    results: list[DownloadResult] = []
    try:
        with progress(total, shown=not quiet, as_json=as_json) as update_progress:
            for result in fetched:
                results.append(result)
                if as_json:
                    write_out(f"{json.dumps(asdict(result))}\n".encode())
                elif result.status == "planned":
                    write_out(f"{one_line(result.url)} -> {one_line(result.file)}\n".encode())
                if not quiet and result.status in _STATUS_LINES:
                    print_status(
                        _STATUS_LINES[result.status].format(result, (result.bytes or 0) / 1e6)
                    )
                update_progress(sum(result.status != "missing" for result in results), result.asset)
    finally:
        counts = Counter(result.status for result in results)
        if counts and not quiet:
            print_status(", ".join(f"{count} {status}" for status, count in sorted(counts.items())))
        for result in results:
            if result.error:
                print_error(f"{result.asset}: {result.error}")
    return results
