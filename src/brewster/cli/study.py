"""`brewster study`: create, serve and report a user study that asks which of two results people
prefer.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, final

import click

from brewster.base.access_token import load_or_create_token
from brewster.cli.extras import require_extra
from brewster.cli.parameters import (
    FOLDER,
    JSON,
    Fraction,
    Number,
    flag,
    named_value,
    options,
    output_folder,
    settings_options,
)
from brewster.cli.serve import AUTO, address_options, print_link
from brewster.cli.terminal import print_status, progress, write_out
from brewster.errors import BrewsterError, counted, read_errors
from brewster.options import PYDANTIC_CONFIG

if TYPE_CHECKING:
    from brewster.evaluation.study.store import AnswerStore

_TEXT_FILE: Final = click.Path(path_type=Path, dir_okay=False, exists=True)
_HOST_NAME: Final = re.compile(r"[a-z0-9_-]+(\.[a-z0-9_-]+)*", re.IGNORECASE)
_MAX_BYTES: Final = 10_000  # an answer has about 80 bytes
_WARNING: Final = (
    "warning: {visitors} can take part, and the connection is not encrypted; for an encrypted "
    "connection, keep --host 127.0.0.1, run an HTTPS proxy in front, and give its name with "
    "--host-name"
)

_RULE_OPTIONS: Final = options(
    click.option(
        "--max-failed",
        type=Fraction(0, 1),
        default=0.25,
        help="The maximum fraction of failed catch trials; participants who fail more are "
        "excluded.",
    ),
    click.option(
        "--min-seconds",
        type=click.FloatRange(0),
        default=1.5,
        metavar="SECONDS",
        help="The minimum median time per trial; participants with a shorter one are excluded.",
    ),
)


@click.group
def study() -> None:
    """Run a user study that asks which of two results people prefer: blind, random pairs with catch
    trials.

    `create` makes a study from folders of outputs, `serve` serves the page for participants,
    `progress` shows how far they are, and `report` evaluates their answers. docs/study.md defines
    all terms.
    """


@final
@dataclass(frozen=True)
class _StudySettings:
    __pydantic_config__ = PYDANTIC_CONFIG

    inputs: Annotated[Path, FOLDER]
    """The folder of the photos. It has either photos or one subfolder of photos for each dataset.
    """
    methods: Annotated[
        tuple[tuple[str, str], ...],
        {"names": ["--method"], "metavar": "NAME=FOLDER", "type": named_value("RDNet=out/rdnet")},
    ]
    """The name of a method and the folder of its outputs, named like the inputs; give two or more
    methods. The first method is compared with each other method.
    """
    datasets: Annotated[tuple[str, ...], {"names": ["--dataset"], "metavar": "NAME"}] = ()
    """Use only this dataset; repeatable. The report lists the datasets in this order."""
    list_file: Annotated[Path | None, _TEXT_FILE, {"names": ["--list"], "metavar": "FILE"}] = None
    """Use only the inputs in this text file, one per line: real/12 for picture 12 of the dataset
    real, or 12 without datasets.
    """
    only: Annotated[tuple[str, ...], {"metavar": "NAME"}] = ()
    """Use only this input, such as real/12, or 12 without datasets; repeatable."""
    all_pairs: bool = False
    """Compare each method with every other method."""
    pairs: Annotated[int | None, Number(1), {"names": ["--comparisons"]}] = None
    """The number of pairs per participant; by default 40, or all pairs if the study has fewer."""
    catch_trials: Annotated[int | None, Number(0)] = None
    """The number of catch trials per participant, by default 4. They alternate between two kinds:
    an output next to itself, and an output next to a degraded copy of it.
    """
    seed: Annotated[int | None, Number(0)] = None
    """The random seed of the assignment; by default a random number. The study stores the seed."""
    consent: Annotated[Path | None, _TEXT_FILE, {"metavar": "FILE"}] = None
    """A file with the consent text: plain text with empty lines between paragraphs; by default,
    brewster uses its own text.
    """


@study.command
@click.argument("out", type=FOLDER)
@settings_options(_StudySettings)
def create(settings: _StudySettings, out: Path) -> None:
    """Create a study in the folder OUT from folders of outputs.

    Inputs and outputs are paired by dataset and file name, whatever their format.
    FOLDER/real/12.png and FOLDER/nature/3.jpg belong to the datasets real and nature; without
    subfolders, FOLDER/12.png belongs to a single dataset without a name. If an image is missing,
    duplicate, unreadable or of another size, the error lists it, and nothing is written. The study
    folder contains copies of all images and can be moved.
    """
    from brewster.evaluation.study.create import (  # noqa: PLC0415  (imports pyvips)
        CATCH_POOL_SIZE,
        DEFAULT_CONSENT,
        create_study,
        find_pictures,
        select_pictures,
    )

    inputs = settings.inputs
    list_file = settings.list_file
    consent = settings.consent
    folders = {name: Path(folder) for name, folder in settings.methods}
    if len(folders) < len(settings.methods):
        raise BrewsterError(
            "two methods share a name; the names are "
            f"{', '.join(name for name, _ in settings.methods)}",
            "expected a different name for each method",
            "rename one of the methods",
        )
    names = (
        [line.strip() for line in _read_text(list_file).splitlines() if line.strip()]
        if list_file
        else []
    )
    if list_file and not names:
        raise BrewsterError(
            f"{list_file} is empty", "expected one input per line", "add inputs to the list"
        )
    names += settings.only
    pictures = select_pictures(find_pictures(inputs, settings.datasets), names, inputs)
    sources = {inputs, *folders.values()}  # a picture that is both input and output is copied once
    total = len(pictures) * len(sources) + min(CATCH_POOL_SIZE, len(pictures))
    with progress(total, shown=True) as update_progress:
        description = create_study(
            out,
            inputs,
            folders,
            datasets=settings.datasets,
            names=names,
            pairs=settings.pairs,
            catch_trials=settings.catch_trials,
            all_pairs=settings.all_pairs,
            seed=settings.seed,
            consent=DEFAULT_CONSENT if consent is None else _read_text(consent),
            on_progress=lambda done: update_progress(done, "copying"),
        ).description
    print_status(
        f"{out}: {counted(len(description.comparisons), 'comparison')} of "
        f"{counted(len(description.methods), 'method')}; a participant sees {description.pairs} of "
        f"them and {counted(description.catch_trials, 'catch trial')} (seed {description.seed})"
    )
    print_status(f"next: brewster study serve {out}")


def _read_text(path: Path) -> str:
    with read_errors(path, BrewsterError, "expected plain text in UTF-8", "save the file as UTF-8"):
        return path.read_text("utf-8-sig").strip()


def _read_host_names(
    _context: click.Context, _parameter: click.Parameter, names: tuple[str, ...]
) -> list[str]:
    """Checks the host names, and returns them in lower case. The middleware compares them with the
    Host header.
    """
    for name in names:
        if not _HOST_NAME.fullmatch(name):
            try:
                ipaddress.ip_address(name)
            except ValueError as error:
                raise click.BadParameter(
                    f"{name!r} is not a bare host name, such as study.example.org: leave out "
                    "https://, the port and the path, and encode letters other than a-z as "
                    "Punycode (xn--...)."
                ) from error
    return [name.lower() for name in names]


@study.command
@click.argument("folder", metavar="STUDY", type=FOLDER)
@address_options(
    8420,
    "The token that each request must contain; auto generates one and stores it in STUDY/token.",
)
@click.option(
    "--host-name",
    "host_names",
    multiple=True,
    callback=_read_host_names,
    metavar="NAME",
    help="Another host name of this server, such as study.example.org, the name of a proxy in "
    "front of it; repeatable.",
)
@click.option("--max-participants", type=Number(1), help="The maximum number of participants.")
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

    Each answer is stored on the disk before it is acknowledged. After the server was stopped or
    killed, run the same command again to continue the study.
    """
    require_extra("web", "serving", without=frozenset({"segno"}))
    from brewster.evaluation.study.store import AnswerStore  # noqa: PLC0415
    from brewster.evaluation.study.study import read_study  # noqa: PLC0415
    from brewster.web import application as web  # noqa: PLC0415  (imports FastAPI)
    from brewster.web.middleware import AccessPolicy, is_loopback  # noqa: PLC0415
    from brewster.web.study import study_router  # noqa: PLC0415

    opened_study = read_study(folder)
    opened_study.verify_pictures()
    if not is_loopback(host):
        visitors = (
            "only visitors with the printed link" if token else f"everybody who can reach {host}"
        )
        print_status(_WARNING.format(visitors=visitors))
    token = load_or_create_token(folder / "token") if token == AUTO else token
    policy = AccessPolicy.for_host(host, token=token, max_bytes=_MAX_BYTES)
    policy = replace(policy, hosts=policy.hosts | {*host_names})
    store = AnswerStore(opened_study)
    app = web.create_app(
        study_router(opened_study, store, max_participants=max_participants, token=token),
        policy=policy,
        index="study.html",
    )
    with contextlib.closing(store), contextlib.suppress(KeyboardInterrupt):  # the usual way to stop
        web.serve(app, host=host, port=port, on_ready=lambda url: print_link(url, token))
    print_status("stopped; all answers are stored")


def _open(folder: Path, *, read_only: bool = False) -> contextlib.closing[AnswerStore]:
    from brewster.evaluation.study.store import AnswerStore  # noqa: PLC0415  (imports pydantic)
    from brewster.evaluation.study.study import read_study  # noqa: PLC0415

    return contextlib.closing(AnswerStore(read_study(folder), read_only=read_only))


@study.command
@click.argument("folder", metavar="STUDY", type=FOLDER)
@output_folder("The folder for the report; by default STUDY/report.")
@_RULE_OPTIONS
@flag("--json", "as_json", help="Print the results as JSON instead of the tables.")
def report(folder: Path, *, out: Path | None, as_json: bool, **rule: float) -> None:
    """Evaluate the answers, both without the excluded participants and with all participants.

    The tables are printed on standard output. The output folder gets report.md, report.json,
    table.tex (in the layout of the paper's Table 3) and answers.csv. The server may run at the same
    time.
    """
    require_extra("study", "the report of a study")
    from brewster.evaluation.study.report.participants import ExclusionRule, collect_answers  # noqa: PLC0415
    from brewster.evaluation.study.report.results import summarise, write  # noqa: PLC0415
    from brewster.evaluation.study.report.tables import overview  # noqa: PLC0415

    out = out or folder / "report"
    with _open(folder, read_only=True) as store:
        answers = collect_answers(store.all_answers())
    results = summarise(store.study, answers, ExclusionRule(**rule))
    write(results, store.study, answers, out)
    write_out((json.dumps(results) + "\n" if as_json else overview(results)).encode())
    print_status(f"the report is in {out}")


@study.command("progress")
@click.argument("folder", metavar="STUDY", type=FOLDER)
@_RULE_OPTIONS
@JSON
def show_progress(folder: Path, *, as_json: bool, **rule: float) -> None:
    """Print how many participants have answered how many pairs, without any result. The server may
    run at the same time.
    """
    from brewster.evaluation.study.report.participants import (  # noqa: PLC0415
        ExclusionRule,
        progress_text,
        summarise_progress,
    )

    with _open(folder, read_only=True) as store:
        found = summarise_progress(
            store.study.description, store.all_answers(), ExclusionRule(**rule)
        )
    write_out((json.dumps(found) + "\n" if as_json else progress_text(found)).encode())
