from pathlib import Path

import numpy as np
import pytest
import torch

from brewster.photo import Photo
from brewster.training.data.data_recipe import DataRecipe
from brewster.training.data.image_loading import read_maps, read_photos, source_weights
from brewster.training.data.rendered import RenderedDatasets
from brewster.training.recipe import read_recipe
from brewster.training.streams import open_stream, validation_pairs
from cli_helpers import image_bytes
from set_folders import render_set
from training_helpers import same

TINY = Path(__file__).parents[1] / "recipes/ablations/tiny.toml"


@pytest.fixture
def recipe():
    return read_recipe(TINY)


@pytest.fixture
def root(tmp_path, monkeypatch):
    """A data folder with photos, pairs and an empty folder."""
    for name in ("photos", "real/blended", "real/transmission", "empty/blended"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("photos/a.jpg", "real/blended/a.jpg", "real/transmission/a.jpg"):
        (tmp_path / name).write_bytes(image_bytes())
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path))
    return tmp_path


def with_data(recipe, **data):
    return recipe.model_copy(update={"data": DataRecipe.model_validate(data)})


def test_datasets_have_a_path_in_the_data_folder_or_an_absolute_path(recipe, root):
    render_set(root / "set", count=3)
    below, absolute = (
        open_stream(with_data(recipe, rendered={"datasets": [folder], "count": 2}))
        for folder in ("set", root / "set")
    )
    assert isinstance(below, RenderedDatasets)
    assert len(below) == 2
    assert same(below(3, 2, 32), absolute(3, 2, 32))


def test_each_batch_is_divided_by_the_shares(recipe, root):
    render_set(root / "set", count=2)
    data = {
        "photos": ["photos"],
        "pairs": ["real"],
        "rendered": {"datasets": ["set"], "share": 0.25},
    }
    stream = open_stream(with_data(recipe, **data, pairs_share=0.5))
    batch = stream(0, 8, 32)
    assert batch.photo_encoded.shape == (8, 3, 32, 32)
    assert (batch.reflection_weight < 1).tolist() == 4 * [True] + 4 * [False]
    rendered = open_stream(with_data(recipe, rendered={"datasets": ["set"]}))(0, 1, 32)
    assert torch.equal(batch.photo_encoded[4:5], rendered.photo_encoded)
    mixtures = open_stream(with_data(recipe, photos=["photos"]))(0, 3, 32)
    assert torch.equal(batch.photo_encoded[5:], mixtures.photo_encoded)


def test_data_without_a_share_is_not_read(recipe, root):
    gone = {"pairs": ["gone"], "pairs_share": 0.0, "rendered": {"datasets": ["gone"], "share": 0.0}}
    only = open_stream(with_data(recipe, photos=["photos"]))
    assert same(open_stream(with_data(recipe, photos=["photos"], **gone))(0, 2, 32), only(0, 2, 32))


def test_the_total_weight_of_a_source_is_the_power_two_thirds_of_its_number_of_photos(recipe, root):
    for name in ("many_1", "many_2", "many_3", "many_4", "few-1"):
        black = Photo.from_array(np.zeros((8, 8, 3), np.uint8), encoding="srgb")
        black.save(root / "sources" / f"{name}.png")
    assert source_weights([root / "sources"]) == pytest.approx([1, *4 * [4 ** (-1 / 3)]])
    assert source_weights([root / "sources"], ["few*"]) == pytest.approx(4 * [4 ** (-1 / 3)])


def test_pairs_to_validate_on_are_evenly_spaced_in_order_of_name(recipe, root):
    for number in range(7):
        grey = np.full((8, 8, 3), 30 * number, np.uint8)
        for role in ("blended", "transmission"):
            Photo.from_array(grey, encoding="srgb").save(root / "many" / role / f"{number}.png")
    data = recipe.data.model_copy(
        update={"validate_on": (Path("many"),), "max_validation_pairs": 3}
    )
    seen = [int(photo[0, 0, 0]) // 30 for photo, _ in validation_pairs(data)["many"]]
    assert seen == [0, 2, 4]


def test_large_photos_and_maps_are_reduced_and_small_ones_are_not(tmp_path):
    for size in ((1100, 50), (40, 30)):
        (tmp_path / f"{size[0]}.png").write_bytes(image_bytes(*size, "png"))
    for height in (520, 8):
        light = Photo.from_array(np.ones((height, 2 * height, 3), np.float32), encoding="linear")
        light.save(tmp_path / f"{height}.hdr")
    assert [tuple(photo.shape) for photo in read_photos([tmp_path])] == [(47, 1024, 3), (30, 40, 3)]
    assert [tuple(light.shape) for light in read_maps([tmp_path])] == [(3, 512, 1024), (3, 8, 16)]
