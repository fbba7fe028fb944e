"""Batches from Python: names, folders, existing files, errors of single files, streams."""

import csv
import hashlib
import io
from functools import partial
from pathlib import Path

import pytest

from benchmark_folders import write
from brewster import Photo, Separator
from brewster.batch import FileResult, SeparationTask, plan_files, separate_files, separate_tasks
from brewster.batch.report import CsvReport
from brewster.errors import OutputError, PhotoError
from brewster.options import Options
from cli_helpers import LAYERS, image_bytes, layer_files, list_files


@pytest.fixture
def separator():
    return Separator(lambda tile: (0.8 * tile, 0.2 * tile), name="pane", sha256="0" * 64)


@pytest.fixture
def photo_folder(tmp_path):
    """A folder with a photo, a damaged file, and a subfolder with a photo."""
    write(tmp_path / "in", "a.jpg", "c/d.jpg", data=image_bytes())
    return write(tmp_path / "in", "b.jpg", data=b"not an image")


def test_a_folder_is_mirrored_and_a_damaged_photo_does_not_stop_the_batch(
    photo_folder, tmp_path, separator
):
    results = list(separate_files(photo_folder, tmp_path / "out", separator=separator))
    assert [(result.status, result.error is None) for result in results] == [
        ("separated", True), ("failed", False), ("separated", True),
    ]  # fmt: skip
    assert [result.source for result in results] == [
        str(photo_folder / name) for name in ("a.jpg", "b.jpg", "c/d.jpg")
    ]
    assert [result.exception for result in results] == [None] * 3  # a traceback keeps the photo
    assert list_files(tmp_path / "out") == [
        *layer_files("a"),
        *(f"c/{name}" for name in layer_files("d")),
    ]
    first = results[0]
    assert (first.model, first.model_sha256, first.device) == ("pane", "0" * 64, "cpu")
    assert first.outputs == {layer: str(tmp_path / f"out/a.{layer}.jpg") for layer in LAYERS}
    assert set(first.seconds) == {"decode", "network", "upsampling", "encode"}
    assert first.residual == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("missing", LAYERS)
def test_finished_photos_are_skipped_without_a_model_and_missing_layers_are_added(
    tmp_path, separator, missing
):
    (other,) = set(LAYERS) - {missing}
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    list(separate_files(tmp_path, separator=separator))
    no_model = Options(model="no-such-model")
    (skipped,) = separate_files(tmp_path, options=no_model)
    assert (skipped.status, set(skipped.outputs)) == ("skipped", set(LAYERS))
    (tmp_path / f"a.{missing}.jpg").unlink()
    (tmp_path / f"a.{other}.jpg").write_bytes(b"existing file")
    (again,) = separate_files(tmp_path, separator=separator)
    assert (again.status, set(again.outputs)) == ("separated", set(LAYERS))
    assert (tmp_path / f"a.{other}.jpg").read_bytes() == b"existing file"
    assert Photo.open(tmp_path / f"a.{missing}.jpg").size == (60, 40)
    list(separate_files(tmp_path, separator=separator, overwrite=True))
    assert Photo.open(tmp_path / f"a.{other}.jpg").size == (60, 40)


def test_the_digest_is_that_of_the_separated_photo_although_its_file_is_replaced_meanwhile(
    tmp_path,
):
    photo = tmp_path / "a.jpg"
    photo.write_bytes(image_bytes())

    def replace_photo(tile):
        photo.write_bytes(image_bytes(seed=2))
        return 0.8 * tile, 0.2 * tile

    (result,) = separate_files(photo, separator=Separator(replace_photo))
    assert result.photo_sha256 == hashlib.sha256(image_bytes()).hexdigest()


def test_a_report_keeps_rows_of_an_earlier_run_only_for_photos_that_were_separated_then(tmp_path):
    def report(**statuses):
        table = CsvReport(tmp_path / "report.csv")
        for number, (name, status) in enumerate(statuses.items()):
            result = FileResult(name, status, seconds={"network": 0.5 + number + len(statuses)})
            table.append(result.failed(PhotoError("a", "b", "c")) if status == "failed" else result)
        table.close()
        rows = csv.DictReader((tmp_path / "report.csv").read_text().splitlines())
        return {row["path"]: (row["status"], row["seconds"], bool(row["error"])) for row in rows}

    first = report(a="separated", b="failed", c="separated", d="skipped")
    assert first["c"] == ("separated", "6.5000", False)
    second = report(a="skipped", b="skipped", c="separated")
    assert second["a"] == first["a"]
    assert second["b"] == ("skipped", "4.5000", False)  # its layers came from elsewhere
    assert second["c"] == ("separated", "5.5000", False)
    assert report(c="failed") == {"c": ("failed", "1.5000", True)}
    assert report(a="skipped", c="skipped")["c"][0] == "skipped"


def test_a_layer_that_is_added_has_its_own_content(tmp_path, separator):
    for missing in LAYERS:
        folder = tmp_path / missing
        write(folder, "a.jpg", data=image_bytes())
        list(separate_files(folder, separator=separator))
        layer = folder / f"a.{missing}.jpg"
        before = layer.read_bytes()
        layer.unlink()
        list(separate_files(folder, separator=separator))
        assert layer.read_bytes() == before


@pytest.mark.parametrize("painted", ["mask", "hints"])
@pytest.mark.parametrize("dry_run", [False, True])
def test_a_layer_never_replaces_what_a_person_painted(tmp_path, separator, painted, dry_run):
    write(tmp_path, "a.png", data=image_bytes(format_name="png"))
    write(tmp_path, "a.transmission.png", data=image_bytes(format_name="png", seed=2))
    before = (tmp_path / "a.transmission.png").read_bytes()
    (result,) = separate_files(
        tmp_path / "a.png",
        options=Options(**{painted: tmp_path / "a.transmission.png"}),
        separator=separator,
        overwrite=True,
        dry_run=dry_run,
    )
    assert (result.status, result.kind) == ("failed", "OutputError")
    assert (tmp_path / "a.transmission.png").read_bytes() == before


def test_names_and_sources_are_checked_before_the_first_photo_is_separated(tmp_path):
    (tmp_path / "empty").mkdir()
    write(tmp_path, "x/a.jpg", "y/a.jpg", data=image_bytes())
    with pytest.raises(OutputError, match="would both be written"):
        separate_files([tmp_path / "x/a.jpg", tmp_path / "y/a.jpg"], tmp_path / "out")
    with pytest.raises(PhotoError, match="there is no photo in"):
        plan_files(tmp_path / "empty")


def test_a_photo_is_separated_when_its_result_is_requested(photo_folder, tmp_path, separator):
    batch = separate_files(photo_folder, tmp_path / "out", separator=separator)
    assert not (tmp_path / "out").exists()
    assert next(batch).status == "separated"
    assert list_files(tmp_path / "out") == layer_files("a")


def test_an_unexpected_exception_is_raised_after_the_last_photo(
    photo_folder, tmp_path, monkeypatch, separator
):
    call = Separator.__call__

    def fail_on_first(self, source, **options):
        if Path(source).name == "a.jpg":
            raise ZeroDivisionError("a bug")
        return call(self, source, **options)

    monkeypatch.setattr(Separator, "__call__", fail_on_first)
    with pytest.raises(ZeroDivisionError, match="a bug"):
        list(separate_files(photo_folder, tmp_path / "out", separator=separator))
    assert list_files(tmp_path / "out") == [f"c/{name}" for name in layer_files("d")]


def test_progress_names_the_file_and_grows_and_keyboard_interrupt_stops(
    photo_folder, tmp_path, separator
):
    calls = []
    separate = partial(separate_files, photo_folder, separator=separator)
    list(separate(tmp_path / "out", on_progress=lambda *args: calls.append(args)))
    positions = [done + fraction for done, _, fraction in calls]
    assert positions == sorted(positions)
    assert {Path(name).name for _, name, _ in calls} == {"a.jpg", "b.jpg", "d.jpg"}

    def stop(_done, _name, fraction):
        if fraction == 1.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(separate(tmp_path / "other", on_progress=stop))
    assert not (tmp_path / "other").exists()


def test_photos_and_layers_may_be_streams(separator):
    layer = io.BytesIO()
    task = SeparationTask(io.BytesIO(image_bytes(format_name="png")), {"transmission": layer})
    (result,) = separate_tasks([task], separator=separator)
    assert (result.source, result.status, result.outputs) == (
        "-",
        "separated",
        {"transmission": "-"},
    )
    assert Photo.open(layer.getvalue()).file_info.format_name == "png"
