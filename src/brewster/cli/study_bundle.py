"""`brewster study export` and `import`: participants who cannot reach the machine of the study."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click

from brewster.cli.terminal import print_error, print_out, print_status
from brewster.errors import BrewsterError

_FOLDER = click.Path(path_type=Path, file_okay=False)


@click.command("export")
@click.argument("folder", metavar="STUDY", type=_FOLDER)
@click.option(
    "-o",
    "--output",
    "out",
    type=_FOLDER,
    required=True,
    metavar="FOLDER",
    help="The new folder for the static files.",
)
@click.option(
    "--participants",
    type=click.IntRange(1, 10_000),
    required=True,
    metavar="NUMBER",
    help="The number of participants, who get one personal link each.",
)
@click.option(
    "--url",
    default="",
    metavar="URL",
    help="The address at which you publish the folder, such as https://example.org/study/. It is put before each link.",
)
def export_study(folder: Path, *, out: Path, participants: int, url: str) -> None:
    """Write the page of the study as static files, and print one personal link for each participant.

    Copy the folder to any web server that serves files. Participants download their answers as a file and send it to you;
    `brewster study import` adds it to the study.
    """
    from brewster.user_study.store import AnswerStore  # noqa: PLC0415  (imports pydantic)
    from brewster.user_study.study import read_study  # noqa: PLC0415
    from brewster.web.study_bundle import export_bundle  # noqa: PLC0415

    study = read_study(folder)
    with contextlib.closing(AnswerStore(study)) as store:
        tokens = export_bundle(study, store, out, participants=participants)
    root = url if not url or url.endswith("/") else f"{url}/"
    for token in tokens:
        print_out(f"{root}?p={token}")
    print_status(f"the page is in {out}; send one of the links above to each participant")


@click.command("import")
@click.argument("folder", metavar="STUDY", type=_FOLDER)
@click.argument(
    "files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False)
)
@click.pass_context
def import_answers(context: click.Context, folder: Path, files: tuple[Path, ...]) -> None:
    """Add the answers in files that participants of `brewster study export` have sent.

    A file can be imported again: answers that the study already has are kept. An invalid file is reported, the others are imported,
    and the exit code is 1.
    """
    from brewster.user_study.answer_file import read_answer_file  # noqa: PLC0415  (imports pydantic)
    from brewster.user_study.store import AnswerStore  # noqa: PLC0415
    from brewster.user_study.study import read_study  # noqa: PLC0415

    failed = False
    with contextlib.closing(AnswerStore(read_study(folder))) as store:
        for path in files:
            try:
                answer_file = read_answer_file(path)
                count = store.import_answers(answer_file)
            except BrewsterError as error:
                failed = True
                print_error(str(error))
            else:
                print_status(f"{path}: {count} new answers of {len(answer_file.answers)}")
    context.exit(1 if failed else 0)
