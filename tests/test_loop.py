import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from brewster.dataset.mix import MixRecipe
from brewster.dataset.sources import read_photos
from brewster.errors import ModelError, RecipeError
from brewster.photo import Photo
from brewster.train.checkpoint import Checkpoint
from brewster.train.loop import Trainer, train
from brewster.train.recipe import open_stream, read_recipe
from front_door import picture

RECIPES = sorted(Path(__file__).parents[1].joinpath("recipes/train").glob("*.toml"))
TINY = next(path for path in RECIPES if path.stem == "tiny")


@pytest.fixture
def recipe(tmp_path, monkeypatch, random):
    folder = tmp_path / "data" / "photos" / "permissive"
    folder.mkdir(parents=True)
    for index in range(3):
        picture = np.kron(random.integers(0, 256, (5, 7, 3)), np.ones((20, 20, 1))).astype(np.uint8)
        Photo.from_array(picture, encoding="srgb").save(folder / f"{index}.png")
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path / "data"))
    return read_recipe(TINY)


def silent(step, steps, numbers, logged):
    pass


class Killed(Exception):
    pass


def die_after(last):
    def report(step, steps, numbers, logged):
        if step == last:
            raise Killed

    return report


def logged_steps(out):
    return [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]


def test_there_are_recipes_and_all_of_them_can_be_read():
    assert len(RECIPES) >= 2
    for path in RECIPES:
        assert read_recipe(path).steps > 0


def test_a_recipe_that_says_nothing_of_mixtures_gets_those_of_the_shipped_model():
    assert read_recipe(TINY.with_stem("compact")).mix == MixRecipe()
    assert read_recipe(TINY).mix == MixRecipe(map_probability=0)


def test_a_killed_run_ends_with_the_same_weights_to_the_last_bit(recipe, tmp_path):
    undisturbed = train(recipe, tmp_path / "one", silent)
    with pytest.raises(Killed):
        train(recipe, tmp_path / "two", die_after(5))
    resumed = train(recipe, tmp_path / "two", silent)
    for name, value in undisturbed.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_a_run_leaves_a_log_and_sample_pictures(recipe, tmp_path):
    train(recipe, tmp_path / "run", silent)
    assert logged_steps(tmp_path / "run") == [3, 6]
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


def test_a_resumed_run_logs_every_step_once(recipe, tmp_path):
    often = recipe.model_copy(update={"steps": 4, "report_every": 1, "checkpoint_every": 2})
    with pytest.raises(Killed):
        train(often, tmp_path, die_after(3))
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"step": 4, "lo')
    train(often, tmp_path, silent)
    assert logged_steps(tmp_path) == [1, 2, 3, 4]


def test_a_run_starts_from_the_averaged_weights_of_another(recipe):
    trainer = Trainer(recipe, open_stream(recipe))
    given = trainer.checkpoint()
    ones = {name: torch.ones_like(value) for name, value in given.average.items()}
    trainer.start_from(replace(given, average=ones))
    assert all((value == 1).all() for value in trainer.network.state_dict().values())
    assert all((value == 1).all() for value in trainer.average.values())


def test_a_run_resumes_when_the_checkpoint_that_it_started_from_has_moved_away(recipe, tmp_path):
    start = tmp_path / "start.pt"
    Trainer(recipe, open_stream(recipe)).checkpoint().write(start)
    with pytest.raises(Killed):
        train(recipe.model_copy(update={"start_from": start}), tmp_path / "run", die_after(5))
    start.unlink()
    train(recipe.model_copy(update={"start_from": Path("elsewhere.pt")}), tmp_path / "run", silent)
    assert logged_steps(tmp_path / "run") == [3, 6]


def test_a_checkpoint_to_start_from_that_is_missing_is_named_with_its_cure(recipe, tmp_path):
    with pytest.raises(ModelError, match=r"gone\.pt cannot be read .* mend start_from"):
        train(recipe.model_copy(update={"start_from": tmp_path / "gone.pt"}), tmp_path / "run", silent)


def test_a_checkpoint_of_another_network_is_named(recipe, tmp_path):
    other = replace(Trainer(recipe, open_stream(recipe)).checkpoint(), network={}, average={})
    other.write(tmp_path / "checkpoint.pt")
    with pytest.raises(ModelError, match=r"checkpoint\.pt holds another network; .* with -o"):
        train(recipe, tmp_path, silent)
    started = recipe.model_copy(update={"start_from": tmp_path / "checkpoint.pt"})
    with pytest.raises(ModelError, match=r"checkpoint\.pt holds another network; .* mend start_from"):
        train(started, tmp_path / "run", silent)


def test_a_damaged_checkpoint_is_named(tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"not a checkpoint")
    with pytest.raises(ModelError, match=r"checkpoint\.pt"):
        Checkpoint.read(tmp_path / "checkpoint.pt")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("seed = 1", "seed ="), "not TOML"),
        (("# A run of seconds", "# Une durée de secondes"), "not TOML .*utf-8"),
        (("seed = 1", ""), "seed; Field required"),
        (("seed = 1", "seed = -1"), "seed"),
        (("steps = 6", "steps = 0"), "steps"),
        (("weight_decay = 1e-4", "weight_decay = inf"), "weight_decay"),
        (("[[0.0, 64], [0.5, 96]]", "[]"), "sizes"),
        (("[[0.0, 64], [0.5, 96]]", "[[0.1, 64]]"), "sizes; .* start at 0"),
        (("[[0.0, 64], [0.5, 96]]", "[[0.0, 64], [0.0, 96]]"), "sizes; .* rise"),
        (("[[0.0, 64], [0.5, 96]]", "[[0.0, 96], [0.5, 64]]"), "sizes; .* rise"),
        (("[[0.0, 64], [0.5, 96]]", "[[0.0, 50]]"), r"sizes\.0\.1; .* multiple of 32"),
        (('["photos/permissive"]', "[]"), r"data\.photos"),
        (("[data]", '[data]\npairs = ["real"]'), "itself; pairs_share gives 0 of 2"),
        (("[data]", '[data]\npairs = ["real"]\npairs_share = 0.1'), "itself; pairs_share gives 0 of 2"),
        (("[data]", '[data]\npairs = ["real"]\npairs_share = 1.0'), "itself; pairs_share gives 2 of 2"),
        (("[data]", "[data]\npairs_share = 0.5"), "itself; pairs_share gives 1 of 2"),
        (("[mix]", "[mix]\nsparkle = 1"), r"mix\.sparkle"),
        (("[mix]", "[mix]\ncrop = [1, 0.45]"), r"mix\.crop; a range goes up"),
        (
            ("[mix]", "[mix]\nreflection_ratio_log = [0, 2]"),
            r"mix\.reflection_ratio_log\.0; .* greater than 0",
        ),
        (("[mix]", "[mix]\ngamma_log = [1.2, 0.8]"), r"mix\.gamma_log; a range goes up"),
        (("[mix]", "[mix]\nnoise = [0, nan]"), r"mix\.noise"),
        (("[mix]", "[mix]\nabsent_probability = 1.5"), r"mix\.absent_probability"),
        (("[mix]", "[mix]\nveil_probability = -0.1"), r"mix\.veil_probability"),
    ],
)
def test_a_wrong_recipe_is_refused_by_the_name_of_what_is_wrong(tmp_path, change, complaint):
    text = TINY.read_text()
    assert change[0] in text
    (tmp_path / "wrong.toml").write_bytes(text.replace(*change).encode("latin-1"))
    with pytest.raises(RecipeError, match=f"wrong.toml .*{complaint}.*; .*"):
        read_recipe(tmp_path / "wrong.toml")


@pytest.mark.parametrize("kind", ["photos", "maps", "pairs"])
def test_a_folder_that_is_missing_or_without_pictures_is_named(recipe, tmp_path, kind):
    (tmp_path / "data" / "empty" / "blended").mkdir(parents=True)
    for folder, complaint in (
        ("empty", "no pictures in .*empty"),
        ("gone", r"gone.* cannot be read \(No such"),
    ):
        data = recipe.data.model_copy(update={kind: [Path(folder)]})
        with pytest.raises(RecipeError, match=complaint):
            open_stream(recipe.model_copy(update={"data": data}))


def test_a_photo_is_read_under_every_suffix_that_the_house_knows(tmp_path):
    for name in ("a.jpg", "b.JFIF", "c.txt"):
        (tmp_path / name).write_bytes(picture())
    assert len(read_photos([tmp_path])) == 2


def test_a_data_folder_that_nobody_named_is_an_error(recipe, monkeypatch):
    monkeypatch.delenv("BREWSTER_DATA")
    with pytest.raises(RecipeError, match="BREWSTER_DATA"):
        open_stream(recipe)
