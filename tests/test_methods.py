"""Each prediction is paired with exactly one case, by name."""

import unicodedata
from dataclasses import replace

import numpy as np
import pytest
import pyvips

from benchmark_folders import picture, repacked, write
from brewster import Photo
from brewster.errors import BrewsterError, PhotoError
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.evaluation.methods import ModelMethod, PredictionFolder, check_names
from brewster.photo import FileInfo


@pytest.fixture
def cases(tmp_path):
    repacked(tmp_path / "real20", ["1", "2", "ä"])
    (benchmark,) = read_benchmark("real20", tmp_path / "real20")
    return benchmark.cases


@pytest.fixture
def case(cases):
    return cases[0]


def write_predictions(tmp_path, *paths):
    """Writes images into a folder; returns the folder as a method."""
    write(tmp_path / "theirs", *paths)
    return PredictionFolder("theirs", tmp_path / "theirs")


PREDICTION_PATHS = (
    "1.png 1.jpg 1.transmission.png real20/1.png transmission/1.png transmission_layer/1.JPG "
    "blended/1.transmission.png real20/blended/1.transmission.jpg 1/theirs_t.png "
    "real20/1/dsrnet_l.png transmission/real20/1.png 1/transmission.png "
    "real20/1/transmission_layer.png"
)


@pytest.mark.parametrize("path", PREDICTION_PATHS.split())
def test_a_prediction_is_found_under_every_name_that_is_documented(path, case, tmp_path):
    (found,) = write_predictions(tmp_path, path).files(case).values()
    assert found == tmp_path / "theirs" / path


def test_a_reflection_is_found_in_addition(case, tmp_path):
    both = write_predictions(
        tmp_path, "1/x_t.png", "1/x_r.png", "1/m_input.png", "1/t_label.png"
    ).files(case)
    names = {layer: path.name for layer, path in both.items()}
    assert names == {"transmission": "x_t.png", "reflection": "x_r.png"}
    both = write_predictions(tmp_path / "more", "1.transmission.png", "1.reflection.png").files(
        case
    )
    assert both["reflection"].name == "1.reflection.png"


@pytest.mark.parametrize("path", ["10.png", "01.png", "1_.png", "1.txt", ".1.png", "x1.png"])
def test_a_similar_name_is_not_a_prediction(path, case, tmp_path):
    with pytest.raises(PhotoError, match="no prediction for real20/1"):
        write_predictions(tmp_path, path).files(case)


def test_two_files_for_one_case_are_an_error_that_names_both(case, tmp_path):
    with pytest.raises(PhotoError, match=r"2 files for the transmission.*1\.jpg, 1\.png"):
        write_predictions(tmp_path, "1.png", "1.jpg").files(case)


def test_names_in_both_unicode_forms_are_equal(cases, tmp_path):
    decomposed = unicodedata.normalize("NFD", "ä")
    assert write_predictions(tmp_path, f"{decomposed}.png").files(cases[2])


def test_one_image_cannot_be_the_prediction_for_two_cases(cases, tmp_path):
    repacked(tmp_path / "nature20", ["1"])
    (other,) = read_benchmark("nature20", tmp_path / "nature20")
    theirs = write_predictions(tmp_path, "1.png", "2.png")
    theirs.check_pairing(cases)
    with pytest.raises(PhotoError, match="matches two cases, real20/1 and nature20/1"):
        theirs.check_pairing([*cases, *other.cases])
    unambiguous = write_predictions(tmp_path / "sorted", "real20/1.png", "nature20/1.png")
    unambiguous.check_pairing([*cases, *other.cases])


def test_a_folder_without_a_matching_name_is_an_error_before_scoring(cases, tmp_path):
    with pytest.raises(PhotoError, match="has the name of a case"):
        write_predictions(tmp_path, "a.png", "b.png").check_pairing(cases)
    with pytest.raises(PhotoError, match="is not a folder"):
        PredictionFolder("theirs", tmp_path / "nowhere").check_pairing(cases)


def test_images_without_a_case_are_counted(cases, tmp_path):
    assert (
        write_predictions(tmp_path, "1.png", "other.png", "another.png").count_unmatched(cases) == 2
    )


def test_a_model_stores_its_prediction(case, model, tmp_path):
    ours = ModelMethod("pane", str(model), tmp_path / "predictions")
    assert ours.cached(case) is None
    photo = Photo.open(case.photo.read())
    prediction = ours.predict(case, photo)
    assert prediction.seconds > 0
    stored = ours.cached(case)
    assert np.array_equal(stored.transmission.srgb_8bit(), prediction.transmission.srgb_8bit())
    assert np.array_equal(stored.reflection.srgb_8bit(), prediction.reflection.srgb_8bit())
    files = PredictionFolder("again", tmp_path / "predictions").files(case)
    assert files.keys() == {"transmission", "reflection"}


def test_the_stored_layers_of_a_16_bit_wide_gamut_photo_are_scored(case, model, tmp_path):
    pixels = np.random.default_rng(1).integers(0, 1 << 16, (6, 8, 3), np.uint16)
    photo = Photo(pixels, None, FileInfo(bits=16, icc=bytes(pyvips.Image.profile_load("p3"))))
    ours = ModelMethod("pane", str(model), tmp_path / "predictions")
    prediction = ours.predict(case, photo)
    stored = ours.cached(case)
    assert np.array_equal(stored.transmission.srgb_8bit(), prediction.transmission.srgb_8bit())


def test_a_key_changes_with_the_model_the_quality_and_the_files(case, model, tmp_path):
    (tmp_path / "other.onnx").write_bytes(model.read_bytes() + b"other")
    plain, draft = (
        ModelMethod("pane", str(model), tmp_path, quality=name) for name in ("standard", "draft")
    )
    other = ModelMethod("pane", str(tmp_path / "other.onnx"), tmp_path)
    assert len({method.key(case) for method in (plain, draft, other)}) == 3
    theirs = write_predictions(tmp_path, "1.png")
    before = theirs.key(case)
    write(tmp_path / "theirs", "1.png", data=picture((8, 7), "png"))
    assert PredictionFolder("theirs", tmp_path / "theirs").key(case) != before


@pytest.mark.parametrize("name", ["../out", "a/b", "a\\b", "..", ".", "", "two\nlines", "\udcff"])
def test_names_that_are_not_valid_for_folders_are_an_error(name, tmp_path):
    with pytest.raises(BrewsterError, match="expected a valid folder name"):
        check_names([PredictionFolder(name, tmp_path)])


def test_folders_and_broken_links_with_names_of_images_are_ignored(cases, tmp_path):
    theirs = write_predictions(tmp_path, "2.png")
    (tmp_path / "theirs" / "1.png").mkdir()
    (tmp_path / "theirs" / "3.png").symlink_to("nowhere")
    assert theirs.count_unmatched(cases) == 0
    assert "no prediction" in theirs.key(cases[0])


def test_a_burst_method_keys_on_the_frames_and_passes_them_on(case, model, tmp_path, monkeypatch):
    burst = ModelMethod("pane burst", str(model), tmp_path, burst=True)
    frames = (case.photo, case.ground_truth)
    assert burst.key(case) == ModelMethod("pane", str(model), tmp_path).key(case)
    assert burst.key(replace(case, frames=frames)) != burst.key(replace(case, frames=frames[:1]))
    photo = Photo.open(case.photo.read())
    passed = []

    def record(photos, *, separator, quality):
        passed.extend(photos)
        return separator(photos[0], quality=quality)

    monkeypatch.setattr("brewster.film.separate_burst", record)
    burst.predict(replace(case, frames=frames), photo)
    assert [frame.size for frame in passed] == [photo.size] * 2
