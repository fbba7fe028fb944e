"""`brewster burst`: separate several photos of one window, with the options of `brewster
separate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from brewster.base.files import check_output_folder
from brewster.base.image_formats import WRITABLE_VIDEOS, is_video
from brewster.cli.batch import BatchReport
from brewster.cli.batch_plan import check_output, is_single_output, local_path, plan
from brewster.cli.extras import require_extra
from brewster.cli.parameters import OVERWRITE, QUIET, flag, json_lines
from brewster.cli.separate import parse_options, with_options
from brewster.options import Layer, Options
from brewster.separation import registry

if TYPE_CHECKING:
    from brewster.batch import SeparationTask


@click.command
@click.argument("photos", nargs=-1, required=True, metavar="PHOTO...", type=click.Path())
@click.option(
    "-o",
    "--output",
    metavar="FOLDER|FILE",
    type=click.Path(),
    help="Where to write the layers: a folder, an image file for a single layer, or with "
    "--all-frames a video, such "
    "as clear.mp4: the reflection is then written to clear.reflection.mp4.",
)
@with_options("burst")
@with_options("batch", "call", "load")
@json_lines("burst")
@QUIET
@flag("--dry-run", help="Print the planned files. Write nothing.")
@OVERWRITE
@click.pass_context
def burst(
    context: click.Context,
    /,
    *,
    photos: tuple[str, ...],
    output: str | None,
    **values: Any,  # noqa: ANN401  (those of Options, and the flags of BatchReport)
) -> None:
    """Separate several photos of one window by the motion of the layers, or by changing light.

    Take 3 to 9 photos of the same window, and move the camera between them: along a circle of 5 to
    10 cm, or along a line. The transmission and the reflection then move differently, so that they
    can be measured. If the motion is too small, the reference photo is separated alone, and the
    output reports why.

    If the camera stands, the reflection must change: turn a polariser, hold a dark cloth behind the
    camera, or wait for people and clouds. Such photos are recognised; --method light forces it.

    PHOTO is an image file, a video, or a folder. All image files are one burst. The photos of each
    folder, and of each folder in it, are one burst. The layers are named after the reference photo,
    or the video.
    """
    photos = tuple(map(local_path, photos))
    options = parse_options(context, values, single_output=is_single_output((), output))
    registry.find(options.model)
    require_extra("burst", "a burst")
    tasks = _plan(photos, output, options)
    context.exit(BatchReport(options, output, **values).run(tasks))


def _plan(photos: tuple[str, ...], output: str | None, options: Options) -> list[SeparationTask]:
    from brewster.batch.plan import plan_bursts  # noqa: PLC0415  (imports ONNX Runtime and pyvips)

    if "-" in (*photos, output):
        raise click.UsageError(
            "A burst is read from files and written to files, not standard input or output."
        )
    is_film_name = output is not None and is_video(Path(output))
    if is_film_name and not options.all_frames:
        raise click.UsageError(
            f"-o is the video {output}: add --all-frames, or give a folder or an image file."
        )
    is_file = is_single_output((), output) or (is_film_name and not Path(output or "").is_dir())
    if not is_file:
        check_output(photos[:1], output)
    tasks = plan_bursts(photos, None if is_file else output, options)
    if not is_file:
        return tasks
    if len(tasks) > 1:
        raise click.UsageError(
            f"There are {len(tasks)} bursts, and -o is a single file: give a folder."
        )
    if options.all_frames:
        return [replace(tasks[0], outputs=_video_outputs(Path(output or ""), options.layers))]
    (target,) = plan((str(tasks[0].source),), output, options)
    return [replace(tasks[0], outputs=target.outputs)]


def _video_outputs(output: Path, layers: Sequence[Layer]) -> dict[str, Path]:
    """Returns the paths of the layers of all frames: the first one is -o, and the second one has
    its name added.
    """
    if output.suffix.lower() not in WRITABLE_VIDEOS:
        raise click.UsageError(
            f"-o ends in {output.suffix}, but brewster writes no videos with this suffix. Choose "
            f"one of {', '.join(WRITABLE_VIDEOS)}."
        )
    check_output_folder(output.parent)
    first, *others = layers
    paths: dict[str, Path] = {
        layer: output.with_suffix(f".{layer}{output.suffix}") for layer in others
    }
    return {first: output} | paths
