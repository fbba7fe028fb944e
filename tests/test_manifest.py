"""Manifests: tables of paths, and files that are not such tables."""

from pathlib import Path

import pyarrow
import pytest
from pyarrow import parquet

from brewster.base.remote_path import location
from brewster.batch import plan_files
from brewster.batch.manifest import read_manifest
from brewster.errors import BrewsterError, ManifestError
from cli_helpers import image_bytes


def write_manifest(path, *rows, column="path"):
    """Writes a table in the format of the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".csv":
        lines = [f"{column},year", *(f'"{row}",1987' for row in rows)]
        path.write_text("\n".join(lines), encoding="utf-8-sig")
    else:
        parquet.write_table(pyarrow.table({"year": [1987] * len(rows), column: list(rows)}), path)
    return path


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".CSV"])
def test_relative_paths_absolute_paths_and_urls_are_mirrored_below_the_output(tmp_path, suffix):
    rows = [
        "box, 4/./a.jpg",
        "/scans/b.tif",
        "memory://bucket/1987/c.jpg",
        "d.jpg",
        "/x/../../y/e.jpg",
    ]
    manifest = write_manifest(tmp_path / f"list{suffix.lower()}", *rows)
    manifest = manifest.rename(tmp_path / f"list{suffix}")
    assert [(photo, folder) for _, photo, folder in read_manifest(manifest, Path("out"))] == [
        (tmp_path / "box, 4/a.jpg", Path("out/box, 4")),
        (Path("/scans/b.tif"), Path("out/scans")),
        (location("memory://bucket/1987/c.jpg"), Path("out/bucket/1987")),
        (tmp_path / "d.jpg", Path("out")),
        (Path("/x/../../y/e.jpg"), Path("out/y")),
    ]
    assert all(folder == photo.parent for _, photo, folder in read_manifest(manifest))


def test_a_batch_accepts_manifests_and_missing_photos_are_tasks_too(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("a.jpg", "a.png", "unlisted.jpg"):
        (tmp_path / "in" / name).write_bytes(image_bytes())
    manifest = write_manifest(tmp_path / "list.parquet", "in/missing.jpg", "in/a.png", "in/a.png")
    tasks = plan_files(manifest, tmp_path / "out")
    assert [Path(task.name).name for task in tasks] == ["missing.jpg", "a.png"]
    assert tasks[1].outputs["transmission"] == tmp_path / "out/in/a.transmission.png"


def test_a_photo_that_is_listed_twice_has_the_first_of_its_rows(tmp_path):
    write_manifest(tmp_path / "list.csv", "b.jpg", "in/../a.jpg", tmp_path / "b.jpg", "a.jpg")
    tasks = plan_files(tmp_path / "list.csv")
    assert [(Path(task.name).name, task.row.number) for task in tasks] == [
        ("b.jpg", 2),
        ("a.jpg", 3),
    ]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_manifest_without_rows_is_refused(tmp_path, suffix):
    manifest = write_manifest(tmp_path / f"empty{suffix}")
    with pytest.raises(ManifestError, match="has only the names of its columns, and no rows"):
        plan_files(manifest)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("quote", ["", '"'])
def test_the_values_of_a_csv_table_are_separated_by_commas_semicolons_or_tabs(
    tmp_path, delimiter, quote
):
    rows = [("year", "path"), ("1987", "a.jpg"), ("1988", "b.jpg")]
    lines = [delimiter.join(f"{quote}{value}{quote}" for value in row) for row in rows]
    manifest = tmp_path / "list.csv"
    manifest.write_text("\r\n".join(lines), newline="")
    assert [photo.name for _, photo, _ in read_manifest(manifest)] == ["a.jpg", "b.jpg"]


def test_the_column_path_decides_which_character_separates_the_values(tmp_path):
    manifest = tmp_path / "list.csv"
    manifest.write_text('path;"notes, and more, and more"\na,b.jpg;\n')
    assert [photo.name for _, photo, _ in read_manifest(manifest)] == ["a,b.jpg"]
    manifest.write_text("file;year\na.jpg;1987\n")
    with pytest.raises(ManifestError, match="has the columns 'file', 'year'; expected"):
        plan_files(manifest)
    manifest.write_text("path\na,b.jpg\n")
    with pytest.raises(ManifestError, match=r"line 2 of .* has more values"):
        plan_files(manifest)


def test_rows_that_are_not_paths_below_the_manifest_are_refused(tmp_path):
    for rows, message in [
        (["a.jpg", None], "row 2 of .* has the path None"),
        ([" "], "row 1 of .* has the path ' '"),
        (["../a.jpg"], "outside the folder of the manifest"),
        (["b/../../a.jpg"], "outside the folder of the manifest"),
        ([7], "row 1 of .* has the path 7"),
    ]:
        with pytest.raises(ManifestError, match=message):
            plan_files(write_manifest(tmp_path / "list.parquet", *rows))
    with pytest.raises(
        BrewsterError, match=r"line 3 of .*: https://x\.org/a\.jpg is a web address"
    ):
        plan_files(write_manifest(tmp_path / "list.csv", "a.jpg", "https://x.org/a.jpg"))
    short = tmp_path / "short.csv"
    short.write_text("year,path\n1987\n")
    with pytest.raises(ManifestError, match=r"line 2 of .* has the path None"):
        plan_files(short)


def test_blank_lines_are_skipped_and_rows_are_numbered_by_the_lines_of_the_file(tmp_path):
    manifest = tmp_path / "list.csv"
    manifest.write_text("path,notes\n\na.jpg,\n\r\n\nb.jpg,1987\n\n")
    rows = [(str(row), photo.name) for row, photo, _ in read_manifest(manifest)]
    assert rows == [(f"line 3 of {manifest}", "a.jpg"), (f"line 6 of {manifest}", "b.jpg")]
    assert [str(task.row) for task in plan_files(manifest)] == [row for row, _ in rows]
    manifest.write_text("path,notes\n\n,no path\n")
    with pytest.raises(ManifestError, match=r"line 3 of .* has the path ''"):
        plan_files(manifest)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_csv_table_in_another_encoding_must_be_saved_as_utf_8(tmp_path, encoding):
    manifest = tmp_path / "list.csv"
    manifest.write_text(
        "path\nM\N{LATIN SMALL LETTER U WITH DIAERESIS}nchen.jpg\n", encoding=encoding
    )
    with pytest.raises(
        ManifestError, match=r"is not a table \('utf-8' codec .*save the file as UTF-8"
    ):
        plan_files(manifest)
