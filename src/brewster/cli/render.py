"""`brewster render`: render a dataset from a recipe, or render one sample again from its
scene.toml.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, final

import click
from click.core import ParameterSource

from brewster.cli.extras import require_extra
from brewster.cli.parameters import EXISTING_FOLDER, FILE, Number, settings_options
from brewster.cli.terminal import print_error, print_out, print_status, progress, write_out
from brewster.options import PYDANTIC_CONFIG

if TYPE_CHECKING:
    from brewster.base.executors.local import Executor
    from brewster.render.dataset.generation.job import RenderJob, RenderResult
    from brewster.render.scene.recipe import BurstRecipe, SceneRecipe

_SCENE_OPTIONS: Final = {"out", "output", "scene", "renderer", "maps", "photos", "quiet"}
_MAX_WORKERS: Final = 8
_SIZE: Final = re.compile(r"0*([0-9]{1,5})[xX]0*([0-9]{1,5})")


def _size(text: str) -> tuple[int, int]:
    match = _SIZE.fullmatch(text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(16 <= side <= 16384 for side in size):
        raise click.BadParameter(
            f"{text!r} is not a size. Give width and height in pixels, from 16 to 16384, such as "
            "512x384."
        )
    return size


@final
@dataclass(frozen=True)
class _RenderCommand:
    """The options of the command. Its methods import torch, which takes two seconds."""

    __pydantic_config__ = PYDANTIC_CONFIG

    recipe: Annotated[str, {"metavar": "NAME|FILE"}] = "window"
    """The distribution of scenes: window, shopfront, vitrine, office, burst, polariser, cloth,
    tiny, or a TOML file.
    """
    count: Annotated[int, Number(0)] = 10
    """The number of samples."""
    first: Annotated[int, Number(0)] = 0
    """The index of the first sample."""
    seed: Annotated[int, Number(0, 2**32 - 1)] = 0
    """The random seed. The same recipe, seed, maps and photos give the same dataset."""
    size: Annotated[tuple[int, int] | None, {"type": _size, "metavar": "WxH"}] = None
    """The size of the images in pixels, such as 512x384; by default, the size in the recipe."""
    burst: Annotated[int | None, Number(2, 99), {"metavar": "N"}] = None
    """Render N photos of each scene, by a camera that moves sideways; --count and --first then
    count bursts. By default, the number in the recipe.
    """
    baseline_mm: Annotated[float | None, click.FloatRange(min=0, max=1e6), {"metavar": "B"}] = None
    """The distance in mm between the first and the last position of the camera in a burst; by
    default, a random distance from the recipe.
    """
    orders: Literal["all", "truncated"] | None = None
    """The light paths in T and R. all: every path, so that I = T + R; truncated: one path for each
    layer, as in the paper; by default, the value in the recipe.
    """
    renderer: Literal["analytic", "mitsuba"] | None = None
    """The renderer: analytic (flat glass only) or mitsuba (a path tracer for all kinds of glass);
    by default analytic, or with --scene, the renderer in scene.toml.
    """
    maps: Annotated[tuple[Path, ...], EXISTING_FOLDER] = ()
    """A folder of HDR environment maps; repeatable. By default, the built-in environments are used.
    """
    photos: Annotated[tuple[Path, ...], EXISTING_FOLDER] = ()
    """A folder of photos that are placed in front of the environment maps; repeatable."""
    shards: bool = False
    """Pack every 100 samples into a shard, a tar file in the WebDataset layout."""
    preview: bool = False
    """Also write preview.png, which shows the first 40 samples."""
    sheet: Annotated[Path | None, {"metavar": "IMAGE", "type": FILE}] = None
    """Also write a contact sheet of all samples of the dataset to this image file: a row with
    photo, transmission, reflection and number for each. A sheet of an earlier run is replaced.
    """
    workers: Annotated[int | None, Number(0)] = None
    """The number of worker processes; 0 renders in the main process. By default, one per CPU core,
    but at most 8.
    """
    cluster: Annotated[str | None, {"metavar": "local|ADDRESS"}] = None
    """Render on a Ray cluster; its nodes must share the folder OUT."""
    as_json: Annotated[bool, {"names": ["--json"]}] = False
    """Print one line of JSON for each sample on standard output."""
    quiet: bool = False
    """Print only errors."""

    def render_again(self, scene: Path, out: Path) -> None:
        from brewster.render.dataset.generation.workers import render_again  # noqa: PLC0415

        render_again(scene, out, (*self.maps, *self.photos), self.renderer)
        if not self.quiet:
            print_status(f"{scene} -> {out}")

    def render_dataset(self, out: Path) -> bool:
        """Renders a dataset and prints each result. Returns whether no sample failed."""
        if self.sheet:
            _check_sheet(self.sheet)
        from brewster.render.dataset.generation.job import build  # noqa: PLC0415
        from brewster.render.dataset.generation.preview import write_preview  # noqa: PLC0415

        job = self._job(out)
        counts = Counter[str]()
        frames = job.recipe.frames
        with progress(
            self.count * frames, shown=not self.quiet, as_json=self.as_json
        ) as update_progress:

            def on_result(result: RenderResult) -> None:
                counts[result.status] += (
                    1  # the results are not stored, so that memory stays constant
                )
                if self.as_json:
                    write_out(f"{json.dumps(asdict(result))}\n".encode())
                if result.error:
                    print_error(f"sample {result.index}: {result.error}")
                elif result.status == "rendered" and not self.quiet:
                    print_status(f"sample {result.index} ({result.seconds:.1f} s)")
                update_progress(counts.total(), f"sample {result.index}")

            indices = range(self.first * frames, (self.first + self.count) * frames)
            build(job, indices, self._executor(job), shards=self.shards, report=on_result)
        if self.preview:
            write_preview(out)
        if self.sheet:
            self._write_sheets(self.sheet, out)
        if not self.quiet:
            totals = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
            print_status(f"{out}: {totals}")
        return not counts["failed"]

    def _write_sheets(self, path: Path, out: Path) -> None:
        from brewster.photo import DEFAULT_MAX_PIXELS  # noqa: PLC0415
        from brewster.photo.contact_sheet import write_contact_sheets  # noqa: PLC0415
        from brewster.render.dataset.generation.preview import sheet_rows  # noqa: PLC0415

        for sheet in write_contact_sheets(path, sheet_rows(out), DEFAULT_MAX_PIXELS):
            if not self.quiet:
                print_status(f"contact sheet: {sheet}")

    def _job(self, out: Path) -> RenderJob:
        from brewster.render.dataset.generation.job import RenderJob  # noqa: PLC0415
        from brewster.render.environments.assets import read_catalog  # noqa: PLC0415

        recipe = self._recipe()
        catalog, errors = read_catalog(self.maps, self.photos)
        for error in errors:
            print_error(f"left out: {error}")
        folders = tuple(folder.resolve() for folder in (*self.maps, *self.photos))
        return RenderJob(
            out.resolve(), recipe, catalog, self.seed, self.renderer or "analytic", folders
        )

    def _recipe(self) -> SceneRecipe:
        """Reads the recipe, and replaces the values for which options are given."""
        from brewster.render.scene.recipe import read_scene_recipe  # noqa: PLC0415

        recipe = read_scene_recipe(self.recipe)
        if self.size:
            width, height = self.size
            camera = recipe.camera.model_copy(update={"width": width, "height": height})
            recipe = recipe.model_copy(update={"camera": camera})
        if self.orders:
            recipe = recipe.model_copy(update={"orders": self.orders})
        return recipe.model_copy(update={"burst": self._burst_recipe(recipe)})

    def _burst_recipe(self, recipe: SceneRecipe) -> BurstRecipe | None:
        from brewster.render.scene.recipe import BurstRecipe  # noqa: PLC0415

        if self.burst is None and recipe.burst is None:
            if self.baseline_mm is not None:
                raise click.UsageError(
                    f"--baseline-mm is an option for bursts, but the recipe {recipe.name!r} has "
                    "single photos:"
                    " add --burst, or use --recipe burst."
                )
            return None
        changes: dict[str, Any] = {} if self.burst is None else {"frames": self.burst}
        if self.baseline_mm is not None:
            changes["baseline_mm"] = self.baseline_mm, self.baseline_mm
            changes["static_probability"] = 0.0
        return (recipe.burst or BurstRecipe()).model_copy(update=changes)

    def _executor(self, job: RenderJob) -> Executor[RenderResult]:
        from brewster.base.executors.local import ProcessExecutor, SerialExecutor  # noqa: PLC0415
        from brewster.render.dataset.generation.workers import TaskRunner  # noqa: PLC0415

        create_runner = partial(TaskRunner, job)
        if self.cluster:
            from brewster.base.executors.ray_cluster import RayExecutor  # noqa: PLC0415

            return RayExecutor(create_runner, self.cluster, self.workers)
        workers = min(_MAX_WORKERS, os.cpu_count() or 1) if self.workers is None else self.workers
        return ProcessExecutor(create_runner, workers) if workers else SerialExecutor(create_runner)


def _check_sheet(path: Path) -> None:
    """Raises UsageError, before anything is rendered, if no contact sheet can have this path."""
    from brewster.base.image_formats import format_of  # noqa: PLC0415
    from brewster.photo.contact_sheet import is_free_for_sheet  # noqa: PLC0415

    if not ((row := format_of(path)) and row.is_writable):
        raise click.UsageError(f"--sheet must be an image file such as sheet.jpg, not {path}.")
    if not is_free_for_sheet(path, overwrite=False):
        raise click.UsageError(
            f"--sheet {path} exists and is not a contact sheet; choose another name."
        )


@click.command
@click.argument("out", required=False, type=FILE)
@click.option(
    "-o",
    "--output",
    metavar="FOLDER",
    type=FILE,
    help="The folder of the dataset, as an alternative to OUT.",
)
@click.option(
    "--show-recipe",
    metavar="NAME|FILE",
    help="Do not render; print this recipe as TOML with all defaults and a comment for each key.",
)
@click.option(
    "--scene",
    type=FILE,
    help="Render only the sample that this scene.toml describes, and write the files of the "
    "sample directly into OUT.",
)
@settings_options(_RenderCommand)
@click.pass_context
def render(
    context: click.Context,
    command: _RenderCommand,
    /,
    *,
    out: Path | None,
    output: Path | None,
    scene: Path | None,
    show_recipe: str | None,
) -> None:
    """Render photos through glass with their ground truth into the folder OUT.

    Each sample is a folder. It has five images: photo.jpg, its layers transmission.jpg and
    reflection.jpg, background.jpg (without glass) and mirror.jpg (with a mirror in place of the
    glass). layers.exr has all five in linear light. scene.toml describes the scene; `brewster
    render --scene` renders the same files from it. index.parquet lists all samples.

    With --burst, or with the recipe burst, each scene has several photos by a moving camera, and
    each photo is a sample: with five photos, burst 2 has the samples 000010 to 000014. The
    reference frame is the middle one.

    Existing samples are kept. To resume an interrupted run, run the same command again. To add
    samples, increase --count. If a sample fails, the other samples are still rendered, the failed
    sample is listed, and the exit code is 1.
    """
    if show_recipe:
        from brewster.base.settings import commented_toml  # noqa: PLC0415
        from brewster.render.scene.recipe import read_scene_recipe  # noqa: PLC0415

        print_out(commented_toml(read_scene_recipe(show_recipe)).rstrip())
        return
    if (out is None) == (output is None):
        raise click.UsageError(
            "Give one output folder, either as OUT or with -o: brewster render OUT."
        )
    require_extra("render", "rendering", without=frozenset({"mitsuba"}))
    folder = out or output or Path()
    if scene:
        for parameter in context.command.params:  # scene.toml defines the whole sample
            name = parameter.name or ""
            option = parameter.opts[0]
            is_given = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
            if is_given and name not in _SCENE_OPTIONS:
                raise click.UsageError(
                    f"--scene renders one sample, but {option} is an option for datasets: leave "
                    f"out {option}."
                )
        command.render_again(scene, folder)
    else:
        context.exit(0 if command.render_dataset(folder) else 1)
