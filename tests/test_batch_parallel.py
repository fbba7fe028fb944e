"""Archives: the index, resumed runs, damaged and missing photos, stores that fail, several processes, a lost node."""

import hashlib
import os
from contextlib import closing
from functools import partial
from pathlib import Path

import fsspec
import pyarrow
import pytest
from pyarrow import parquet

from brewster.batch import FileResult, plan_files, separate_files, separate_tasks
from brewster.batch.index import COLUMNS, INDEX_FILE, PARTS_FOLDER, IndexWriter
from brewster.batch.runner import SeparationRunner
from brewster.errors import OutputError
from brewster.executors.local import SerialExecutor
from brewster.files import discard
from brewster.options import Options
from brewster.remote_path import location
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


def run_archive(root, options, *, source=None, executor=SerialExecutor, index=True, **settings):
    """Separates `in` or another source to `out`. Returns the status or the error of each photo by its name."""
    out, results = root / "out", []
    tasks = plan_files(source or root / "in", out, options)
    writer = IndexWriter(out) if index else None
    try:
        with executor(partial(SeparationRunner, options, **settings)) as running:
            for result in separate_tasks(tasks, options, executor=running, **settings):
                results.append(result)
                if writer:
                    writer.append(result)
    finally:
        if writer:
            writer.close()
    return {Path(result.source).name: result.error or result.status for result in results}


def read_index(root):
    """Name of a photo -> its row."""
    table = parquet.read_table(fsspec.open(str(root / "out" / INDEX_FILE)).open()).to_pylist()
    assert [row["path"] for row in table] == sorted(row["path"] for row in table)
    return {Path(row["path"]).name: row for row in table}


def test_an_archive_has_the_bytes_of_a_batch_and_a_row_for_each_photo(root, options, tmp_path):
    assert run_archive(root, options) == dict.fromkeys(("a.jpg", "c.jpg", "d.jpg"), "separated")
    rows = read_index(root)
    assert list(rows) == ["a.jpg", "c.jpg", "d.jpg"]
    row, photo = rows["c.jpg"], root / "in/b/c.jpg"
    assert row["path"] == str(photo)
    assert row["photo_sha256"] == hashlib.sha256(photo.read_bytes()).hexdigest()
    assert row["model_sha256"] == hashlib.sha256(Path(options.model).read_bytes()).hexdigest()
    assert row["outputs"] == [str(root / f"out/b/c.{layer}.jpg") for layer in ("transmission", "reflection")]
    assert row["seconds"] > 0
    assert 0 <= row["confidence"] <= 1
    assert (row["status"], row["error"]) == ("separated", None)
    (single,) = separate_files(photo, tmp_path / "plain", options)
    for written, output in zip(row["outputs"], single.outputs.values(), strict=True):
        assert location(written).read_bytes() == Path(output).read_bytes()
    assert not (root / "out" / PARTS_FOLDER).exists()


def test_a_run_is_resumed_and_rows_of_finished_photos_are_kept(root, options):
    run_archive(root, options)
    before = read_index(root)
    (root / "out/b/c.reflection.jpg").unlink()
    kept = (root / "out/b/c.transmission.jpg").read_bytes()
    assert run_archive(root, options) == {"a.jpg": "skipped", "c.jpg": "separated", "d.jpg": "skipped"}
    after = read_index(root)
    assert all(after[name] == before[name] for name in ("a.jpg", "d.jpg"))
    assert after["c.jpg"]["outputs"] == before["c.jpg"]["outputs"]
    assert (root / "out/b/c.transmission.jpg").read_bytes() == kept
    assert set(run_archive(root, Options(model="no-such-model")).values()) == {"skipped"}
    assert set(run_archive(root, options, overwrite=True).values()) == {"separated"}


def test_missing_and_damaged_photos_of_a_manifest_are_rows_and_the_rest_is_separated(tmp_path, options):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans/good.jpg").write_bytes(image_bytes())
    (tmp_path / "scans/damaged.jpg").write_bytes(image_bytes()[:500])
    manifest = tmp_path / "list.csv"
    manifest.write_text("path\nscans/missing.jpg\nscans/damaged.jpg\nscans/good.jpg\n")
    results = run_archive(tmp_path, options, source=manifest)
    assert results["good.jpg"] == "separated"
    assert "missing.jpg cannot be read (No such file" in results["missing.jpg"]
    rows = read_index(tmp_path)
    statuses = {name: row["status"] for name, row in rows.items()}
    assert statuses == {"damaged.jpg": "failed", "good.jpg": "separated", "missing.jpg": "failed"}
    assert rows["missing.jpg"]["error"] == results["missing.jpg"]
    assert list_files(tmp_path / "out") == [INDEX_FILE, *(f"scans/{name}" for name in layer_files("good"))]
    (tmp_path / "scans/missing.jpg").write_bytes(image_bytes())
    results = run_archive(tmp_path, options, source=manifest)
    assert (results["missing.jpg"], results["good.jpg"]) == ("separated", "skipped")
    assert read_index(tmp_path)["missing.jpg"]["error"] is None


def test_if_a_store_fails_the_rest_is_separated_and_the_next_run_completes_it(store, options, monkeypatch):
    root, memory = location("memory://bucket"), type(store)
    for name in ("a.jpg", "b.jpg", "c.jpg", "d.jpg"):
        (root / "in" / name).write_bytes(image_bytes())
    read, write = memory.cat_file, memory.pipe_file

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
    assert {name for name, row in read_index(root).items() if row["error"]} == {"b.jpg", "c.jpg"}
    again = run_archive(root, options)
    assert again == {"a.jpg": "skipped", "b.jpg": "separated", "c.jpg": "separated", "d.jpg": "skipped"}
    assert {row["status"] for row in read_index(root).values()} == {"separated"}


def test_a_store_that_cannot_be_written_to_ends_the_run_before_the_first_photo(store, monkeypatch, options):
    root = location("memory://bucket")
    (root / "in/a.jpg").write_bytes(image_bytes())

    def refuse(*_, **__):
        raise PermissionError("Access Denied")

    monkeypatch.setattr(type(store), "pipe_file", refuse)
    with pytest.raises(OutputError, match=r"memory://bucket/out/.* was not written \(Access Denied\)"):
        run_archive(root, Options(model="no-such-model"))


def test_rows_survive_a_killed_run_and_a_store_that_fails_for_a_while(store, monkeypatch):
    folder = location("memory://bucket/out")
    killed = IndexWriter(folder)
    monkeypatch.setattr("brewster.batch.index.MAX_PART_ROWS", 2)
    for name in "ab":
        killed.append(FileResult(name))
    later = IndexWriter(folder)
    write = type(store).pipe_file

    def refuse(*_, **__):
        raise OSError("503 Slow Down")

    monkeypatch.setattr(type(store), "pipe_file", refuse)
    for name in "cd":
        later.append(FileResult(name))
    monkeypatch.setattr(type(store), "pipe_file", write)
    later.append(FileResult("e", "skipped"))
    later.close()
    table = parquet.read_table(fsspec.open(str(folder / INDEX_FILE)).open())
    assert table.column("path").to_pylist() == list("abcde")
    assert not list((folder / PARTS_FOLDER).iterdir())


def test_a_skipped_photo_replaces_the_row_of_a_failure_only(tmp_path):
    for status in ("failed", "skipped", "separated", "skipped"):
        with closing(IndexWriter(tmp_path / "out")) as index:
            index.append(FileResult("a.jpg", status, photo_sha256=status))
        seen = read_index(tmp_path)["a.jpg"]
        assert seen["photo_sha256"] == seen["status"]
        assert status == "skipped" or seen["status"] == status
    assert seen["status"] == "separated"


def test_an_index_of_an_earlier_version_is_continued(tmp_path):
    old = pyarrow.table({"path": ["a.jpg"], "status": ["separated"], "dropped": [1]})
    parquet.write_table(old, tmp_path / INDEX_FILE)
    with closing(IndexWriter(tmp_path)) as index:
        index.append(FileResult("b.jpg"))
    table = parquet.read_table(tmp_path / INDEX_FILE)
    assert table.column_names == list(COLUMNS)
    assert table.column("path").to_pylist() == ["a.jpg", "b.jpg"]


def test_a_path_that_is_not_text_is_stored_with_escapes(tmp_path):
    for _ in range(2):
        with closing(IndexWriter(tmp_path)) as index:
            index.append(FileResult(os.fsdecode(b"\xff.jpg"), error=os.fsdecode(b"\xff.jpg is damaged")))
    table = parquet.read_table(tmp_path / INDEX_FILE)
    assert table.column("path").to_pylist() == [r"\udcff.jpg"]


def test_another_file_with_the_name_of_the_index_is_never_replaced(tmp_path):
    (tmp_path / INDEX_FILE).write_bytes(b"something else")
    with pytest.raises(OutputError, match=r"index\.parquet is not an index"):
        IndexWriter(tmp_path)
    assert list_files(tmp_path) == [INDEX_FILE]


def test_layers_that_another_worker_has_written_in_the_meantime_are_kept(tmp_path, options, monkeypatch):
    """A node that has lost the connection continues, while another node repeats its task."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in/a.jpg").write_bytes(image_bytes())
    tasks = plan_files(tmp_path / "in", tmp_path / "out", options)
    (tmp_path / "out").mkdir()
    layers = [tmp_path / "out" / layer for layer in layer_files("a")]
    for layer in layers:
        layer.write_bytes(b"written by the other node")
    monkeypatch.setattr("brewster.batch.runner._missing_outputs", lambda task, overwrite: task.outputs)
    (result,) = SeparationRunner(options, shared_folder=tmp_path / "out")(tasks[0])
    assert (result.status, result.error) == ("skipped", None)
    assert {layer.read_bytes() for layer in layers} == {b"written by the other node"}


def test_a_node_without_the_output_folder_ends_the_run(tmp_path, options):
    with pytest.raises(OutputError, match="does not exist on the node"):
        SeparationRunner(options, shared_folder=tmp_path / "not mounted")


def test_the_command_writes_the_index_and_separates_urls(run, tmp_path, store):
    photos = location("memory://bucket/in")
    (photos / "a.jpg").write_bytes(image_bytes())
    (photos / "b.jpg").write_bytes(b"not an image")
    code, out, err = run("memory://bucket/in", "-o", "out", "--index", "--json")
    assert code == 1
    expected = {"a.jpg": "separated", "b.jpg": "failed"}
    assert {Path(line["source"]).name: line["status"] for line in json_lines(out)} == expected
    assert "error: memory://bucket/in/b.jpg: " in err
    assert "1 separated, 1 failed in " in err
    assert {name: row["status"] for name, row in read_index(tmp_path).items()} == expected
    (photos / "b.jpg").unlink()
    code, _, err = run("memory://bucket/in", "-o", "memory://bucket/out")
    assert code == 0, err
    layer = location("memory://bucket/out/a.transmission.jpg").read_bytes()
    for target in ("clear.jpg", "memory://bucket/clear.jpg"):
        code, _, err = run("memory://bucket/in/a.jpg", "-o", target)
        assert (code, location(target).read_bytes()) == (0, layer), err


def write_archive(folder):
    """Writes photos, damaged and missing ones, and a layer. Returns the arguments of a command for them."""
    for number, name in enumerate(("in/a.jpg", "in/b/c.jpg", "d.jpg")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(image_bytes(seed=number))
    (folder / "in/damaged.jpg").write_bytes(b"not an image")
    (folder / "list.csv").write_text("path\nin/b/c.jpg\nin/missing.jpg\n")
    discard(folder / "out")
    (folder / "out").mkdir()
    (folder / "out/d.transmission.jpg").write_bytes(image_bytes())
    return ["in", "./d.jpg", "nowhere/../list.csv", "-o", "out"]


def index_rows(root):
    """Path, status, layers and error of each row of the index."""
    return [[row[key] for key in ("path", "status", "outputs", "error")] for row in read_index(root).values()]


def test_the_index_of_one_process_and_of_several_has_the_same_absolute_paths(run, tmp_path):
    indexes = []
    for options in ([], ["--workers", "2"]):
        arguments = [*write_archive(tmp_path), "--index", *options]
        planned = json_lines(run(*arguments, "--json", "--dry-run")[1])
        code, out, err = run(*arguments, "--json", "--contact-sheet", "sheet.png")
        assert code == 1
        assert f"the layers are in {tmp_path / 'out'}\n" in err
        assert f"contact sheet: {tmp_path / 'sheet.png'}\n" in err
        rows = index_rows(tmp_path)
        printed = {line["source"]: list(line["outputs"].values()) for line in json_lines(out)}
        assert printed == {path: outputs for path, _, outputs, _ in rows}
        assert printed.keys() == {line["source"] for line in planned}
        indexes.append(rows)
    assert indexes[0] == indexes[1]
    names = ("d.jpg", "in/a.jpg", "in/b/c.jpg", "in/damaged.jpg", "in/missing.jpg")
    assert [path for path, *_ in rows] == [str(tmp_path / name) for name in names]
    assert rows[0][2] == [str(tmp_path / "out" / name) for name in reversed(layer_files("d"))]


@pytest.mark.slow
def test_the_index_of_a_cluster_has_the_paths_of_that_of_one_process(run, tmp_path, model):
    pytest.importorskip("ray")
    assert run(*write_archive(tmp_path), "--index")[0] == 1
    rows = index_rows(tmp_path)
    arguments = [*write_archive(tmp_path), "--cluster", "local", "--workers", "2", "--model", model]
    environment = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0"}
    done = run_process(*arguments, cwd=tmp_path, env=environment, timeout=900)
    assert done.returncode == 1, done.stderr
    assert index_rows(tmp_path) == rows


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
