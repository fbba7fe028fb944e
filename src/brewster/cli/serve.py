"""`brewster serve`: the page and the HTTP API, for this machine unless it is told otherwise."""

from __future__ import annotations

import contextlib
import re
import secrets
import webbrowser
from collections.abc import Callable
from typing import Any, Final, get_args

import click

from brewster.cli.extras import require_extra
from brewster.cli.terminal import print_out, print_status
from brewster.files import DEFAULT_MAX_PIXELS
from brewster.options import Device

AUTO: Final = "auto"
_MAX_BYTES: Final = 100_000_000
_TOKEN: Final = re.compile(r"[A-Za-z0-9_-]{16,200}")
_WARNING: Final = (
    "warning: whoever reaches {host} can send work to this machine, and nothing they send is encrypted; "
    "the link holds a token without which nobody is let in"
)


def address_options(port: int, token_help: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The options that every server has: --host, --port and --token."""

    def decorated(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in (
            click.option("--token", callback=_read_token, metavar="TOKEN|auto", help=token_help),
            click.option(
                "--port",
                type=click.IntRange(0, 65535),
                default=port,
                show_default=True,
                metavar="NUMBER",
                help="The port; 0 takes a free one.",
            ),
            click.option(
                "--host",
                default="127.0.0.1",
                show_default=True,
                metavar="ADDRESS",
                help="The address to bind to.",
            ),
        ):
            command = option(command)
        return command

    return decorated


def print_link(url: str, token: str | None, *, opens: bool = False) -> None:
    """Says on standard output where the server is, with the token, and opens it in the browser if it shall."""
    link = f"{url}?token={token}" if token else url
    print_out(link)
    print_status("Ctrl-C stops the server")
    if opens:
        webbrowser.open(link)


def _read_token(_context: click.Context, _parameter: click.Parameter, token: str | None) -> str | None:
    """A token as it can stand in a link and a cookie, too long to be guessed."""
    if token not in (None, AUTO) and not _TOKEN.fullmatch(token):
        raise click.BadParameter("a token has 16 letters or more, of A-Z a-z 0-9 _ and -; auto makes one.")
    return token


@click.command
@address_options(
    8417,
    "Let in only who brings this token; auto makes one. Needed, and so made, for every address but this machine's own.",
)
@click.option(
    "--model",
    "models",
    multiple=True,
    help="A model that can be chosen beside those of `brewster models list`; the first is the default.",
)
@click.option(
    "--device",
    type=click.Choice(get_args(Device)),
    default="auto",
    show_default=True,
    help="Where the network runs.",
)
@click.option(
    "--max-bytes",
    type=click.IntRange(1),
    default=_MAX_BYTES,
    show_default=True,
    metavar="NUMBER",
    help="Refuse longer uploads.",
)
@click.option(
    "--max-pixels",
    type=click.IntRange(1),
    default=DEFAULT_MAX_PIXELS,
    show_default=True,
    metavar="NUMBER",
    help="Refuse photos of more pixels, before decoding them.",
)
@click.option(
    "--queue",
    type=click.IntRange(0),
    default=16,
    show_default=True,
    metavar="NUMBER",
    help="How many photos may wait; more are told to come back.",
)
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    default=300.0,
    show_default=True,
    metavar="SECONDS",
    help="How long a photo may wait and be worked on.",
)
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
def serve(
    *,
    host: str,
    port: int,
    token: str | None,
    models: tuple[str, ...],
    device: str,
    max_bytes: int,
    max_pixels: int,
    queue: int,
    timeout: float,
    opens: bool,
) -> None:
    """Serve the page and the HTTP API until Ctrl-C.

    The page separates photos that are dropped on it. Nothing leaves this machine, nothing is kept, and nothing is
    fetched from anywhere. docs/serving.md shows the API.
    """
    require_extra("web", "serving", without=frozenset({"matplotlib"}))
    from brewster.web import application as web  # noqa: PLC0415  (wakes FastAPI)
    from brewster.web.job_queue import JobQueue  # noqa: PLC0415
    from brewster.web.middleware import RequestLimits, is_loopback  # noqa: PLC0415
    from brewster.web.model_cache import ModelCache  # noqa: PLC0415
    from brewster.web.separation import separation  # noqa: PLC0415

    if not is_loopback(host):
        print_status(_WARNING.format(host=host))
        token = token or AUTO
    token = secrets.token_urlsafe(16) if token == AUTO else token
    model_cache = ModelCache(models, device=device)
    model_cache.separator(model_cache.names[0])  # what is wrong with the model is said now
    router = separation(model_cache, JobQueue(queue=queue, seconds=timeout), max_pixels=max_pixels)
    app = web.application(router, guard=RequestLimits.at(host, token=token, max_bytes=max_bytes))
    with contextlib.suppress(KeyboardInterrupt):  # the usual end
        web.serve(app, host=host, port=port, on_ready=lambda url: print_link(url, token, opens=opens))
    print_status("stopped")
