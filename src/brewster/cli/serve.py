"""`brewster serve`: serve the web page and the HTTP API, by default for this machine only."""

import contextlib
import ctypes
import dataclasses
import io
import logging
import secrets
import sys
import webbrowser
from collections.abc import Callable
from typing import Any, Final

import click

from brewster.base.access_token import TOKEN, load_or_create_token, state_folder
from brewster.base.files import DEFAULT_MAX_PIXELS
from brewster.cli.extras import EXTRAS, missing_packages, require_extra
from brewster.cli.parameters import DEVICE, Number, flag, options
from brewster.cli.terminal import print_out, print_status
from brewster.errors import OutputError
from brewster.options import Device

AUTO: Final = "auto"
_M_ARENA_MAX: Final = -8  # malloc.h of glibc
_MAX_BYTES: Final = 100_000_000
_WARNING: Final = (
    "warning: everybody who can reach {host} can send requests to this machine, and the connection "
    "is not encrypted; the server accepts only requests with the token in the link; do not share "
    "the link, and stop the server after use"
)


def address_options(
    port: int, token_help: str
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that adds the options --host, --port and --token to a command."""
    return options(
        click.option(
            "--host", default="127.0.0.1", metavar="ADDRESS", help="The address to bind to."
        ),
        click.option(
            "--port", type=Number(0, 65535), default=port, help="The port; 0 chooses a free port."
        ),
        click.option("--token", callback=_read_token, metavar="TOKEN|auto", help=token_help),
    )


def print_link(
    url: str, token: str | None, *, open_browser: bool = False, qr_code: bool = False
) -> None:
    """Prints the link to the server, including the token, on standard output. `open_browser` also
    opens the link, and `qr_code` prints it as a QR code on standard error.
    """
    link = f"{url}?token={token}" if token else url
    print_out(link)
    if qr_code:
        _print_qr_code(link)
    print_status("press Ctrl-C to stop the server")
    if open_browser:
        webbrowser.open(link)


def _print_qr_code(link: str) -> None:
    import segno  # noqa: PLC0415  (part of the extra web)
    from rich.console import Console  # noqa: PLC0415  (slow to import)

    blocks = io.StringIO()
    segno.make_qr(link, error="L").terminal(blocks, compact=True)
    # The colours are fixed, because some phones cannot read the inverted code that a light terminal
    # would show.
    Console(stderr=True, highlight=False).print(
        blocks.getvalue(), style="bright_white on black", soft_wrap=True, end=""
    )


def _limit_arenas() -> None:
    """Limits the allocator of glibc to two arenas, because an arena per thread keeps memory that
    other threads cannot use. Over 1,500 different photos, the server then needs 257 to 290 MB,
    instead of 302 to 359 MB (as with MALLOC_ARENA_MAX=2).
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library, such as musl
            ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)


def _read_token(
    _context: click.Context, _parameter: click.Parameter, token: str | None
) -> str | None:
    """Checks that the token can be part of a link and of a cookie, and is too long to be
    guessed.
    """
    if token not in (None, AUTO) and not TOKEN.fullmatch(token):
        raise click.BadParameter(
            "expected 16 to 200 characters, each one of A-Z a-z 0-9 _ -; auto generates a token."
        )
    return token


def _kept_token() -> str:
    """Returns the token of this user, which is the same at each start, so that the link and the
    page stay valid; or a new one if no file can be written.
    """
    try:
        return load_or_create_token(state_folder() / "token")
    except OutputError as error:
        print_status(f"the link is valid only until the server stops: {error}")
        return secrets.token_urlsafe(16)


@click.command
@address_options(
    8417,
    "The token that each request must contain; auto generates a token once, and keeps it in a file "
    "of this user. By default, no token is required if --host is a loopback address such as "
    "127.0.0.1; for any other address, the default is auto.",
)
@flag(
    "--lan",
    help="Serve phones in the same network: bind to the address of this machine in it, require a "
    "token, and print the link as a QR code.",
)
@click.option(
    "--model",
    "models",
    multiple=True,
    help="A model to offer in addition to those of `brewster models list`; repeatable. The first "
    "model is the default.",
)
@DEVICE
@click.option(
    "--max-bytes", type=Number(1), default=_MAX_BYTES, help="Reject uploads with more bytes."
)
@click.option(
    "--max-pixels",
    type=Number(1),
    default=DEFAULT_MAX_PIXELS,
    help="Reject photos with more pixels, before they are decoded.",
)
@click.option(
    "--queue",
    type=Number(0),
    default=16,
    help="The maximum number of waiting photos; further requests are rejected with status 503.",
)
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    default=300.0,
    metavar="SECONDS",
    help="The maximum time for one photo, including the time in the queue.",
)
@flag(
    "--verbose",
    help="Log each photo that fails on standard error, with the messages of the libraries that "
    "read it.",
)
@flag("--open", "open_browser", help="Open the page in the web browser.")
def serve(
    *,
    host: str,
    port: int,
    token: str | None,
    lan: bool,
    models: tuple[str, ...],
    device: Device,
    max_bytes: int,
    max_pixels: int,
    queue: int,
    timeout: float,
    verbose: bool,
    open_browser: bool,
) -> None:
    """Serve the web page and the HTTP API until Ctrl-C.

    Drop photos on the page to separate them. Photos are neither sent to other machines nor written
    to the disk. Nothing is downloaded, except a diffusion model given with --model that is not in
    the cache. docs/serving.md describes the API.
    """
    require_extra("web", "serving")
    from brewster.web import application as web  # noqa: PLC0415  (imports FastAPI)
    from brewster.web.film_preparation import FilmPreparation  # noqa: PLC0415
    from brewster.web.job_queue import JobQueue  # noqa: PLC0415
    from brewster.web.middleware import LOOPBACK, AccessPolicy, is_loopback  # noqa: PLC0415
    from brewster.web.model_cache import ModelCache  # noqa: PLC0415
    from brewster.web.separation import separation_router  # noqa: PLC0415

    if lan and (is_loopback(host) or host in ("0.0.0.0", "::")):  # noqa: S104  (a phone needs one address)
        host = web.lan_address()
    _limit_arenas()
    if verbose:
        logging.basicConfig(format="%(asctime)s %(message)s")
        logging.getLogger("brewster").setLevel(logging.INFO)
    if not is_loopback(host):
        print_status(_WARNING.format(host=host))
        token = token or AUTO
    token = _kept_token() if token == AUTO else token
    model_cache = ModelCache(models, device=device)
    # Load the model now, so that a damaged model is reported before the server starts.
    model_cache.separator(model_cache.names[0])
    preparation = FilmPreparation()
    router = separation_router(
        model_cache,
        JobQueue(max_waiting=queue, timeout_seconds=timeout),
        max_pixels=max_pixels,
        preparation=preparation,
    )
    policy = AccessPolicy.for_host(host, token=token, max_bytes=max_bytes)
    if lan:  # without the name of this machine
        policy = dataclasses.replace(policy, hosts=LOOPBACK | {host})
    app = web.create_app(router, policy=policy)

    # Ctrl-C is the usual way to stop the server
    with contextlib.ExitStack() as stack, contextlib.suppress(KeyboardInterrupt):

        def on_ready(url: str) -> None:
            print_link(url, token, open_browser=open_browser, qr_code=lan)
            if not missing_packages(EXTRAS["burst"]):
                stack.enter_context(preparation.running())

        web.serve(app, host=host, port=port, on_ready=on_ready)
    print_status("stopped")
