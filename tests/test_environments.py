"""The built-in environments do not change, so that a dataset can be rendered again from them."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from brewster.photo import Photo

FOLDER = Path(__file__).parent / "environments"


@pytest.fixture(scope="module")
def made():
    spec = importlib.util.spec_from_file_location("make_environments", FOLDER / "make.py")
    make = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make)
    return dict(make.pictures())


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.png")), ids=lambda path: path.stem)
def test_an_environment_equals_its_reference_image_up_to_rounding(made, path):
    """Processors round differently: one texel in a hundred may show another surface. All others differ by at most one level."""
    reference, now = Photo.open(path).pixels.astype(int), made[path.stem].astype(int)
    apart = np.abs(reference - now).max(axis=2)
    assert (apart > 1).mean() < 0.01


def test_every_environment_has_a_reference_image(made):
    assert made.keys() == {path.stem for path in FOLDER.glob("*.png")}
