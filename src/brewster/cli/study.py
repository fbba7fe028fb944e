"""`brewster study`: a user study of which of two results people prefer: create, plan, serve and report it."""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

import click

from brewster.cli.evaluate import NamedValue
from brewster.cli.extras import require_extra
from brewster.cli.serve import AUTO, address_options, print_link
from brewster.cli.terminal import print_out, print_status, progress, write_out
from brewster.errors import BrewsterError

_NAME: Final = re.compile(r"[a-z0-9_-]+(\.[a-z0-9_-]+)*", re.IGNORECASE)
_MAX_BYTES: Final = 10_000  # an answer has eighty bytes
_FOLDER: Final = click.Path(path_type=Path, file_okay=False)
_WARNING: Final = (
    "warning: everybody who can reach {host} can take part, and the connection is not encrypted; "
    "behind a proxy that encrypts, keep 127.0.0.1 and give the name of the proxy with --host-name"
)


@click.group
def study() -> None:
    """Run a user study of which of two results people prefer: blind, random pairs with catch trials.

    `create` makes a study from folders of outputs, `plan` computes the number of participants, `serve` runs the page for
    participants, and `report` evaluates their answers. docs/study.md has the definitions.
    """


@study.command
@click.argument("out", type=_FOLDER)
@click.option(
    "--inputs",
    type=_FOLDER,
    required=True,
    metavar="FOLDER",
    help="The photos, or a folder of photos for each dataset.",
)
@click.option(
    "--method",
    "methods",
    type=NamedValue("RDNet=out/rdnet"),
    multiple=True,
    required=True,
    metavar="NAME=FOLDER",
    help="The outputs of a method, named like the inputs; give two or more. The first method is compared with each other method.",
)
@click.option(
    "--dataset",
    "datasets",
    multiple=True,
    metavar="NAME",
    help="Use only this dataset; repeatable, the order is kept.",
)
@click.option("--all-pairs", is_flag=True, help="Compare each method with every other method.")
@click.option(
    "--pairs",
    type=click.IntRange(1),
    metavar="NUMBER",
    help="Number of pairs per participant; by default 40, or all if there are fewer.",
)
@click.option(
    "--catch-trials",
    type=click.IntRange(0),
    metavar="NUMBER",
    help="Number of catch trials per participant, alternately two equal pictures and a degraded one; by default 4.",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    metavar="NUMBER",
    help="The random seed of the assignment; by default a random one, which the study stores.",
)
@click.option(
    "--consent",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    metavar="FILE",
    help="The consent text: plain text with empty lines between paragraphs; by default the text of brewster.",
)
def create(
    out: Path,
    *,
    inputs: Path,
    methods: tuple[tuple[str, str], ...],
    datasets: tuple[str, ...],
    all_pairs: bool,
    pairs: int | None,
    catch_trials: int | None,
    seed: int | None,
    consent: Path | None,
) -> None:
    """Create a study in the folder OUT from folders of outputs.

    Pictures are paired by name, independent of their format: FOLDER/real/12.png and FOLDER/nature/3.jpg belong to the datasets
    real and nature; FOLDER/12.png belongs to the only dataset. If a picture is missing, duplicate, unreadable or of another
    size, it is named, and nothing is written. The study has copies of all pictures, and can be moved.
    """
    from brewster.user_study.create import CATCH_POOL_SIZE, DEFAULT_CONSENT, StudyOptions  # noqa: PLC0415  (imports pyvips)
    from brewster.user_study.create import create as freeze  # noqa: PLC0415
    from brewster.user_study.folders import find_pictures  # noqa: PLC0415

    folders = {name: Path(folder) for name, folder in methods}
    if len(folders) < len(methods):
        raise BrewsterError(
            f"two methods share a name of {', '.join(name for name, _ in methods)}",
            "each method needs a name of its own",
            "choose different names",
        )
    text = DEFAULT_CONSENT if consent is None else _read_consent(consent)
    chosen = StudyOptions(
        datasets=datasets, pairs=pairs, catches=catch_trials, all_pairs=all_pairs, seed=seed, consent=text
    )
    total = len(find_pictures(inputs, datasets)) * (1 + len(folders)) + CATCH_POOL_SIZE
    with progress(total, shown=True) as advance:
        description = freeze(out, inputs, folders, chosen, lambda done: advance(done, "copying")).description
    print_status(
        f"{out}: {len(description.comparisons)} comparisons of {len(description.methods)} methods; a participant sees "
        f"{description.pairs} of them and {description.catches} catch trials (seed {description.seed})"
    )
    print_status(f"next: brewster study serve {out}")


def _read_consent(path: Path) -> str:
    try:
        return path.read_text("utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise BrewsterError(
            f"{path} cannot be read ({error})", "expected plain text in UTF-8", "save it in that encoding"
        ) from error


def _read_names(_context: click.Context, _parameter: click.Parameter, names: tuple[str, ...]) -> list[str]:
    """Names as they appear in the Host header, in lower case. The middleware compares them without the port."""
    for name in names:
        if not _NAME.fullmatch(name):
            try:
                ipaddress.ip_address(name)
            except ValueError as error:
                raise click.BadParameter(
                    f"{name!r} is not a bare host name, such as study.example.org: "
                    "leave out https://, the port and the path, and write letters other than a-z as xn--."
                ) from error
    return [name.lower() for name in names]


@study.command
@click.argument("folder", metavar="STUDY", type=_FOLDER)
@address_options(8420, "Require this token in each request; auto generates one and stores it in STUDY/token.")
@click.option(
    "--host-name",
    "host_names",
    multiple=True,
    callback=_read_names,
    metavar="NAME",
    help="Another host name of this server, such as that of a proxy in front of it: study.example.org; repeatable.",
)
@click.option(
    "--max-participants",
    type=click.IntRange(1),
    metavar="NUMBER",
    help="The largest number of participants.",
)
def serve(
    folder: Path,
    *,
    host: str,
    port: int,
    host_names: list[str],
    token: str | None,
    max_participants: int | None,
) -> None:
    """Serve the page for participants until Ctrl-C.

    Each answer is stored on the disk before it is acknowledged. The same command resumes a study after the server was
    stopped or killed.
    """
    require_extra("web", "serving", without=frozenset({"matplotlib"}))
    from brewster.user_study.access_token import load_or_create_token  # noqa: PLC0415
    from brewster.user_study.store import AnswerStore  # noqa: PLC0415
    from brewster.user_study.study import read_study  # noqa: PLC0415
    from brewster.web import application as web  # noqa: PLC0415  (imports FastAPI)
    from brewster.web.middleware import RequestLimits, is_loopback  # noqa: PLC0415
    from brewster.web.study import study_router  # noqa: PLC0415

    frozen_study = read_study(folder)
    frozen_study.verify_pictures()
    if not is_loopback(host):
        print_status(_WARNING.format(host=host))
    token = load_or_create_token(folder) if token == AUTO else token
    limits = RequestLimits.for_host(host, token=token, max_bytes=_MAX_BYTES)
    limits = replace(limits, hosts=limits.hosts | {*host_names})
    store = AnswerStore(frozen_study)
    app = web.create_app(
        study_router(frozen_study, store, max_participants=max_participants, token=token),
        limits=limits,
        index="study.html",
    )
    with contextlib.closing(store), contextlib.suppress(KeyboardInterrupt):  # the usual way to stop
        web.serve(app, host=host, port=port, on_ready=lambda url: print_link(url, token))
    print_status("stopped; all answers are stored")


@study.command
@click.argument("folder", metavar="STUDY", type=_FOLDER)
@click.option(
    "-o",
    "--output",
    "out",
    type=_FOLDER,
    metavar="FOLDER",
    help="The folder for the report; by default STUDY/report.",
)
@click.option(
    "--max-failed",
    type=click.FloatRange(0, 1),
    default=0.25,
    show_default=True,
    metavar="SHARE",
    help="Exclude participants who fail a larger share of the catch trials.",
)
@click.option(
    "--min-seconds",
    type=click.FloatRange(0),
    default=1.5,
    show_default=True,
    metavar="SECONDS",
    help="Exclude participants who need less time for half of all trials.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the results as JSON instead of the tables.")
def report(folder: Path, *, out: Path | None, max_failed: float, min_seconds: float, as_json: bool) -> None:
    """Evaluate the answers, with and without the exclusion of unreliable participants.

    The tables go to standard output. The folder gets report.md, report.json, table.tex (in the layout of the paper's
    Table 3), table.csv, answers.csv and plot.png. The server may run at the same time.
    """
    require_extra("web", "reporting", without=frozenset({"fastapi", "python-multipart", "uvicorn"}))
    from brewster.user_study.report.participants import ExclusionRule, collect_answers  # noqa: PLC0415
    from brewster.user_study.report.results import summarise, write  # noqa: PLC0415
    from brewster.user_study.report.tables import overview  # noqa: PLC0415
    from brewster.user_study.store import AnswerStore  # noqa: PLC0415
    from brewster.user_study.study import read_study  # noqa: PLC0415

    frozen_study = read_study(folder)
    with contextlib.closing(AnswerStore(frozen_study, read_only=True)) as store:
        answered = collect_answers(store.all_answers())
    results = summarise(frozen_study, answered, ExclusionRule(max_failed, min_seconds))
    out = folder / "report" if out is None else out
    write(results, frozen_study, answered, out)
    write_out((json.dumps(results) + "\n" if as_json else overview(results)).encode())
    print_status(f"the report is in {out}")


@study.command
@click.option(
    "--difference",
    type=click.FloatRange(0, 1, min_open=True),
    required=True,
    metavar="SHARE",
    help="The difference of win rate and loss rate to detect, such as 0.1.",
)
@click.option("--tie", type=click.FloatRange(0, 1, max_open=True), default=0.25, show_default=True, metavar="SHARE", help='The share of the answer "similar".')  # fmt: skip
@click.option(
    "--pairs",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    metavar="NUMBER",
    help="Number of pairs of these two methods per participant.",
)
@click.option(
    "--correlation",
    type=click.FloatRange(0, 1),
    default=0.05,
    show_default=True,
    metavar="NUMBER",
    help="The correlation of the answers of one participant; `report` estimates it.",
)
@click.option("--power", type=click.FloatRange(0.5, 1, max_open=True), default=0.8, show_default=True, metavar="SHARE", help="The probability of detecting the difference if it exists.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def plan(
    *, difference: float, tie: float, pairs: int, correlation: float, power: float, as_json: bool
) -> None:
    """Compute the number of participants that detect a difference at the 5 % level."""
    from brewster.user_study.power_analysis import required_participants  # noqa: PLC0415

    estimate = required_participants(
        difference=difference, tie=tie, pairs=pairs, correlation=correlation, power=power
    )
    if as_json:
        print_out(json.dumps(asdict(estimate)))
        return
    print_out(
        f"{estimate.participants} participants ({estimate.answers} answers) show {estimate.win:.1%} wins to {estimate.lose:.1%} "
        f"losses with {power:.0%} power at the 5 % level."
    )
    print_out(
        f"{pairs} pairs each, correlation {correlation:g}: {estimate.design_effect:.2f} answers have the information of one "
        f"independent answer; the differences of single participants have a standard deviation of {estimate.deviation:.0%}."
    )
