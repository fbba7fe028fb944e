"""`brewster separate`: separate photos; the command has one option for each field of `Options`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, get_args

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from brewster.base.files import absolute, check_output_folder
from brewster.base.image_formats import FormatName, canonical_format, format_of
from brewster.base.remote_path import Location, location
from brewster.cli.batch import BatchReport
from brewster.cli.batch_plan import is_single_output, local_path, plan, skipped_files
from brewster.cli.parameters import (
    FILE,
    OVERWRITE,
    QUIET,
    Number,
    Share,
    field_options,
    flag,
    json_lines,
)
from brewster.cli.terminal import print_status, standard_output
from brewster.errors import BrewsterError, OutputError
from brewster.options import FILM_AUTO, FILM_NO, Group, Layer, Options, option_names
from brewster.separation import registry
from brewster.separation.models.published_networks import PUBLISHED_NETWORKS

if TYPE_CHECKING:
    from brewster.batch import SeparationTask

_Command = TypeVar("_Command", bound=Callable[..., Any])


class _ChoiceList(click.ParamType[tuple[str, ...]]):
    """One or more of a fixed list of choices, separated by commas, without duplicates and in the
    order of the list.
    """

    name = "LAYER,..."

    def __init__(self, choices: tuple[str, ...]) -> None:
        self.choices = choices

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        given = str(value).split(",")
        unknown = [choice for choice in given if choice not in self.choices]
        if unknown:
            self.fail(f"{unknown[0]!r} is not one of {', '.join(self.choices)}.", param, ctx)
        return tuple(choice for choice in self.choices if choice in given)

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        *given, last = incomplete.split(",")
        return [
            CompletionItem(",".join((*given, choice)))
            for choice in self.choices
            if choice.startswith(last) and choice not in given
        ]


class _FormatChoice(click.Choice[str]):
    """The name of a file format such as jpeg, or one of its suffixes such as jpg."""

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> str:
        return super().convert(canonical_format(str(value)), param, ctx)


def _complete_model(
    _context: click.Context, _param: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    names = [name for name in registry.registered() if name.startswith(incomplete)]
    return [*map(CompletionItem, names), CompletionItem(incomplete, type="file")]


_EXISTING: Final[dict[str, Any]] = {"type": click.Path(exists=True, dir_okay=False, path_type=Path)}
_DETAILS: Final[dict[str, dict[str, Any]]] = {
    "strength": {"type": Share()},
    "mask": _EXISTING,
    "hints": _EXISTING,
    "layers": {
        "type": _ChoiceList(get_args(Layer)),
        "default": ",".join(Options.layers),
        "multiple": False,
    },
    "format": {"type": _FormatChoice(get_args(FormatName))},
    "model": {"shell_complete": _complete_model},
}


def with_options(*groups: Group) -> Callable[[_Command], _Command]:
    """Adds one option for each field of `Options` in these groups to a command."""
    return field_options(Options, option_names(*groups), _DETAILS)


@click.command
@click.argument("photos", nargs=-1, required=True, metavar="PHOTO...", type=click.Path())
@click.option(
    "-o",
    "--output",
    metavar="FOLDER|IMAGE|-",
    type=click.Path(),
    help="Where to write the layers: a folder, an image file for a single layer, or - for "
    "standard output.",
)
@with_options("batch", "call", "load")
@json_lines("photo")
@QUIET
@flag(
    "--dry-run",
    help="Print the planned files, and the photos that cannot be opened. Write nothing.",
)
@OVERWRITE
@click.option(
    "--contact-sheet",
    metavar="IMAGE",
    type=FILE,
    help="Also write an overview of all photos and their layers to this image file. An overview "
    "of an earlier run is replaced.",
)
@click.option(
    "--report",
    metavar="FILE.csv",
    type=FILE,
    help="Also write a table with a row for each photo: verdict, removed light, changed area, "
    "seconds, status and "
    "error. A report of an earlier run is replaced; photos that are skipped keep their rows.",
)
@click.option(
    "--workers",
    type=Number(1),
    help="The number of processes that separate photos, each with one thread; with --cluster "
    "local, the number of processors.",
)
@click.option(
    "--cluster",
    metavar="local|ADDRESS",
    help="Separate on a Ray cluster; -o must be a URL, or a folder that all nodes share.",
)
@click.pass_context
def separate(
    context: click.Context,
    /,
    *,
    photos: tuple[str, ...],
    output: str | None,
    as_json: bool,
    quiet: bool,
    dry_run: bool,
    overwrite: bool,
    contact_sheet: Path | None,
    report: Path | None,
    workers: int | None,
    cluster: str | None,
    **values: Any,  # noqa: ANN401  (those of Options)
) -> None:
    """Separate photos taken through glass into transmission and reflection.

    PHOTO is an image file, a folder of image files (other files in it are counted, and skipped), a
    table of paths (.csv or .parquet, with the column path), the URL of one of these in an object
    store (s3://bucket/folder), or - for standard input. The layers of photo.jpg are written next to
    it as photo.transmission.jpg and photo.reflection.jpg, or into the output folder, which mirrors
    the tree below an input folder. If -o is an image file or standard output, only one layer is
    written: the layer that --layers selects, by default the transmission.

    Photos whose layers exist are skipped. A photo fails if these layers were made from another
    photo, for example one with the same name in another folder. If a photo fails, the other photos
    are still separated, the failed photo is listed at the end, and the exit code is 1.
    """
    photos = tuple(map(local_path, photos))
    output = output and local_path(output)
    options = parse_options(context, values, single_output=is_single_output(photos, output))
    if workers or cluster:
        _check_folder(photos, output, cluster)
        # Other nodes have other working folders
        photos = tuple(absolute(location(photo)) for photo in photos)
        output = output and absolute(location(output))
        contact_sheet = contact_sheet and contact_sheet.absolute()
        options = _with_absolute_paths(options)
    workers = _affordable_workers(workers, cluster, options.model)
    tasks = _planned(photos, output, options, quiet=quiet)
    if not dry_run:
        _reject_shared_output(photos, output, as_json=as_json)
    if contact_sheet:
        _check_contact_sheet(contact_sheet, photos, output, cluster)
        tasks = _without_contact_sheet(tasks, contact_sheet, options, overwrite=overwrite)
    if report:
        _check_report(report, overwrite=overwrite)
    batch = BatchReport(
        options, output, dry_run=dry_run, as_json=as_json, quiet=quiet, overwrite=overwrite
    )
    exit_code = batch.run(
        tasks, workers=workers, cluster=cluster, report=report, contact_sheet=contact_sheet
    )
    if output is None:
        _explain_output(photos)
    context.exit(exit_code)


def _check_folder(photos: tuple[str, ...], output: str | None, cluster: str | None) -> None:
    """Checks that several processes, or nodes, can write their layers."""
    if is_single_output(photos, output) or (cluster and not output):
        raise click.UsageError(
            "With --cluster and --workers, layers are written to files: give a folder with -o."
        )


def _affordable_workers(workers: int | None, cluster: str | None, model: str) -> int | None:
    """Returns how many processes of this machine have a model in memory, or None for this one."""
    if workers and not cluster and model in PUBLISHED_NETWORKS:
        print_status(f"one photo at a time, with all processors, because {model} needs much memory")
        return None
    return workers


def _planned(
    photos: tuple[str, ...], output: str | None, options: Options, *, quiet: bool
) -> list[SeparationTask]:
    """Returns the tasks, and prints which files of the folders are no photos."""
    # An unknown name is an error, even if no photo needs the model. Nothing is loaded.
    registry.find(options.model)
    skipped: list[Location] = []
    tasks = plan(photos, output, options, skipped)
    for line in skipped_files(skipped) if not quiet else ():
        print_status(line)
    return tasks


def _explain_output(photos: tuple[str, ...]) -> None:
    """Prints what to type if the last of several paths does not exist, as in
    `cp photo.jpg clear.jpg`.
    """
    last = photos[-1]
    if len(photos) < 2 or last == "-" or "://" in last or os.path.exists(last):  # noqa: PTH110  (Path.exists raises for a long name)
        return
    print_status(f"to write the layers to {last}, give it with -o: brewster {photos[0]} -o {last}")


def _with_absolute_paths(options: Options) -> Options:
    """Returns the options with the absolute paths of the files that they name."""
    names = {*registry.registered(), None}
    models = {name: getattr(options, name) for name in ("model", "base_model")}
    files = {
        name: path
        for name, path in models.items()
        if path not in names and os.path.exists(path)  # noqa: PTH110  (Path.exists raises for a long name)
    }
    return dataclasses.replace(
        options,
        mask=options.mask and options.mask.absolute(),
        hints=options.hints and options.hints.absolute(),
        film=_absolute_film(options.film),
        **{name: os.path.abspath(path) for name, path in files.items()},  # noqa: PTH100
    )


def _absolute_film(film: str) -> str:
    return film if film in (FILM_AUTO, FILM_NO) else str(Path(film).absolute())


def parse_options(
    context: click.Context, values: dict[str, Any], *, single_output: bool
) -> Options:
    """Takes the values of the options out of `values`, and returns them, or raises
    click.UsageError. A single output is the transmission by default.
    """
    if single_output and context.get_parameter_source("layers") is ParameterSource.DEFAULT:
        values["layers"] = ("transmission",)
    try:
        return Options(
            **{
                field.name: values.pop(field.name)
                for field in dataclasses.fields(Options)
                if field.name in values
            }
        )
    except BrewsterError as error:
        raise click.UsageError(str(error)) from error


def _check_report(path: Path, *, overwrite: bool) -> None:
    from brewster.batch.report import is_report  # noqa: PLC0415

    if path.suffix.lower() != ".csv":
        raise click.UsageError(f"--report must be a file such as report.csv, not {path}.")
    if os.path.lexists(path) and not overwrite and not is_report(path):
        raise click.UsageError(
            f"--report {path} exists and is not a report; choose another name, or pass --overwrite."
        )
    _check_parent("--report", path)


def _check_parent(option: str, path: Path) -> None:
    try:
        check_output_folder(path.parent)
    except OutputError as error:
        raise click.UsageError(
            f"{option} {path}: {error.happened}; {error.expected}; choose another folder."
        ) from error


def _check_contact_sheet(
    path: Path, photos: tuple[str, ...], output: str | None, cluster: str | None
) -> None:
    if cluster:
        raise click.UsageError("--contact-sheet cannot be combined with --cluster.")
    if not ((row := format_of(path)) and row.is_writable):
        raise click.UsageError(
            f"--contact-sheet must be an image file such as sheet.jpg, not {path}."
        )
    if "-" in (*photos, output):
        raise click.UsageError(
            "--contact-sheet needs photos and layers that are files, not standard input or output."
        )
    _check_parent("--contact-sheet", path)


def _without_contact_sheet(
    tasks: list[SeparationTask], path: Path, options: Options, *, overwrite: bool
) -> list[SeparationTask]:
    """Returns the tasks without the contact sheets of earlier runs, which may be in the folder of
    the photos.
    """
    from brewster.batch.remaining import input_paths, real_paths  # noqa: PLC0415
    from brewster.photo.contact_sheet import (  # noqa: PLC0415
        is_contact_sheet,
        is_free_for_sheet,
    )

    def is_sheet(source: object) -> bool:
        return (
            isinstance(source, Path)
            and source.stem.startswith(path.stem)
            and is_contact_sheet(source)
        )

    tasks = [task for task in tasks if not is_sheet(task.source)]
    layers = (file for task in tasks for file in task.outputs.values())
    if os.path.realpath(path) in input_paths(tasks, options) | real_paths(layers):
        raise click.UsageError(
            f"--contact-sheet {path} is a photo or a layer of the batch, or its mask or hints; "
            "choose another name."
        )
    if not is_free_for_sheet(path, overwrite=overwrite):
        raise click.UsageError(
            f"--contact-sheet {path} exists and is not a contact sheet; choose another name, or "
            "pass --overwrite."
        )
    return tasks


def _reject_shared_output(photos: tuple[str, ...], output: str | None, *, as_json: bool) -> None:
    if output not in (None, "-") or not is_single_output(photos, output):
        return
    if as_json:
        raise click.UsageError(
            "--json and an image cannot both be written to standard output: give the image a "
            "file name with -o."
        )
    if standard_output.stream.isatty():
        raise click.UsageError(
            "Standard output is a terminal, and an image cannot be written to it: redirect it with "
            "> or |, or give the image a file name with -o."
        )
