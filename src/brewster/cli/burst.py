"""`brewster burst`: separate several photos of one window, with the options of `brewster separate`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import click
from click.core import ParameterSource

from brewster.cli.batch import BatchReport
from brewster.cli.batch_plan import check_output, is_single_output, local_path, plan
from brewster.cli.extras import require_extra
from brewster.cli.separate import with_options
from brewster.errors import BrewsterError
from brewster.models import zoo
from brewster.options import Options

if TYPE_CHECKING:
    from brewster.batch import SeparationTask


@click.command
@click.argument("photos", nargs=-1, required=True, metavar="PHOTO...", type=click.Path())
@click.option(
    "-o",
    "--output",
    metavar="FOLDER|IMAGE",
    type=click.Path(),
    help="Where to write the layers: a folder, or an image file for a single layer.",
)
@click.option(
    "--reference",
    type=click.IntRange(min=1),
    help="The photo to separate: 1 is the first one; by default, the middle one.",
)
@click.option(
    "--frames",
    type=click.IntRange(2, 15),
    default=7,
    show_default=True,
    help="The number of frames to choose from a video.",
)
@with_options
@click.option(
    "--json", "as_json", is_flag=True, help="Print one line of JSON for each burst on standard output."
)
@click.option("--quiet", is_flag=True, help="Print only errors.")
@click.option("--dry-run", is_flag=True, help="Print the planned files. Write nothing.")
@click.option("--overwrite", is_flag=True, help="Replace existing layers.")
@click.pass_context
def burst(
    context: click.Context,
    /,
    *,
    photos: tuple[str, ...],
    output: str | None,
    reference: int | None,
    frames: int,
    as_json: bool,
    quiet: bool,
    dry_run: bool,
    overwrite: bool,
    **values: object,
) -> None:
    """Separate several photos of one window by the motion of the layers.

    Take 3 to 9 photos of the same window, and move the camera 5 to 10 cm sideways between them. The transmission and the
    reflection then move differently, so that they can be measured. If the motion is too small, the reference photo is separated
    alone, and the output reports why.

    PHOTO is an image file, a video, or a folder. All image files are one burst. The photos of each folder, and of each folder in
    it, are one burst. The layers are named after the reference photo, or the video.
    """
    photos = tuple(map(local_path, photos))
    single_output = is_single_output((), output)
    if single_output and context.get_parameter_source("layers") is ParameterSource.DEFAULT:
        values["layers"] = ("transmission",)
    try:
        options = Options(**cast("dict[str, Any]", values))
    except BrewsterError as error:
        raise click.UsageError(str(error)) from error
    zoo.model_name(options.model)
    require_extra("burst", "a burst")
    tasks = _plan(
        photos, output, options, reference=None if reference is None else reference - 1, frames=frames
    )
    report = BatchReport(
        options,
        output,
        len(tasks),
        dry_run=dry_run,
        as_json=as_json,
        quiet=quiet,
        is_parallel=False,
        contact_sheet=None,
        overwrite=overwrite,
    )
    context.exit(report.run(tasks))


def _plan(
    photos: tuple[str, ...], output: str | None, options: Options, *, reference: int | None, frames: int
) -> list[SeparationTask]:
    """Returns a task for each burst.

    Raises:
        click.UsageError: -o is standard output, or an image file for several bursts or layers.
        BrewsterError: see `plan_bursts`.
    """
    from brewster.batch.plan import plan_bursts  # noqa: PLC0415  (imports ONNX Runtime and pyvips)

    if "-" in (*photos, output):
        raise click.UsageError(
            "A burst is read from files and written to files, not standard input or output."
        )
    is_image = is_single_output((), output)
    if not is_image:
        check_output(photos, output)
    tasks = plan_bursts(photos, None if is_image else output, options, reference=reference, frames=frames)
    if not is_image:
        return tasks
    if len(tasks) > 1:
        raise click.UsageError(f"There are {len(tasks)} bursts, and -o is an image file: give a folder.")
    (target,) = plan((str(tasks[0].source),), output, options)
    return [replace(tasks[0], outputs=target.outputs)]
