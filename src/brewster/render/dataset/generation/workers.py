"""Runs the tasks of a render job, in processes that `brewster.base.executors` starts.

Every process uses one torch thread. With several threads, the order of sums depends on the number
of cores, and therefore the bytes of a sample, too.
"""

import importlib
import time
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, final

from brewster.base.executors.local import single_torch_thread
from brewster.errors import BrewsterError, OutputError, RecipeError
from brewster.render.dataset import store
from brewster.render.dataset.generation.job import FATAL_ERRORS, RenderJob, RenderResult, RenderTask
from brewster.render.environments.assets import Assets
from brewster.render.sample import LinearSample
from brewster.render.scene.sampler import draw
from brewster.render.scene.scene import Scene, read_scene

Renderer = Callable[[Scene, Assets], LinearSample]

RENDERERS: Final = {
    "analytic": "brewster.render.analytic:render",
    "mitsuba": "brewster.render.mitsuba.renderer:trace",
}
"""The module and the function of each renderer by name."""


@final
class TaskRunner:
    """Runs the tasks of a job in this process. Errors become results with the status "failed",
    except FATAL_ERRORS.
    """

    def __init__(self, job: RenderJob) -> None:
        self._job = job
        self._assets = Assets(job.folders)

    def __call__(self, task: RenderTask) -> list[RenderResult]:
        """Runs a task. Returns its result, or nothing if a block was packed. Raises
        FATAL_ERRORS.
        """
        is_render = task.kind == "render"
        with single_torch_thread():
            result = self._attempt(task.index, self._render if is_render else self._pack)
        return [result] if is_render or result.error else []

    def _pack(self, index: int) -> None:
        store.pack(self._job.out, index // store.SHARD_SIZE)

    def _render(self, index: int) -> None:
        folder = self._job.out / store.key(index)
        if not folder.is_dir():  # a worker that died, or that is only slow, may have rendered it
            scene = draw(self._job.recipe, self._job.catalog, self._job.seed, index)
            sample = find_renderer(self._job.renderer)(scene, self._assets)
            store.write_folder(folder, store.encode_sample(sample, self._job.renderer))

    def _attempt(self, index: int, work: Callable[[int], None]) -> RenderResult:
        started = time.perf_counter()
        try:
            work(index)
            return RenderResult(index, "rendered", time.perf_counter() - started)
        except FATAL_ERRORS:
            raise
        except Exception as error:  # noqa: BLE001  (a bug in one sample must not end the run)
            message = f"internal error ({type(error).__name__}: {error}); please report it"
            if isinstance(error, BrewsterError):
                message = str(error)
            elif isinstance(error, MemoryError):
                message = (
                    "the sample does not fit into memory; expected more free memory; use "
                    "fewer --workers"
                )
            return RenderResult(index, "failed", error=message, kind=type(error).__name__)


def find_renderer(name: str) -> Renderer:
    """Imports a renderer by its name in RENDERERS, or by "module:function"."""
    module, _, function = RENDERERS.get(name, name).partition(":")
    renderer: Renderer = getattr(importlib.import_module(module), function)
    return renderer


def render_again(
    path: Path, folder: Path, folders: Sequence[Path] = (), renderer: str | None = None
) -> None:
    """Renders a scene file into a new folder, by default with the renderer that is recorded in the
    file. Raises OutputError if the folder is not empty.
    """
    scene = read_scene(path)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(
            f"{folder} exists", "expected a new or empty folder", "choose another folder with -o"
        )
    chosen = renderer or _recorded_renderer(path)
    with single_torch_thread():
        sample = find_renderer(chosen)(scene, Assets(folders))
        store.write_folder(folder, store.encode_sample(sample, chosen))


def _recorded_renderer(path: Path) -> str:
    """Returns the renderer that is recorded in a scene file. It must be in RENDERERS: a file cannot
    run other code.
    """
    name = tomllib.loads(path.read_text("utf-8")).get("outcome", {}).get("renderer", "analytic")
    if name not in RENDERERS:
        raise RecipeError(
            f"{path} was rendered by {name!r}",
            f"expected one of {', '.join(RENDERERS)}",
            "choose a renderer with --renderer",
        )
    return str(name)
