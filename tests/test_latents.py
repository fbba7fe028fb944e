"""Training samples of a diffusion backbone: panels, encoding and the choice of samples."""

import numpy as np
import pytest
import torch

from brewster.diffusion.backbones.registry import tiny
from brewster.diffusion.lora.latents import (
    EncodedSampleLoader,
    fit_sample,
    layers_from_pair,
    make_panels,
    open_samples,
)
from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.diffusion.task import split
from brewster.errors import RecipeError
from brewster.photo import Photo
from brewster.render.dataset.store import read_dataset
from brewster.training.data.mixtures import Pairs
from brewster.training.data.sample_rng import SampleRng
from set_folders import render_set

RECIPE = {
    "backbone": "tiny:kontext",
    "max_composite_pixels": 3 * 32 * 16,
    "seed": 1,
    "steps": 6,
    "batch_size": 1,
    "learning_rate": 1e-2,
    "warmup_steps": 2,
    "weight_decay": 1e-4,
    "report_every": 6,
    "checkpoint_every": 2,
}


@pytest.fixture(scope="module")
def backbone():
    return tiny("kontext")[0]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A data folder with a rendered dataset, pairs without reflection, and pairs with
    reflection.
    """
    root = tmp_path_factory.mktemp("data")
    render_set(root / "set", count=3)
    roles = ("blended", "transmission", "reflection")
    noise = np.random.default_rng(1)
    for folder, count in (("pairs", 2), ("triplets", 3)):
        for number, role in enumerate(roles[:count]):
            grey = Photo.from_array(
                np.full((40, 60, 3), 200 - 70 * number, np.uint8), encoding="srgb"
            )
            grey.save(root / folder / role / "a.png")
    for role in roles:
        for name in "abc":
            pixels = noise.integers(0, 256, (32, 48, 3), dtype=np.uint8)
            Photo.from_array(pixels, encoding="srgb").save(root / "large" / role / f"{name}.png")
    return root


@pytest.fixture
def recipe(root, monkeypatch):
    monkeypatch.setenv("BREWSTER_DATA", str(root))
    return lambda data, **changes: LoraRecipe.model_validate(RECIPE | {"data": data} | changes)


RENDERED = {"rendered": {"datasets": ["set"], "target": "transmission"}}


def test_panels_show_the_whole_sample_in_its_aspect_ratio(recipe, root, backbone):
    lora_recipe = recipe(RENDERED)
    samples = open_samples(lora_recipe)
    assert len(samples) == 3
    for number, entry in enumerate(read_dataset(root / "set")):
        fit = fit_sample(samples[number].layers, lora_recipe, backbone.size_divisor)
        panels = make_panels(samples[number].layers, fit)
        assert (fit.content, fit.panel) == ((24, 16), (32, 16))
        for letter, name in zip("ITR", ("photo", "transmission", "reflection"), strict=True):
            image = torch.from_numpy(Photo.open(entry.read(f"{name}.jpg")).pixels.copy())
            whole = (fit.crop(panels[letter])[0].permute(1, 2, 0) + 1) * 127.5
            torch.testing.assert_close(whole, image.float(), atol=0.01, rtol=0)


def test_an_encoded_sample_depends_on_the_rng_alone_and_is_encoded_once(
    recipe, backbone, monkeypatch
):
    lora_recipe = recipe(RENDERED)
    one, other = (
        EncodedSampleLoader(open_samples(lora_recipe), backbone, lora_recipe) for _ in range(2)
    )
    for slot in range(4):
        other(SampleRng(1, 0, slot))
    assert torch.equal(one(SampleRng(1, 7, 0)).composite, other(SampleRng(1, 7, 0)).composite)
    assert one(SampleRng(1, 7, 0)) is one(SampleRng(1, 7, 0))
    grid = one(SampleRng(1, 7, 0)).composite
    assert grid.shape[2:] == (1, 6)
    assert {tuple(panel.shape[2:]) for panel in split(grid, lora_recipe.layout).values()} == {
        (1, 2)
    }


def test_samples_are_mirrored_at_random_unless_the_recipe_disables_it(recipe, backbone):
    counts = []
    for flip in (True, False):
        lora_recipe = recipe(RENDERED, flip=flip)
        latents = EncodedSampleLoader(open_samples(lora_recipe), backbone, lora_recipe)
        counts.append(len({id(latents(SampleRng(1, step, 0))) for step in range(60)}))
    assert counts == [6, 3]


def test_real_pairs_are_drawn_with_the_probability_pairs_share(recipe, root):
    samples = open_samples(recipe({**RENDERED, "pairs": ["triplets"], "pairs_share": 0.25}))
    assert len(samples) == 4
    chosen = [samples.draw_index(SampleRng(1, step, 0)) for step in range(200)]
    assert set(chosen) == {0, 1, 2, 3}
    assert 30 < chosen.count(3) < 70


def test_data_without_a_share_is_not_read(recipe):
    gone = {"datasets": ["gone"]}
    assert len(open_samples(recipe({**RENDERED, "pairs": ["gone"], "pairs_share": 0.0}))) == 3
    assert (
        len(open_samples(recipe({"rendered": gone, "pairs": ["triplets"], "pairs_share": 1.0})))
        == 1
    )


def test_pairs_without_reflections_are_refused_where_r_is_a_panel(recipe):
    pairs = {"pairs": ["pairs"], "pairs_share": 1.0}
    with pytest.raises(RecipeError, match=r"pairs has no reflection for a \(photos without one: 1"):
        open_samples(recipe(pairs))
    assert len(open_samples(recipe(pairs, panels=["I", "T"]))) == 1
    (sample,) = open_samples(recipe(pairs, reflections="difference"))
    assert sample.reflection_weight == Pairs.reflection_weight < 1


def test_a_given_reflection_has_weight_one_and_a_missing_one_is_the_difference_in_light(recipe):
    (given,) = open_samples(recipe({"pairs": ["triplets"], "pairs_share": 1.0}))
    assert given.reflection_weight == 1
    assert [given.layers[0, 0, channel].item() for channel in (0, 3, 6)] == [200, 130, 60]
    both = (torch.full((2, 2, 3), value, dtype=torch.uint8) for value in (188, 137))
    difference = layers_from_pair(*both)[0, 0, 6].item()
    assert difference == 138  # 188 is 1/2 in linear light and 137 is 1/4, so the difference is 1/4


def test_a_small_sample_gets_the_panels_that_it_gets_at_inference(recipe, backbone):
    """The pixel budget is for large rendered samples, and the pairs are smaller than its panels, as
    in the paper.
    """
    mixed = recipe({**RENDERED, "pairs": ["large"], "pairs_share": 0.5}, max_composite_pixels=10**6)
    samples = open_samples(mixed)
    assert fit_sample(samples[0].layers, mixed, 16).panel == (32, 16)
    assert fit_sample(samples[3].layers, mixed, 16) == mixed.task.fit((48, 32), 16)
    latents = EncodedSampleLoader(samples, backbone, mixed)
    shapes = {latents(SampleRng(1, step, 0)).composite.shape[2:] for step in range(20)}
    assert shapes == {(1, 6), (2, 9)}
