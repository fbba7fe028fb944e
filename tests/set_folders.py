"""Helpers for tests of rendered datasets: jobs with a fake renderer, and the content of folders."""

import hashlib
from functools import partial

from brewster.base.executors.local import SerialExecutor
from brewster.render.dataset.generation.job import RenderJob, build
from brewster.render.dataset.generation.workers import TaskRunner
from brewster.render.environments.assets import builtin_catalog
from brewster.render.scene.recipe import read_scene_recipe


def make_job(out, renderer="render", seed=7, recipe="tiny"):
    return RenderJob(
        out, read_scene_recipe(recipe), builtin_catalog(), seed, f"fake_renderer:{renderer}"
    )


def render_set(out, count=4, first=0, executor=SerialExecutor, shards=False, **job_values):
    """Renders a dataset. Returns the results of its samples."""
    results = []
    job = make_job(out, **job_values)
    indices = range(first, first + count)
    build(job, indices, executor(partial(TaskRunner, job)), shards=shards, report=results.append)
    return results


def statuses(results):
    """Returns the status of each sample by its index."""
    return {result.index: result.status for result in results}


def names(folder):
    """Returns the names of the files and folders in a folder."""
    return {path.name for path in folder.iterdir()}


def hashes(out):
    """Returns the sha256 of every file by its path."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }
