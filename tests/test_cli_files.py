"""Files of the command line: names in other forms, suffixes, RAW, videos, hints, contact sheets,
and completion.
"""

import nturl2path
import os
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from click.shell_completion import ShellComplete

from benchmark_folders import write
from brewster import Photo
from brewster.base.remote_path import location
from brewster.cli import batch_plan, cli
from brewster.photo import contact_sheet
from cli_helpers import error_lines, image_bytes, layer_files, list_files
from motion_photos import small_film
from picture_files import dng_file, mosaic


@pytest.mark.parametrize("form", ["file://{}", "file://localhost{}", "'{}'", '"{}"', "'file://{}'"])
def test_an_address_and_a_quoted_path_name_a_file(run, tmp_path, form):
    (tmp_path / "a b#%.jpg").write_bytes(image_bytes())
    path = str(tmp_path / "a b#%.jpg")
    escaped = path.replace("%", "%25").replace(" ", "%20").replace("#", "%23")
    assert run(form.format(escaped if "file:" in form else path))[0] == 0
    assert set(layer_files("a b#%")) < set(list_files(tmp_path))


def test_an_existing_file_keeps_its_name_even_if_it_has_quotes(tmp_path, monkeypatch):
    (tmp_path / "'a.jpg'").write_bytes(image_bytes())
    monkeypatch.chdir(tmp_path)
    assert batch_plan.local_path("'a.jpg'") == "'a.jpg'"
    assert batch_plan.local_path("'b.jpg'") == "b.jpg"


@pytest.mark.parametrize(
    ("address", "path"),
    [
        ("file:///C:/Users/A%20B/window.jpg", r"C:\Users\A B\window.jpg"),
        ("file://localhost/D:/a.jpg", r"D:\a.jpg"),
        ("file://server/share/a.jpg", r"\\server\share\a.jpg"),
    ],
)
def test_addresses_of_windows_become_its_paths(address, path, monkeypatch):
    monkeypatch.setattr(urllib.request, "url2pathname", nturl2path.url2pathname)
    monkeypatch.setattr(sys, "platform", "win32")
    assert batch_plan.local_path(address).removeprefix("\\\\?\\") == path


@pytest.mark.parametrize("address", ["https://example.org/a.jpg", "file://host/a.jpg"])
@pytest.mark.parametrize("options", [[], ["--workers", "2"], ["-o", "clear.jpg"]])
def test_an_address_of_another_machine_is_refused(run, tmp_path, address, options):
    code, _, err = run(address, *options)
    (line,) = error_lines(err)
    assert code == 1
    assert line.startswith(f"error: {address} is ")
    assert line.count("; ") == 2
    assert list_files(tmp_path) == []


@pytest.mark.parametrize("name", ["notes", "notes.txt", "notes.jpg/"])
@pytest.mark.parametrize("photos", [["a.jpg"], ["a.jpg", "b.jpg"], ["."]])
def test_an_output_folder_that_is_a_file_is_refused(run_without_model, tmp_path, name, photos):
    write(tmp_path, "a.jpg", "b.jpg", name.strip("/"), data=image_bytes())
    code, _, err = run_without_model(*photos, "-o", name, "--overwrite")
    assert code == 2
    message = " ".join(err.split())
    assert (
        f"-o is the existing file {name}; expected a folder, or an image file such as clear.jpg"
        in message
    )


@pytest.mark.parametrize("name", ["clear.bmp/", "new.png/", "2026.11", "made"])
def test_a_folder_may_have_a_dot_in_its_name(run, tmp_path, name):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    assert run("a.jpg", "-o", name)[0] == 0
    assert list_files(tmp_path / name) == layer_files("a")


def test_raw_files_without_the_extra_are_counted_and_named_once(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    for name in ("a.dng", "b.dng", "c.dng"):
        (tmp_path / name).write_bytes(dng_file(mosaic()))
    (tmp_path / "d.jpg").write_bytes(image_bytes())
    code, _, err = run(".")
    assert code == 1
    (line,) = error_lines(err)
    assert "3 photos (a.dng, b.dng, c.dng): the rawpy package is not installed" in line
    assert "pip install -c constraints.txt -e '.[raw]'" in line
    assert "1 separated, 3 failed" in err


def test_other_files_in_a_folder_are_counted_by_suffix_with_an_example(run, tmp_path):
    names = (
        "a.jpg",
        "a.mask.png",
        "b/scan",
        "b/x.BMP",
        "b/y.bmp",
        "notes.txt",
        ".hidden",
        ".folder/c.bmp",
    )
    write(tmp_path, *names, data=image_bytes())
    for _ in range(2):  # layers are not counted
        code, _, err = run(".")
        assert code == 0
        assert (
            "4 other files skipped (2 .bmp, 1 without a suffix, 1 .txt), for example b/scan" in err
        )
    assert run(".", "--quiet")[2] == ""
    code, _, err = run("b/scan")  # named files are read by their content
    assert (code, "skipped (" in err) == (0, False)
    assert (tmp_path / "b/scan.transmission.jpg").is_file()


def test_a_hint_names_the_other_options_of_existing_layers(run, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    run("a.jpg", "--strength", "0.5")
    err = run("a.jpg")[2]
    assert "made with other options (strength=0.5) (--overwrite replaces them)" in err
    assert "other options" not in run("a.jpg", "--strength", "0.5")[2]
    assert "(quality=standard)" in run("a.jpg", "--strength", "0.5", "--quality", "draft")[2]
    Photo.from_array(np.full((40, 60, 3), 128, np.uint8), encoding="srgb").save(
        tmp_path / "mask.png"
    )
    run("a.jpg", "--mask", "mask.png", "--overwrite")
    assert "perhaps made with another mask or other hints" in run("a.jpg", "--mask", "mask.png")[2]
    run("a.jpg", "--strength", "0.5", "--overwrite")
    assert (
        "model=pane" in run("a.jpg", "--strength", "0.5", "--model", "compact", with_model=False)[2]
    )
    (tmp_path / "mask.png").write_bytes(image_bytes())
    assert "(mask=no)" in run("a.jpg", "--strength", "0.5", "--mask", "mask.png")[2]


def test_what_belongs_to_a_photo_is_neither_separated_nor_counted(run_without_model, tmp_path):
    """The films of phones, also those of Google Takeout, and the edits of Apple."""
    write(tmp_path, "PXL_1.MP.jpg", "PXL_2.jpg", "IMG_3.jpg", "IMG_4.JPG", data=image_bytes())
    film = small_film(tmp_path / "IMG_3.MOV")
    write(tmp_path, "PXL_1.MP", "PXL_2.MP", "IMG_4.mov", data=film)
    write(tmp_path, "IMG_3.AAE", "notes.txt", "PXL_1.txt", data=b"text")
    code, out, err = run_without_model(".", "--dry-run")
    assert code == 0, err
    planned = [line.partition(b" -> ")[0].decode() for line in out.splitlines()]
    assert planned == ["IMG_3.jpg", "IMG_4.JPG", "PXL_1.MP.jpg", "PXL_2.jpg"]
    assert "2 other files skipped (2 .txt)" in err


def test_a_contact_sheet_has_a_row_for_each_photo(run, tmp_path):
    write(tmp_path, "a.jpg", "b.jpg", data=image_bytes())
    (tmp_path / "c.jpg").write_bytes(b"")
    code, _, err = run("a.jpg", "b.jpg", "c.jpg", "--contact-sheet", "sheet.png")
    assert code == 1
    assert "contact sheet: sheet.png" in err
    sheet = Photo.open(tmp_path / "sheet.png").pixels
    assert sheet.shape == (2 * 272, 3 * 60 + 2 * 8, 3)
    photo = Photo.open(tmp_path / "a.jpg")
    assert np.abs(sheet[:40, :60].astype(int) - photo.srgb_8bit()).max() <= 1
    transmission = Photo.open(tmp_path / "a.transmission.jpg")
    assert np.abs(sheet[272:312, 68:128].astype(int) - transmission.srgb_8bit()).max() <= 1
    assert sheet[240:264].min() < 100  # the file name
    assert run("a.jpg", "--contact-sheet", "sheet.png")[0] == 0  # of photos that are skipped, too
    assert Photo.open(tmp_path / "sheet.png").size[1] == 272


def test_a_contact_sheet_replaces_only_contact_sheets_and_never_the_mask(run, tmp_path):
    write(tmp_path, "a.jpg", "other.jpg", data=image_bytes())
    write(tmp_path, "mask.png", data=image_bytes(format_name="png"))
    before = {name: (tmp_path / name).read_bytes() for name in list_files(tmp_path)}
    for sheet in ("a.jpg", "a.transmission.jpg", "other.jpg", "a.jpg/sheet.png"):
        code, _, err = run("a.jpg", "--contact-sheet", sheet)
        assert (code, sheet in err) == (2, True)
    assert run("a.jpg", "--mask", "mask.png", "--contact-sheet", "mask.png", "--overwrite")[0] == 2
    assert {name: (tmp_path / name).read_bytes() for name in list_files(tmp_path)} == before
    assert run("a.jpg", "--contact-sheet", "other.jpg", "--overwrite")[0] == 0
    assert contact_sheet.is_contact_sheet(tmp_path / "other.jpg")


def test_a_contact_sheet_shows_photos_and_layers_of_an_object_store(run, tmp_path, store):
    folder = location(f"memory://{tmp_path.name}")
    (folder / "a.jpg").write_bytes(image_bytes())
    code, _, err = run(str(folder), "-o", str(folder / "out"), "--contact-sheet", "sheet.png")
    assert code == 0, err
    assert Photo.open(tmp_path / "sheet.png").size[1] == 272


def test_many_rows_give_several_sheets(tmp_path, monkeypatch):
    monkeypatch.setattr(contact_sheet, "_MAX_ROWS", 2)
    (tmp_path / "<a&>.jpg").write_bytes(image_bytes())
    rows = [("<a&>.jpg", [tmp_path / "<a&>.jpg"])] * 5
    sheets = list(contact_sheet.write_contact_sheets(tmp_path / "s.jpg", rows, 10**6))
    assert [path.name for path in sheets] == ["s.jpg", "s-2.jpg", "s-3.jpg"]
    assert [Photo.open(path).size[1] // 272 for path in sheets] == [2, 2, 1]


def completions(*words):
    """Returns the types and values that the shell offers for the last of these words."""
    *before, last = words
    items = ShellComplete(cli, {}, "brewster", "_BREWSTER_COMPLETE").get_completions(
        list(before), last
    )
    return {(item.type, item.value) for item in items}


def test_completion_offers_models_layers_and_formats():
    assert {("plain", "compact"), ("file", "comp")} <= completions("a.jpg", "--model", "comp")
    assert completions("a.jpg", "--layers", "transmission,c") == {
        ("plain", "transmission,confidence")
    }
    assert ("plain", "reflection") in completions("a.jpg", "--layers", "")
    assert ("plain", "tiff") in completions("a.jpg", "--format", "t")


def test_on_a_system_without_fonts_the_captions_of_a_contact_sheet_have_letters():
    """Without a font, all letters are boxes of one width. fontconfig is configured once in a
    process.
    """
    script = """
import pyvips
from pathlib import Path
from brewster.photo import contact_sheet
contact_sheet._SYSTEM_FONTS = Path("/nonexistent")
list(contact_sheet.write_contact_sheets(Path("unused.jpg"), [], 1))
print(pyvips.Image.text("mmmm").width > 2 * pyvips.Image.text("iiii").width)
"""
    environment = {name: value for name, value in os.environ.items() if name != "FONTCONFIG_FILE"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "True\n"
    assert "Fontconfig" not in done.stderr


def test_videos_are_counted_and_named(run, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    for name in ("b.mp4", "c.MOV"):
        (tmp_path / name).write_bytes(b"\0\0\0\x18ftypisom" + bytes(100))
    code, _, err = run(".")
    assert code == 0
    assert "2 videos (b.mp4, c.MOV) skipped: use `brewster burst`" in err
    code, _, err = run("b.mp4")
    assert code == 1
    assert error_lines(err)[0].startswith("error: b.mp4 cannot be read as a video")
