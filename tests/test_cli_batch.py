"""Batches with damaged photos and unusable outputs: no partial or lost files, and all other photos
are separated.
"""

import csv
import errno
import hashlib
import os
import socket
import sys
from dataclasses import fields
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import pyvips
from PIL import Image

from benchmark_folders import write
from brewster import Photo
from brewster.batch import FileResult
from brewster.cli.batch import _duration
from brewster.photo import FileInfo
from brewster.separation import Separator
from brewster.separation.assessment import next_step
from cli_helpers import LAYERS, error_lines, image_bytes, json_lines, layer_files, list_files
from picture_files import exr_of, file_of


def truncated_jpeg():
    data = image_bytes(600, 400)
    return data[: len(data) // 2]


def animation(kind):
    black = np.zeros((8, 8, 3), np.uint8)
    return file_of(black, kind, save_all=True, append_images=[Image.fromarray(black + 255)])


def five_channel_tiff():
    return pyvips.Image.black(8, 8, bands=5).tiffsave_buffer()


def test_damaged_photos_are_named_at_the_end_and_the_others_are_separated(run, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    damaged = {
        "animated.gif": animation("GIF"), "animated.webp": animation("WEBP"), "empty.jpg": b"",
        "five.tiff": five_channel_tiff(), "half.jpg": truncated_jpeg(),
        "nan.exr": exr_of({name: np.full((4, 4), np.nan, np.float32) for name in "RGB"}),
        "text.jpg": b"This is not an image.",
    }  # fmt: skip
    for name, data in damaged.items():
        (folder / name).write_bytes(data)
    for name in ("a", "good", "zebra"):
        (folder / f"{name}.jpg").write_bytes(image_bytes())
    code, out, err = run("in", "-o", "out", "--quiet")
    assert (code, out) == (1, b"")
    assert list_files(tmp_path / "out") == layer_files("a", "good", "zebra")
    assert len(err.splitlines()) == len(error_lines(err)) == len(damaged)
    for name in damaged:
        assert sum(f"in/{name}" in line for line in error_lines(err)) == 1, name
    assert len(list_files(folder)) == len(damaged) + 3


def test_a_photo_that_does_not_fit_into_memory_does_not_stop_the_others(run, tmp_path, monkeypatch):
    write(tmp_path, "a.jpg", "b.jpg", data=image_bytes())
    separate = Separator.__call__

    def run_out_of_memory(self, source, **options):
        if source.name == "a.jpg":
            raise MemoryError
        return separate(self, source, **options)

    monkeypatch.setattr(Separator, "__call__", run_out_of_memory)
    code, _, err = run(".", "-o", "out")
    assert code == 1
    assert "error: a.jpg: the photo does not fit into memory" in err
    assert list_files(tmp_path / "out") == layer_files("b")


FILE_NAMES = [
    "with space",
    "Schöne Fenster é",
    "two\nlines",
    "[bold]red",
    "-dash",
    b"\xff\xfe not text",
]


def test_any_file_name_works_and_each_error_is_one_line(run, tmp_path):
    names = [os.fsdecode(name) for name in FILE_NAMES]
    write(tmp_path, *(f"{name}.jpg" for name in names), data=image_bytes())
    (tmp_path / "bad\nname.jpg").write_bytes(b"")
    code, out, err = run(".", "-o", "out", "--json", "--report", "report.csv")
    assert code == 1
    assert list_files(tmp_path / "out") == layer_files(*names)
    with (tmp_path / "report.csv").open(newline="", encoding="utf-8") as file:
        reported = {row["path"] for row in csv.DictReader(file)}
    written = {
        f"{name}.jpg".encode(errors="backslashreplace").decode() for name in (*names, "bad\nname")
    }
    assert reported == written
    assert {line["source"] for line in json_lines(out)} == {
        f"{name}.jpg" for name in (*names, "bad\nname")
    }
    assert len(error_lines(err)) == 1
    assert r"bad\nname.jpg" in error_lines(err)[0]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders")
def test_a_photo_from_a_pipe_is_read_once(run, tmp_path):
    os.mkfifo(tmp_path / "pipe.jpg")
    writer = Thread(target=(tmp_path / "pipe.jpg").write_bytes, args=[image_bytes()])
    writer.start()
    code, out, err = run("pipe.jpg", "-o", "out", "--json")
    writer.join()
    assert code == 0, err
    assert json_lines(out)[0]["photo_sha256"] == hashlib.sha256(image_bytes()).hexdigest()


@pytest.mark.parametrize("more", [(), ("--report", "r.csv")])
def test_a_full_disk_stops_the_batch_with_one_error_and_no_partial_file(
    run, tmp_path, monkeypatch, more
):
    """fsync reports the full disk; it is the last call at which the kernel can report it."""
    write(tmp_path, "a.jpg", "b.jpg", "c.jpg", "d.jpg", data=image_bytes())
    assert run("a.jpg", "-o", "out")[0] == 0
    fsync = os.fsync
    calls = []

    def fail_at_the_second_layer(file):
        calls.append(file)
        if len(calls) >= 3:  # of a layer and its folder
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(file)

    monkeypatch.setattr(os, "fsync", fail_at_the_second_layer)
    code, out, err = run(".", "-o", "out", "--json", *more)
    assert code == 1
    (error,) = error_lines(err)
    assert "b.reflection.jpg was not written (No space left on device)" in error
    assert "1 of 4 photos are finished, 3 left" in error
    written = {*layer_files("a"), "b.transmission.jpg"}
    assert {name for name in list_files(tmp_path / "out") if name.endswith(".jpg")} == written
    results = json_lines(out)
    assert [result["status"] for result in results] == ["skipped", "failed"]
    assert [*results[1]["outputs"]] == ["transmission"]


def special_files(folder):
    """Creates a pipe, a link to a device and a socket with the suffix of an image. Returns the
    socket.
    """
    os.mkfifo(folder / "pipe.jpg")
    (folder / "device.jpg").symlink_to("/dev/zero")
    unix = socket.socket(socket.AF_UNIX)
    unix.bind(str(folder / "socket.jpg"))
    return unix


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders")
@pytest.mark.parametrize("more", [(), ("--dry-run",), ("--workers", "2")], ids=str)
def test_pipes_sockets_and_devices_in_a_folder_are_skipped_and_named(
    run, tmp_path, monkeypatch, more
):
    folder = tmp_path / "in"
    folder.mkdir()
    monkeypatch.chdir(folder)  # the path of a socket must be short
    with special_files(Path()):
        (folder / "a.jpg").write_bytes(image_bytes())
        monkeypatch.chdir(tmp_path)
        code, _, err = run("in", "-o", "out", *more)
    assert code == 0
    (line,) = [line for line in err.splitlines() if "skipped: expected regular files" in line]
    assert "3 special files" in line
    assert all(name in line for name in ("pipe.jpg", "device.jpg", "socket.jpg"))
    assert list_files(tmp_path / "out") == ([] if "--dry-run" in more else layer_files("a"))


def test_the_report_has_a_row_for_each_photo_and_the_summary_counts_the_verdicts(run, tmp_path):
    write(tmp_path, "in/a.jpg", "in/b, c.jpg", data=image_bytes())
    (tmp_path / "in" / "half.jpg").write_bytes(truncated_jpeg())
    (tmp_path / "in" / "png.jpg").write_bytes(image_bytes(format_name="png"))
    code, out, err = run("in", "-o", "out", "--report", "out/report.csv", "--json")
    assert code == 1
    with (tmp_path / "out" / "report.csv").open(newline="") as file:
        rows = {row["path"]: row for row in csv.DictReader(file)}
    results = {result["source"]: result for result in json_lines(out)}
    assert (
        rows.keys() == results.keys() == {f"in/{name}.jpg" for name in ("a", "b, c", "half", "png")}
    )
    for name, row in rows.items():
        result = results[name]
        assessment = result["assessment"] or {}
        for key in ("status", "error", "note"):
            assert row[key] == (result[key] or "")
        assert row["verdict"] == assessment.get("verdict", "")
        step = assessment and next_step(assessment["verdict"], takes_hints=False)
        assert result["next_step"] == (step or None)
        assert not step or f"{assessment['verdict']}: {step}" in err
        for number in ("removed_light", "changed_area"):
            assert row[number] == (f"{assessment[number]:.4f}" if assessment else "")
        assert bool(row["seconds"]) == bool(result["seconds"])
    assert "its content is PNG, not JPEG" in rows["in/png.jpg"]["note"]
    verdict = results["in/a.jpg"]["assessment"]["verdict"]
    assert f"3 {verdict}: list them with" in err
    report = (tmp_path / "out" / "report.csv").read_text()
    run(
        "in", "-o", "out", "--report", "out/report.csv"
    )  # resumes: the report keeps the rows of the earlier run
    assert (tmp_path / "out" / "report.csv").read_text() == report
    run("in", "-o", "out", "--report", "out/other.csv")
    assert (tmp_path / "out" / "other.csv").read_text().count("skipped") == 3
    (tmp_path / "mine.csv").write_text("path\n")
    for path in ("mine.csv", "report.txt", "in/a.jpg/r.csv"):
        code, _, err = run("in", "-o", "out", "--report", path)
        assert (code, "--report" in err) == (2, True)
    assert (tmp_path / "mine.csv").read_text() == "path\n"
    run("in", "-o", "out", "--report", "mine.csv", "--overwrite")
    assert (tmp_path / "mine.csv").read_text().count("separated") == 3


@pytest.mark.parametrize(("seconds", "text"), [
    (0.04, "0.0 s"), (59.9, "59.9 s"), (60, "1 min 0 s"), (185.4, "3 min 5 s"),
    (3599.4, "59 min 59 s"), (3599.6, "1 h 0 min"), (9659, "2 h 40 min"), (90_000, "25 h 0 min"),
])  # fmt: skip
def test_the_time_of_a_run_is_told_in_two_units(seconds, text):
    assert _duration(seconds) == text


def test_metadata_that_the_format_of_the_layers_cannot_keep_are_noted(run, tmp_path):
    info = FileInfo("jpeg", iptc=b"8BIM\4\4\0\0\0\0\0\2ab", exif=b"II*\0\x08\0\0\0\0\0")
    (tmp_path / "a.jpg").write_bytes(Photo(np.zeros((20, 30, 3), np.uint8), None, info).encode())
    for name, lost in ("jpeg", None), ("png", "IPTC"), ("exr", "EXIF, IPTC"):
        (result,) = json_lines(run("a.jpg", "-o", name, "--json", "--format", name)[1])
        assert result["note"] == (lost and f"its {lost} cannot be kept in {name}")
    # The confidence is no version of the photo, and has none of its metadata in any case
    layers = ("--layers", "transmission,confidence")
    (result,) = json_lines(run("a.jpg", "-o", "with", "--json", *layers)[1])
    assert (set(result["outputs"]), result["note"]) == ({"transmission", "confidence"}, None)


def test_a_dry_run_finds_the_photos_that_a_real_run_cannot_separate(run, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    files = {
        "a.jpg": image_bytes(), "cut.jpg": truncated_jpeg(),
        "cut.png": image_bytes(600, 400, "png")[:5000], "frames.gif": animation("GIF"),
        "five.tiff": five_channel_tiff(), "pages.tif": animation("TIFF"),
        "text.jpg": b"Hello,\n\tthis is text",
    }  # fmt: skip
    for name, data in files.items():
        (folder / name).write_bytes(data)
    code, out, _ = run("in", "-o", "out", "--dry-run", "--json")
    assert code == 1
    planned = {result["source"]: (result["status"], result["error"]) for result in json_lines(out)}
    assert not (tmp_path / "out").exists()
    out = run("in", "-o", "out", "--json")[1]
    real = {result["source"]: (result["status"], result["error"]) for result in json_lines(out)}
    assert planned.pop("in/a.jpg")[0] == "planned"
    assert real.pop("in/a.jpg")[0] == "separated"
    assert planned == real
    assert {status for status, _ in planned.values()} == {"failed"}


@pytest.mark.parametrize("link", ["same", "symlink", "hardlink"])
def test_a_photo_is_never_overwritten_by_its_own_layer(run, tmp_path, link):
    data = image_bytes()
    (tmp_path / "a.jpg").write_bytes(data)
    target = "a.jpg" if link == "same" else "b.jpg"
    if link == "symlink":
        (tmp_path / "b.jpg").symlink_to("a.jpg")
    if link == "hardlink":
        (tmp_path / "b.jpg").hardlink_to(tmp_path / "a.jpg")
    for overwrite in ([], ["--overwrite"]):
        code, _, err = run("a.jpg", "-o", target, *overwrite)
        assert code == 1
        assert "is itself a photo" in error_lines(err)[0]
    assert (tmp_path / "a.jpg").read_bytes() == data


@pytest.mark.parametrize("option", ["--mask", "--hints"])
def test_the_mask_and_the_hints_are_never_overwritten(run, tmp_path, option):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    painted = image_bytes(format_name="png")
    (tmp_path / "painted.png").write_bytes(painted)
    code, _, err = run("a.jpg", option, "painted.png", "-o", "painted.png", "--overwrite")
    assert (code, (tmp_path / "painted.png").read_bytes()) == (1, painted)
    assert "never overwritten" in error_lines(err)[0]


@pytest.mark.parametrize("options", [[], ["--dry-run"], ["--workers", 1, "-o", "."]])
def test_a_model_that_does_not_exist_is_an_error_even_if_all_layers_exist(run, tmp_path, options):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    assert run("a.jpg")[0] == 0
    code, out, err = run("a.jpg", "--model", "nonsuch", *options, with_model=False)
    assert (code, out) == (1, b"")
    assert err.startswith("error: there is no model 'nonsuch'; expected one of compact, ")
    for name in (300 * "n", f"owner/{300 * 'n'}", f"{300 * 'n'}/name.onnx"):
        code, _, err = run("a.jpg", "--model", name, *options, with_model=False)
        assert (
            code,
            err.startswith(f"error: there is no model '{name}'; expected one of compact, "),
        ) == (1, True)
    (tmp_path / "folder").mkdir()
    for model in (
        "compact",
        "owner/name",
        "tiny:klein",
        "windowseat",
        "folder",
    ):  # valid, and not loaded
        assert run("a.jpg", "--model", model, *options, with_model=False)[0] == 0


@pytest.mark.parametrize("options", [[], ["--workers", 1], ["--dry-run"]])
def test_the_layers_of_another_photo_are_an_error(run, tmp_path, options):
    for seed, name in enumerate(("a/1.jpg", "b/1.jpg", "b/2.jpg")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(image_bytes(seed=seed))
    assert run("a/1.jpg", "-o", "col")[0] == 0
    layers = {path.name: path.read_bytes() for path in (tmp_path / "col").iterdir()}
    code, out, err = run("b", "-o", "col", "--json", *options)
    assert code == 1
    assert [line["status"] for line in json_lines(out)].count("failed") == 1
    (line,) = error_lines(err)
    assert "col/1.transmission.jpg was made from another photo, or from another version of " in line
    assert "b/1.jpg; expected layers of this photo" in line
    assert {name: (tmp_path / "col" / name).read_bytes() for name in layers} == layers
    assert run("a", "-o", "col", *options)[0] == 0  # its own layers
    assert run("b", "-o", "col", "--overwrite", *options)[0] == 0


def test_a_photo_that_has_changed_since_its_separation_is_an_error(run, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    run("a.jpg")
    (tmp_path / "a.jpg").write_bytes(image_bytes(seed=2))
    assert "another version of a.jpg" in run("a.jpg")[2]
    (tmp_path / "a.transmission.jpg").write_bytes(
        image_bytes()
    )  # layers without a record are accepted
    (tmp_path / "a.reflection.jpg").write_bytes(image_bytes())
    assert "a.jpg: skipped" in run("a.jpg")[2]


def test_the_same_photo_gives_the_same_bytes_twice(run, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes(300, 200))
    for folder in ("one", "two"):
        assert run("a.jpg", "-o", folder, "--layers", "transmission,reflection,confidence")[0] == 0
    for name in list_files(tmp_path / "one"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_a_dry_run_prints_the_planned_files_and_writes_nothing(run, tmp_path):
    write(tmp_path, "a.jpg", "b.jpg", data=image_bytes())
    (tmp_path / "a.reflection.jpg").write_bytes(b"")
    (tmp_path / "broken.onnx").write_bytes(b"")
    before = list_files(tmp_path)
    code, out, _ = run(".", "--dry-run", "--model", "broken.onnx", with_model=False)
    planned = b"a.jpg -> a.transmission.jpg\nb.jpg -> b.transmission.jpg, b.reflection.jpg\n"
    assert (code, out) == (0, planned)
    planned = json_lines(run(".", "--dry-run", "--json")[1])
    assert [line["status"] for line in planned] == ["planned", "planned"]
    assert list_files(tmp_path) == before


@pytest.mark.parametrize("options", [[], ["--dry-run"]])
def test_a_folder_that_cannot_be_written_to_is_one_error_for_all_its_photos(
    run, tmp_path, monkeypatch, options
):
    folder = tmp_path / "card"
    make_folder = Path.mkdir
    folder.mkdir()
    for seed, name in enumerate(("a", "b", "done")):
        (folder / f"{name}.jpg").write_bytes(image_bytes(seed=seed))
    assert run("card/done.jpg")[0] == 0

    def mkdir(path, *args, **kwargs):
        if path.parent == folder:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        make_folder(path, *args, **kwargs)

    # root can write to any folder, so the read-only file system is simulated
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != folder)
    monkeypatch.setattr(Path, "mkdir", mkdir)
    code, out, err = run("card", "--json", *options, with_model=False)
    assert code == 1
    assert [line["status"] for line in json_lines(out)] == ["failed", "failed", "skipped"]
    (line,) = error_lines(err)
    assert line.startswith(
        f"error: 2 photos (card/a.jpg, card/b.jpg): {folder} was not written (Read-only"
    )


@pytest.mark.parametrize(
    "options", [[], ["--workers", "1"], ["--dry-run"], ["--dry-run", "--workers", "1"]]
)
def test_rows_without_a_readable_photo_are_errors_with_their_number_also_in_a_dry_run(
    run, tmp_path, options
):
    (tmp_path / "scans/folder").mkdir(parents=True)
    write(tmp_path / "scans", "a.jpg", data=image_bytes())
    write(tmp_path / "scans", "empty.jpg", data=b"")
    (tmp_path / "list.csv").write_text(
        "path\nscans/a.jpg\nscans/none.jpg\nscans/folder\nscans/empty.jpg\n"
    )
    code, out, err = run("list.csv", "-o", "out", "--json", *options)
    statuses = [line["status"] for line in json_lines(out)]
    assert (code, statuses.count("failed")) == (1, 3)
    assert statuses.count("planned" if "--dry-run" in options else "separated") == 1
    root = f"{tmp_path}/" if "--workers" in options else ""
    for row, (name, line) in enumerate(
        zip(("none.jpg", "folder", "empty.jpg"), error_lines(err), strict=True), 3
    ):
        place = f"line {row} of {root}list.csv: "
        path = f"{root}scans/{name}"
        starts = {f"error: {place}{path} ", f"error: {path}: {place}"}
        assert any(line.startswith(start) for start in starts)


@pytest.mark.parametrize("options", [[], ["--workers", "1"], ["--dry-run"]])
@pytest.mark.parametrize("output", ["file/out", "/proc/out"])
def test_an_output_folder_that_cannot_be_created_is_one_error_at_the_start(
    run, tmp_path, output, options
):
    if output == "/proc/out" and sys.platform != "linux":
        pytest.skip("only Linux has this folder, in which nobody can create a folder")
    write(tmp_path, "a.jpg", "b.jpg", "file", data=image_bytes())
    code, out, err = run("a.jpg", "b.jpg", "-o", output, "--json", *options)
    (message,) = error_lines(err)
    assert (code, out) == (1, b"")
    reason = "Not a directory" if output == "file/out" else "No such file or directory"
    assert f"{output} was not written ({reason}); expected " in message


def test_json_has_the_result_of_each_photo(run, tmp_path, model):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    (tmp_path / "b.jpg").write_bytes(b"")
    code, out, err = run(".", "--json", "--quiet")
    separated, failed = json_lines(out)
    assert code == 1
    assert len(err.splitlines()) == 1
    assert (
        set(separated)
        == set(failed)
        == {field.name for field in fields(FileResult)} - {"exception"}
    )
    assert separated["outputs"] == {layer: f"a.{layer}.jpg" for layer in LAYERS}
    found = [separated[key] for key in ("source", "status", "model", "error")]
    assert found == ["a.jpg", "separated", "pane", None]
    assert len(separated["model_sha256"]) == 64
    assert separated["device"]
    assert set(separated["seconds"]) == {"decode", "network", "upsampling", "encode"}
    assert separated["residual"] == pytest.approx(0, abs=0.01)
    assert (failed["source"], failed["status"], failed["outputs"]) == ("b.jpg", "failed", {})
    assert failed["error"]


def test_quiet_prints_nothing_if_no_photo_fails(run, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    assert run("a.jpg", "--quiet") == run("a.jpg", "--quiet") == (0, b"", "")


def test_a_photo_above_the_pixel_limit_is_rejected_and_one_at_the_limit_is_not(run, tmp_path):
    (tmp_path / "large.jpg").write_bytes(image_bytes(61, 40))
    (tmp_path / "small.jpg").write_bytes(image_bytes(60, 40))
    code, _, err = run("large.jpg", "small.jpg", "--max-pixels", 2400, "-o", "out")
    assert code == 1
    assert len(error_lines(err)) == 1
    assert "large.jpg" in error_lines(err)[0]
    assert list_files(tmp_path / "out") == layer_files("small")
