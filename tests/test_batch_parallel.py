"""Archives: resumed runs, damaged and missing photos, stores that fail, several processes, a lost
node.
"""

import hashlib
import os
from functools import partial
from pathlib import Path

import pytest

from brewster.base.executors.local import SerialExecutor
from brewster.base.files import discard
from brewster.base.remote_path import location
from brewster.batch import plan_files, separate_files, separate_tasks
from brewster.batch.runner import SeparationRunner
from brewster.errors import OutputError
from brewster.options import Options
from brewster.photo import Photo
from cli_helpers import image_bytes, json_lines, layer_files, list_files, run_process

NAMES = ("a.jpg", "b/c.jpg", "b/d.jpg")


@pytest.fixture
def options(model):
    return Options(model=str(model))


@pytest.fixture(params=["folder", "store"])
def root(request, tmp_path, store):
    """A folder, or a folder in the memory store, with three photos in `in`."""
    place = tmp_path if request.param == "folder" else location("memory://bucket")
    for number, name in enumerate(NAMES):
        path = place / "in" / name
        if request.param == "folder":
            path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(image_bytes(seed=number))
    return place


def archive_results(root, options, *, source=None, executor=SerialExecutor, **settings):
    """Separates `in` or another source to `out`. Returns the result of each photo by its name."""
    tasks = plan_files(source or root / "in", root / "out", options)
    with executor(partial(SeparationRunner, options, **settings)) as running:
        results = list(separate_tasks(tasks, options, executor=running, **settings))
    return {Path(result.source).name: result for result in results}


def run_archive(root, options, **settings):
    """Returns the status or the error of each photo by its name."""
    found = archive_results(root, options, **settings)
    return {name: result.error or result.status for name, result in found.items()}


def test_an_archive_has_the_bytes_of_a_batch_and_a_result_for_each_photo(root, options, tmp_path):
    results = archive_results(root, options)
    assert list(results) == ["a.jpg", "c.jpg", "d.jpg"]
    result = results["c.jpg"]
    photo = root / "in/b/c.jpg"
    assert result.source == str(photo)
    assert result.photo_sha256 == hashlib.sha256(photo.read_bytes()).hexdigest()
    assert result.model_sha256 == hashlib.sha256(Path(options.model).read_bytes()).hexdigest()
    assert [*result.outputs.values()] == [
        str(root / f"out/b/c.{name}.jpg") for name in ("transmission", "reflection")
    ]
    assert sum(result.seconds.values()) > 0
    assert 0 <= result.assessment.confidence <= 1
    assert (result.status, result.error) == ("separated", None)
    (single,) = separate_files(photo, tmp_path / "plain", options)
    for written, output in zip(result.outputs.values(), single.outputs.values(), strict=True):
        assert location(written).read_bytes() == Path(output).read_bytes()


def test_a_run_is_resumed(root, options):
    run_archive(root, options)
    (root / "out/b/c.reflection.jpg").unlink()
    kept = (root / "out/b/c.transmission.jpg").read_bytes()
    assert run_archive(root, options) == {
        "a.jpg": "skipped",
        "c.jpg": "separated",
        "d.jpg": "skipped",
    }
    assert (root / "out/b/c.transmission.jpg").read_bytes() == kept
    assert set(run_archive(root, Options(model="no-such-model")).values()) == {"skipped"}
    assert set(run_archive(root, options, overwrite=True).values()) == {"separated"}


def test_missing_and_damaged_photos_of_a_manifest_fail_and_the_rest_is_separated(tmp_path, options):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans/good.jpg").write_bytes(image_bytes())
    (tmp_path / "scans/damaged.jpg").write_bytes(image_bytes()[:500])
    manifest = tmp_path / "list.csv"
    manifest.write_text("path\nscans/missing.jpg\nscans/damaged.jpg\nscans/good.jpg\n")
    results = archive_results(tmp_path, options, source=manifest)
    statuses = {name: result.status for name, result in results.items()}
    assert statuses == {"missing.jpg": "failed", "damaged.jpg": "failed", "good.jpg": "separated"}
    assert "missing.jpg cannot be read (No such file" in results["missing.jpg"].error
    assert list_files(tmp_path / "out") == [f"scans/{name}" for name in layer_files("good")]
    (tmp_path / "scans/missing.jpg").write_bytes(image_bytes())
    results = run_archive(tmp_path, options, source=manifest)
    assert (results["missing.jpg"], results["good.jpg"]) == ("separated", "skipped")


def test_if_a_store_fails_the_rest_is_separated_and_the_next_run_completes_it(
    store, options, monkeypatch
):
    root = location("memory://bucket")
    memory = type(store)
    for name in ("a.jpg", "b.jpg", "c.jpg", "d.jpg"):
        (root / "in" / name).write_bytes(image_bytes())
    read = memory.cat_file
    write = memory.pipe_file

    def cat_file(self, path, *args, **kwargs):
        if path.endswith("in/b.jpg"):
            raise TimeoutError("read timed out")
        return read(self, path, *args, **kwargs)

    def pipe_file(self, path, *args, **kwargs):
        if path.endswith("c.reflection.jpg"):
            raise PermissionError("503 Slow Down")
        return write(self, path, *args, **kwargs)

    with monkeypatch.context() as failing:
        failing.setattr(memory, "cat_file", cat_file)
        failing.setattr(memory, "pipe_file", pipe_file)
        results = run_archive(root, options)
    assert (results["a.jpg"], results["d.jpg"]) == ("separated", "separated")
    assert "memory://bucket/in/b.jpg cannot be read (read timed out)" in results["b.jpg"]
    assert "c.reflection.jpg was not written (503 Slow Down)" in results["c.jpg"]
    again = run_archive(root, options)
    assert again == {
        "a.jpg": "skipped",
        "b.jpg": "separated",
        "c.jpg": "separated",
        "d.jpg": "skipped",
    }


def test_a_store_that_cannot_be_written_to_ends_the_run_before_the_first_photo(
    store, monkeypatch, options
):
    root = location("memory://bucket")
    (root / "in/a.jpg").write_bytes(image_bytes())

    def refuse(*_, **__):
        raise PermissionError("Access Denied")

    monkeypatch.setattr(type(store), "pipe_file", refuse)
    with pytest.raises(
        OutputError, match=r"memory://bucket/out/.* was not written \(Access Denied\)"
    ):
        run_archive(root, Options(model="no-such-model"))


def test_layers_that_another_worker_has_written_in_the_meantime_are_kept(tmp_path, options):
    """A node that has lost the connection continues, while another node repeats its task."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in/a.jpg").write_bytes(image_bytes())
    tasks = plan_files(tmp_path / "in", tmp_path / "out", options)
    (tmp_path / "out").mkdir()
    layers = [tmp_path / "out" / layer for layer in layer_files("a")]
    for layer in layers:
        layer.write_bytes(b"written by the other node")
    (result,) = SeparationRunner(options, shared_folder=tmp_path / "out")(tasks[0])
    assert (result.status, result.error) == ("skipped", None)
    assert {layer.read_bytes() for layer in layers} == {b"written by the other node"}


def test_the_layers_are_completed_that_a_worker_had_begun_to_write(tmp_path, options):
    """Its node was stopped between two layers, and another node repeats the task."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in/a.jpg").write_bytes(image_bytes())
    (task,) = plan_files(tmp_path / "in", tmp_path / "out", options)
    (tmp_path / "out").mkdir()
    first, second = (tmp_path / "out" / layer for layer in layer_files("a"))
    first.write_bytes(b"written by the other node")
    (result,) = SeparationRunner(options, shared_folder=tmp_path / "out")(task)
    assert (result.status, result.error) == ("separated", None)
    assert first.read_bytes() == b"written by the other node"
    assert Photo.open(second).size == Photo.open(image_bytes()).size


def test_a_node_without_the_output_folder_ends_the_run(tmp_path, options):
    with pytest.raises(OutputError, match="does not exist on the node"):
        SeparationRunner(options, shared_folder=tmp_path / "not mounted")


def test_the_command_separates_urls(run, tmp_path, store):
    photos = location("memory://bucket/in")
    (photos / "a.jpg").write_bytes(image_bytes())
    (photos / "b.jpg").write_bytes(b"not an image")
    code, out, err = run("memory://bucket/in", "-o", "out", "--json")
    assert code == 1
    expected = {"a.jpg": "separated", "b.jpg": "failed"}
    assert {Path(line["source"]).name: line["status"] for line in json_lines(out)} == expected
    assert "error: memory://bucket/in/b.jpg: " in err
    assert "1 separated, 1 failed in " in err
    (photos / "b.jpg").unlink()
    code, _, err = run("memory://bucket/in", "-o", "memory://bucket/out")
    assert code == 0, err
    layer = location("memory://bucket/out/a.transmission.jpg").read_bytes()
    for target in ("clear.jpg", "memory://bucket/clear.jpg"):
        code, _, err = run("memory://bucket/in/a.jpg", "-o", target)
        assert (code, location(target).read_bytes()) == (0, layer), err


def write_archive(folder):
    """Writes photos, damaged and missing ones, and a layer. Returns the arguments of a command for
    them.
    """
    for number, name in enumerate(("in/a.jpg", "in/b/c.jpg", "d.jpg")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(image_bytes(seed=number))
    (folder / "in/damaged.jpg").write_bytes(b"not an image")
    (folder / "list.csv").write_text("path\nin/b/c.jpg\nin/missing.jpg\n")
    discard(folder / "out")
    (folder / "out").mkdir()
    (folder / "out/d.transmission.jpg").write_bytes(image_bytes())
    return ["in", "./d.jpg", "nowhere/../list.csv", "-o", "out"]


def printed_rows(out):
    """Path, status, layers and error of each line of --json, sorted."""
    return sorted(
        [line[key] for key in ("source", "status", "outputs", "error")] for line in json_lines(out)
    )


def test_several_processes_print_the_results_of_one_with_absolute_paths(run, tmp_path):
    printed = []
    for count in ("1", "2"):
        arguments = [*write_archive(tmp_path), "--workers", count]
        planned = json_lines(run(*arguments, "--json", "--dry-run")[1])
        code, out, err = run(*arguments, "--json", "--contact-sheet", "sheet.png")
        assert code == 1
        assert f"the layers are in {tmp_path / 'out'}\n" in err
        assert f"contact sheet: {tmp_path / 'sheet.png'}\n" in err
        rows = printed_rows(out)
        assert [path for path, *_ in rows] == sorted(line["source"] for line in planned)
        printed.append(rows)
    assert printed[0] == printed[1]
    names = ("d.jpg", "in/a.jpg", "in/b/c.jpg", "in/damaged.jpg", "in/missing.jpg")
    assert [path for path, *_ in rows] == [str(tmp_path / name) for name in names]
    assert {*rows[0][2].values()} == {str(tmp_path / "out" / name) for name in layer_files("d")}


@pytest.mark.slow
def test_a_cluster_prints_the_results_of_one_process(run, tmp_path, model):
    pytest.importorskip("ray")
    code, out, _ = run(*write_archive(tmp_path), "--workers", "1", "--json")
    rows = printed_rows(out)
    arguments = [
        *write_archive(tmp_path),
        "--cluster",
        "local",
        "--workers",
        "2",
        "--model",
        model,
        "--json",
    ]
    environment = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0"}
    done = run_process(*arguments, cwd=tmp_path, env=environment, timeout=900)
    assert (code, done.returncode) == (1, 1), done.stderr
    assert printed_rows(done.stdout) == rows


@pytest.mark.parametrize("link", ["same name", "hard link", "linked folder"])
def test_a_photo_of_the_archive_is_never_replaced(tmp_path, options, link):
    """Also if --overwrite is set and the layer reaches the photo through a link."""
    folder = tmp_path / "photos"
    folder.mkdir()
    photos = [folder / "a.jpg", folder / "a.transmission.jpg"]
    photos[0].write_bytes(image_bytes())
    out = folder
    if link == "hard link":
        photos.pop().hardlink_to(photos[0])
    else:
        photos[1].write_bytes(image_bytes())
    if link == "linked folder":
        out = tmp_path / "linked"
        out.symlink_to(folder)
    results = separate_tasks(plan_files(photos, out, options), options, overwrite=True)
    assert "is itself a photo of the batch" in next(results).error
    list(results)
    assert (folder / "a.transmission.jpg").read_bytes() == image_bytes()
