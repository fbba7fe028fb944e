"""`brewster assets`: download data that brewster does not include, such as environment maps."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from brewster.cli.terminal import one_line, print_error, print_status, progress, standard_output, write_out

if TYPE_CHECKING:
    from brewster.environments.polyhaven import DownloadRequest, DownloadResult

_COUNT = click.IntRange(min=0)


@click.group
def assets() -> None:
    """Download data that brewster does not include."""


@assets.command
@click.argument("source", type=click.Choice(["polyhaven"]))
@click.argument("out", required=False, type=click.Path(path_type=Path))
@click.option(
    "--indoor",
    type=_COUNT,
    default=140,
    show_default=True,
    metavar="NUMBER",
    help="The number of indoor maps.",
)
@click.option(
    "--outdoor",
    type=_COUNT,
    default=30,
    show_default=True,
    metavar="NUMBER",
    help="The number of outdoor maps.",
)
@click.option(
    "--resolution",
    type=click.Choice(["1k", "2k", "4k", "8k", "16k"]),
    default="4k",
    show_default=True,
    help="The width of the maps, in units of 1024 pixels.",
)
@click.option(
    "--format",
    type=click.Choice(["hdr", "exr"]),
    default="hdr",
    show_default=True,
    help="The file format of the maps; exr files need the extra exr.",
)
@click.option(
    "--server",
    metavar="URL",
    default="https://api.polyhaven.com",
    show_default=True,
    help="The server: Poly Haven, or a mirror with the same API.",
)
@click.option(
    "--json", "as_json", is_flag=True, help="Print one line of JSON for each map on standard output."
)
@click.option("--quiet", is_flag=True, help="Print only errors.")
@click.option("--dry-run", is_flag=True, help="Print the planned downloads, and write nothing.")
@click.pass_context
def pull(
    context: click.Context,
    /,
    *,
    source: str,  # noqa: ARG001  (polyhaven is the only choice)
    out: Path | None,
    as_json: bool,
    quiet: bool,
    **options: Any,  # noqa: ANN401  (the fields of DownloadRequest)
) -> None:
    """Download CC0 environment maps (360-degree HDR images) from Poly Haven into the folder OUT.

    OUT is brewster/maps in the user's cache folder by default. The maps are chosen in the order of their ids.
    manifest.csv lists the maps, their authors and their MD5 checksums.

    Existing maps are skipped, and interrupted downloads are resumed. If the download of a map fails, the other maps are
    still downloaded, the failed map is listed at the end, and the exit code is 1.
    """
    from brewster.environments.polyhaven import DownloadRequest, maps_folder  # noqa: PLC0415  (imports urllib)

    request = DownloadRequest(**options)
    results = _fetch(request, out or maps_folder(), as_json=as_json, quiet=quiet)
    if not quiet:
        _print_missing_counts(request, results)
        # The terms of service of Poly Haven require these words.
        print_status("powered by Poly Haven, polyhaven.com")
    context.exit(1 if any(result.error for result in results) else 0)


def _fetch(request: DownloadRequest, folder: Path, *, as_json: bool, quiet: bool) -> list[DownloadResult]:
    """Downloads the maps, and prints each result and a summary. After an interruption, the summary is printed too."""
    from brewster.environments.polyhaven import pull as fetch  # noqa: PLC0415

    results: list[DownloadResult] = []
    shares_terminal = as_json and standard_output.stream.isatty()
    try:
        with progress(
            request.indoor + request.outdoor, shown=not quiet and not shares_terminal
        ) as update_progress:
            for result in fetch(request, folder):
                results.append(result)
                _print_result(result, as_json=as_json, quiet=quiet)
                update_progress(sum(result.status != "missing" for result in results), result.asset)
    finally:
        _print_summary(results, quiet=quiet)
    return results


def _print_result(result: DownloadResult, *, as_json: bool, quiet: bool) -> None:
    if as_json:
        write_out(f"{json.dumps(asdict(result))}\n".encode())
    elif result.status == "planned":
        write_out(f"{one_line(result.url)} -> {one_line(result.file)}\n".encode())
    if quiet:
        return
    if result.status == "missing":
        print_status(
            f"{result.asset}: left out, because the server has no file in this resolution and format"
        )
    elif result.status == "skipped":
        print_status(f"{result.file}: skipped, because it exists")
    elif result.status == "downloaded":
        print_status(f"{result.asset} -> {result.file} ({(result.bytes or 0) / 1e6:.1f} MB)")


def _print_summary(results: Sequence[DownloadResult], *, quiet: bool) -> None:
    counts = Counter(result.status for result in results)
    if counts and not quiet:
        print_status(", ".join(f"{count} {status}" for status, count in sorted(counts.items())))
    for result in results:
        if result.error:
            print_error(f"{result.asset}: {result.error}")


def _print_missing_counts(request: DownloadRequest, results: Sequence[DownloadResult]) -> None:
    """Prints one line for each category of which the server has fewer maps than requested."""
    for category, requested in (("indoor", request.indoor), ("outdoor", request.outdoor)):
        found = sum(result.category == category and result.status != "missing" for result in results)
        if found < requested:
            print_status(
                f"{found} of {requested} {category} maps found: the server has no more {category} maps in "
                f"{request.resolution} {request.format}"
            )
