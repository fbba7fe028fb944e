"""`brewster assets`: what brewster does not ship and fetches when asked, such as maps to light rooms with."""

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
    """Fetch what brewster does not ship."""


@assets.command
@click.argument("source", type=click.Choice(["polyhaven"]))
@click.argument("out", required=False, type=click.Path(path_type=Path))
@click.option(
    "--indoor", type=_COUNT, default=140, show_default=True, metavar="NUMBER", help="How many indoor maps."
)
@click.option(
    "--outdoor", type=_COUNT, default=30, show_default=True, metavar="NUMBER", help="How many outdoor maps."
)
@click.option(
    "--resolution",
    type=click.Choice(["1k", "2k", "4k", "8k", "16k"]),
    default="4k",
    show_default=True,
    help="The width of the maps, in 1024 pixels.",
)
@click.option(
    "--format",
    type=click.Choice(["hdr", "exr"]),
    default="hdr",
    show_default=True,
    help="The container of the maps; reading exr needs the extra brewster[exr].",
)
@click.option(
    "--server",
    metavar="URL",
    default="https://api.polyhaven.com",
    show_default=True,
    help="Where to ask: Poly Haven, or a mirror that answers alike.",
)
@click.option(
    "--json", "as_json", is_flag=True, help="Print one line of JSON for each map on standard output."
)
@click.option("--quiet", is_flag=True, help="Say nothing but errors.")
@click.option("--dry-run", is_flag=True, help="Print what would be downloaded, and write nothing.")
@click.pass_context
def pull(
    context: click.Context,
    /,
    *,
    source: str,  # noqa: ARG001  (there is one)
    out: Path | None,
    as_json: bool,
    quiet: bool,
    **options: Any,  # noqa: ANN401  (the fields of DownloadRequest)
) -> None:
    """Download CC0 maps (360-degree HDR photographs) from Poly Haven into the folder OUT.

    OUT is brewster/maps in the user's cache folder unless it is named. The maps are taken in order of their ids, and
    manifest.csv names them, their authors and their MD5 sums.

    Maps that are there already are skipped, and a download that was stopped goes on where it was. A map that fails
    does not stop the others: it is named at the end, and the exit code is 1.
    """
    from brewster.environments.polyhaven import DownloadRequest, maps_folder  # noqa: PLC0415  (wakes urllib)

    request = DownloadRequest(**options)
    results = _fetch(request, out or maps_folder(), as_json=as_json, quiet=quiet)
    if not quiet:
        _print_shortfall(request, results)
        print_status("powered by Poly Haven, polyhaven.com")  # its terms of service ask for these words
    context.exit(1 if any(result.error for result in results) else 0)


def _fetch(request: DownloadRequest, folder: Path, *, as_json: bool, quiet: bool) -> list[DownloadResult]:
    """Fetches the maps and tells of each; those that failed are named at the end, whatever the end is."""
    from brewster.environments.polyhaven import pull as fetch  # noqa: PLC0415

    results: list[DownloadResult] = []
    shares_terminal = as_json and standard_output.stream.isatty()
    try:
        with progress(request.indoor + request.outdoor, shown=not quiet and not shares_terminal) as advance:
            for result in fetch(request, folder):
                results.append(result)
                _print_result(result, as_json=as_json, quiet=quiet)
                advance(sum(result.status != "missing" for result in results), result.asset)
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
        print_status(f"{result.asset}: passed over, it has no such file")
    elif result.status == "skipped":
        print_status(f"{result.file}: skipped, it is there")
    elif result.status == "downloaded":
        print_status(f"{result.asset} -> {result.file} ({(result.bytes or 0) / 1e6:.1f} MB)")


def _print_summary(results: Sequence[DownloadResult], *, quiet: bool) -> None:
    counts = Counter(result.status for result in results)
    if counts and not quiet:
        print_status(", ".join(f"{count} {status}" for status, count in sorted(counts.items())))
    for result in results:
        if result.error:
            print_error(f"{result.asset}: {result.error}")


def _print_shortfall(request: DownloadRequest, results: Sequence[DownloadResult]) -> None:
    """Says aloud when the server has fewer maps than were asked for."""
    for category, requested in (("indoor", request.indoor), ("outdoor", request.outdoor)):
        found = sum(result.category == category and result.status != "missing" for result in results)
        if found < requested:
            print_status(
                f"{found} of {requested} {category} maps: the server has no more in {request.resolution} {request.format}"
            )
