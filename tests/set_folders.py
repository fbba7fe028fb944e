"""Helpers for tests of rendered sets: jobs with a fake renderer, and the content of folders."""

import hashlib

from brewster.environments.catalog import BUILTIN_CATALOG
from brewster.rendered.generation.job import RenderJob, build
from brewster.rendered.generation.workers import SerialExecutor
from brewster.scene.recipe import read_scene_recipe


def job(out, renderer="render", seed=7, recipe="tiny"):
    return RenderJob(out, read_scene_recipe(recipe), BUILTIN_CATALOG, seed, f"fake_renderer:{renderer}")


def make(out, count=4, first=0, executor=SerialExecutor, shards=False, **of_job):
    """Builds a set. Returns the result for each sample."""
    results = []
    requested = job(out, **of_job)
    build(requested, range(first, first + count), executor(requested), shards=shards, report=results.append)
    return results


def statuses(results):
    return {result.index: result.status for result in results}


def names(folder):
    return {path.name for path in folder.iterdir()}


def hashes(out):
    """The sha256 of every file by its path."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }
