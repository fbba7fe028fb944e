"""Import paths of the last version work for one version more, with a warning that names the new
ones.
"""

import importlib

import pytest

MOVED = {
    "brewster.burst": ("brewster.film", ["separate_burst", "fit_burst", "read_video", "BurstReport",
                                         "separate_video", "VideoSeparation"]),
    "brewster.inference": ("brewster.separation", ["Separator", "Separation", "QUALITIES"]),
    "brewster.inference.predictor": ("brewster.separation.predictor", ["Predictor", "Prediction"]),
    "brewster.srgb": ("brewster.photo.srgb", ["to_linear", "to_encoded"]),
}  # fmt: skip


@pytest.mark.parametrize("old", MOVED)
def test_an_old_path_is_the_same_object_with_a_warning(old):
    new, names = MOVED[old]
    for name in names:
        with pytest.warns(DeprecationWarning, match=rf"{new}\.{name} now") as warnings:
            found = getattr(importlib.import_module(old), name)
        assert found is getattr(importlib.import_module(new), name)
        assert warnings[0].filename == __file__  # that of the caller


@pytest.mark.parametrize("old", MOVED)
def test_an_old_path_has_no_other_names(old):
    with pytest.raises(AttributeError, match="nonsuch"):
        _ = importlib.import_module(old).nonsuch
    with pytest.raises(ImportError):
        importlib.import_module(f"{old}.nonsuch")
