import json
from pathlib import Path

import numpy as np
import pytest
import torch

from brewster.errors import ModelError, RecipeError
from brewster.photo import Photo
from brewster.train.checkpoint import Checkpoint
from brewster.train.loop import Trainer, train
from brewster.train.recipe import open_stream, read_recipe

RECIPES = sorted(Path(__file__).parents[1].joinpath("recipes/train").glob("*.toml"))


@pytest.fixture
def recipe(tmp_path, monkeypatch, random):
    folder = tmp_path / "data" / "photos" / "permissive"
    folder.mkdir(parents=True)
    for index in range(3):
        picture = np.kron(random.integers(0, 256, (5, 7, 3)), np.ones((20, 20, 1))).astype(np.uint8)
        Photo.from_array(picture, encoding="srgb").save(folder / f"{index}.png")
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path / "data"))
    return read_recipe(next(path for path in RECIPES if path.stem == "tiny"))


def silent(step, steps, numbers):
    pass


class Killed(Exception):
    pass


def test_there_are_recipes_and_all_of_them_can_be_read():
    assert len(RECIPES) >= 2
    for path in RECIPES:
        assert read_recipe(path).steps > 0


def test_a_killed_run_ends_with_the_same_weights_to_the_last_bit(recipe, tmp_path):
    def die_after_five(step, steps, numbers):
        if step == 5:
            raise Killed

    undisturbed = train(recipe, tmp_path / "one", silent)
    with pytest.raises(Killed):
        train(recipe, tmp_path / "two", die_after_five)
    resumed = train(recipe, tmp_path / "two", silent)
    for name, value in undisturbed.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_a_run_leaves_a_log_and_sample_pictures(recipe, tmp_path):
    train(recipe, tmp_path / "run", silent)
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [3, 6]
    assert Photo.open(tmp_path / "run" / "samples.png").size[0] == 960


def test_training_lowers_the_loss_on_a_batch_seen_again_and_again(recipe):
    stream = open_stream(recipe)
    trainer = Trainer(recipe.model_copy(update={"steps": 40}), lambda step, count, size: stream(0, 2, 64))
    losses = [trainer.advance()["loss"] for _ in range(15)]
    assert losses[-1] < 0.8 * losses[0]


def test_a_loss_that_is_not_a_number_stops_the_run_and_keeps_the_weights(recipe):
    trainer = Trainer(recipe, open_stream(recipe))
    before = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    batch = trainer.stream(0, 2, 64)
    batch.transmission_encoded.fill_(float("nan"))
    trainer.stream = lambda step, count, size: batch
    with pytest.raises(ModelError, match="finite"):
        trainer.advance()
    assert all(torch.equal(value, before[name]) for name, value in trainer.network.state_dict().items())


def test_a_run_of_another_recipe_is_not_continued(recipe, tmp_path):
    train(recipe.model_copy(update={"steps": 1}), tmp_path, silent)
    with pytest.raises(RecipeError, match="another recipe"):
        train(recipe, tmp_path, silent)


def test_a_damaged_checkpoint_is_named(tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"not a checkpoint")
    with pytest.raises(ModelError, match=r"checkpoint\.pt"):
        Checkpoint.read(tmp_path / "checkpoint.pt")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [(("steps = 6", "steps = 0"), "steps"), (("seed = 1", ""), "seed"), (("[mix]", "[mix]\nsparkle = 1"), "sparkle"),
     (("seed = 1", "seed ="), "not TOML")],
)  # fmt: skip
def test_a_wrong_recipe_is_refused_by_the_name_of_what_is_wrong(tmp_path, change, complaint):
    text = next(path for path in RECIPES if path.stem == "tiny").read_text().replace(*change)
    (tmp_path / "wrong.toml").write_text(text)
    with pytest.raises(RecipeError, match=complaint):
        read_recipe(tmp_path / "wrong.toml")


def test_a_folder_without_pictures_and_a_missing_data_folder_are_named(recipe, tmp_path, monkeypatch):
    empty = recipe.model_copy(update={"data": recipe.data.model_copy(update={"photos": [tmp_path / "data"]})})
    with pytest.raises(RecipeError, match="no pictures"):
        open_stream(empty)
    monkeypatch.delenv("BREWSTER_DATA")
    with pytest.raises(RecipeError, match="BREWSTER_DATA"):
        open_stream(recipe)
