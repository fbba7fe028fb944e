"""The zip files for the NTIRE 2026 contest."""

import io
import zipfile

import numpy as np
import pytest

from benchmark_folders import paint
from brewster import Photo
from brewster.benchmarks.registry import read_benchmark
from brewster.errors import PhotoError
from brewster.evaluate.methods import IdentityBaseline, ModelMethod, PredictionFolder
from brewster.evaluate.submission import export_ntire2026


@pytest.fixture
def openrr(tmp_path):
    for name, split in (("1", "val_2"), ("2", "val_2"), ("3", "train_1")):
        paint(tmp_path / "OpenRR-5k" / f"{split}_blended" / f"{name}.jpg", int(name), noise=20)
        paint(tmp_path / "OpenRR-5k" / f"{split}_transmission" / f"{name}.jpg", int(name))
    paint(tmp_path / "OpenRR-5k" / "test_1_blended" / "7.jpg", 7)
    return tmp_path / "OpenRR-5k"


def test_the_layout_of_the_contest_is_read_without_its_other_photos(openrr):
    (part,) = read_benchmark("openrr", openrr)
    assert [case.name for case in part.cases] == ["1", "2"]
    assert not part.excluded


def test_each_zip_has_a_jpeg_with_the_name_of_each_photo(openrr, tmp_path):
    paths = export_ntire2026(openrr, IdentityBaseline(), tmp_path / "out")
    assert [path.name for path in paths] == ["test_1_output.zip", "val_2_output.zip"]
    with zipfile.ZipFile(paths[1]) as archive:
        assert archive.namelist() == ["1.jpg", "2.jpg"]
        packed = Photo.open(archive.read("2.jpg"))
    photo = Photo.open(openrr / "val_2_blended" / "2.jpg")
    assert packed.file_info.format_name == "jpeg"
    assert abs(packed.srgb_8bit().astype(int) - photo.srgb_8bit()).max() <= 3
    again = export_ntire2026(openrr, IdentityBaseline(), tmp_path / "again")
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in paths]


def test_a_stored_prediction_of_another_size_is_not_packed(openrr, tmp_path, model):
    method = ModelMethod("pane", str(model), tmp_path / "stored")
    (part,) = read_benchmark("openrr", openrr)
    photo = Photo.open(openrr / "val_2_blended" / "1.jpg")
    method.predict(part.cases[0], Photo.from_array(photo.srgb_8bit()[:8, :8], encoding="srgb"))
    (_, path) = export_ntire2026(openrr, method, tmp_path / "out")
    with zipfile.ZipFile(path) as archive:
        assert Photo.open(archive.read("1.jpg")).size == photo.size


def test_predictions_of_a_folder_are_packed(openrr, tmp_path):
    for name in ("1", "2", "7"):
        Photo.from_array(np.full((16, 24, 3), 77, np.uint8), encoding="srgb").save(
            tmp_path / "theirs" / f"{name}.png"
        )
    paths = export_ntire2026(openrr, PredictionFolder("theirs", tmp_path / "theirs"), tmp_path / "out")
    with zipfile.ZipFile(io.BytesIO(paths[0].read_bytes())) as archive:
        assert (abs(Photo.open(archive.read("7.jpg")).pixels.astype(int) - 77) <= 1).all()


def test_a_missing_prediction_and_another_layout_are_errors(openrr, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(PhotoError, match="no prediction for openrr"):
        export_ntire2026(openrr, PredictionFolder("none", tmp_path / "empty"), tmp_path / "out")
    with pytest.raises(PhotoError, match="no folder such as val_300_blended"):
        export_ntire2026(tmp_path / "empty", IdentityBaseline(), tmp_path / "out")
