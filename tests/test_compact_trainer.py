import copy
import math
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from brewster.errors import ModelError
from brewster.training.checkpoint import Checkpoint
from brewster.training.compact.trainer import CompactTrainer, train, validate
from brewster.training.losses import separation_loss
from brewster.training.recipe import with_value
from brewster.training.streams import held_out_mixtures, open_stream

RECIPES = Path(__file__).parents[1] / "recipes"


@contextmanager
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def ignore_step(step, steps, metrics, logged):
    pass


def initial_checkpoint(recipe):
    """Returns the checkpoint before the first step."""
    return Checkpoint(0, recipe.model_dump_json(), CompactTrainer(recipe).state_dict())


def test_without_training_data_the_network_keeps_its_initial_weights(rendered_recipe, tmp_path):
    network = train(with_value(rendered_recipe, "data.rendered.count", 0), tmp_path, ignore_step)
    photo = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(network(photo)[:, :3], photo, atol=1e-5, rtol=0)


def test_a_photo_that_equals_its_ground_truth_has_a_finite_score():
    photo = torch.rand(1, 3, 32, 32)
    better, worse = (
        validate(lambda _, prediction=prediction: prediction, {"plain": [(photo, photo)]})[
            "psnr_gain_db_plain"
        ]
        for prediction in (photo, 1 - photo)
    )
    assert better == 0
    assert -60 < worse < 0


def test_pairs_that_became_worse_are_counted():
    """One of four black predictions is worse than its photo, one is equal, and two are better."""
    black, grey = torch.zeros(1, 3, 32, 32), torch.full((1, 3, 32, 32), 0.4)
    pairs = [(grey, grey), (black, grey), (grey, black), (grey, black)]
    metrics = validate(torch.zeros_like, {"four": pairs})
    assert metrics["worse_four"] == 1 / 4


def test_training_lowers_the_loss_on_a_repeated_batch(recipe):
    stream = open_stream(recipe)
    longer = recipe.model_copy(update={"steps": 40})
    trainer = CompactTrainer(longer, lambda step, count, size: stream(0, 2, 64))
    losses = [trainer.training_step(step)["loss"] for step in range(30)]
    assert losses[-1] < 0.8 * losses[0]


def test_chunks_of_a_batch_on_two_cores_give_the_step_of_plain_adamw(recipe):
    batch = open_stream(recipe)(0, 3, 64)
    with two_threads():
        trainer = CompactTrainer(recipe, lambda step, count, size: batch)
    torch.nn.init.normal_(trainer.network.head.weight, std=0.1)
    reference = copy.deepcopy(trainer.network)
    encoder = list(reference.encoder.parameters())
    rest = list(reference.parameters())[len(encoder) :]
    warmup_factor = 1 / recipe.warmup_steps
    rates = (recipe.encoder_learning_rate * warmup_factor, recipe.learning_rate * warmup_factor)
    optimizer = torch.optim.AdamW(
        [{"params": group, "lr": rate} for group, rate in zip((encoder, rest), rates, strict=True)],
        weight_decay=recipe.weight_decay,
        eps=1e-3,
        fused=False,
    )
    trainer.optimizer.param_groups[0]["eps"] = trainer.optimizer.param_groups[1]["eps"] = 1e-3
    sum(separation_loss(reference(batch.photo_encoded), batch).values()).backward()
    torch.nn.utils.clip_grad_norm_(reference.parameters(), 1.0)
    optimizer.step()
    trainer.training_step(0)
    for (name, actual), expected in zip(
        trainer.network.named_parameters(), reference.parameters(), strict=True
    ):
        torch.testing.assert_close(actual, expected, atol=1e-6, rtol=1e-4, msg=name)


def test_a_nan_loss_stops_the_run_and_keeps_the_weights(recipe):
    batch = open_stream(recipe)(0, 2, 64)
    batch.transmission_encoded.fill_(float("nan"))
    trainer = CompactTrainer(recipe, lambda step, count, size: batch)
    before = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    with pytest.raises(ModelError, match="finite"):
        trainer.training_step(0)
    assert all(torch.equal(value, before[name]) for name, value in trainer.network.state_dict().items())


def test_a_batch_whose_gradient_is_infinite_is_skipped(recipe):
    trainer = CompactTrainer(recipe, open_stream(recipe))
    before = copy.deepcopy(trainer.network.state_dict())
    next(trainer.network.parameters()).register_hook(lambda gradient: gradient / 0)
    assert math.isfinite(trainer.training_step(0)["loss"])
    assert all(torch.equal(value, before[name]) for name, value in trainer.network.state_dict().items())


def test_a_run_starts_from_the_mean_of_the_ema_weights_of_its_checkpoints(recipe, tmp_path):
    checkpoint, starts = initial_checkpoint(recipe), (tmp_path / "one.pt", tmp_path / "three.pt")
    for path, value in zip(starts, (1.0, 3.0), strict=True):
        same = {
            name: torch.full_like(weights, value) for name, weights in checkpoint.state["average"].items()
        }
        replace(checkpoint, state=checkpoint.state | {"average": same}).write(path)
    for init_checkpoints, mean in ((starts[:1], 1), (starts, 2)):
        trainer = CompactTrainer(recipe.model_copy(update={"init_checkpoints": init_checkpoints}))
        trainer.initialize()
        assert all((value == mean).all() for value in trainer.network.state_dict().values())
        assert all((value == mean).all() for value in trainer.ema_weights.values())


def test_held_out_mixtures_do_not_depend_on_seed_and_distributions_of_the_recipe(recipe):
    recipe = with_value(recipe, "data.held_out", ["2.png"])
    other = with_value(with_value(recipe, "seed", 99), "mix.reflection_ratio", [1.0, 2.0])
    one, two = (held_out_mixtures(each)(0, 3, 64) for each in (recipe, other))
    assert torch.equal(one.photo_encoded, two.photo_encoded)
    assert torch.equal(one.transmission_encoded, two.transmission_encoded)


def test_320_held_out_mixtures_are_validated(recipe, monkeypatch):
    monkeypatch.setattr("brewster.training.compact.trainer._HELD_OUT_SIDE_PX", 32)
    pairs = CompactTrainer(with_value(recipe, "data.held_out", ["2.png"]))._validation_pairs
    assert pairs.keys() == {"mixtures", "plain"}
    assert sum(map(len, pairs.values())) == 320
