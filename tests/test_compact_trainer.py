import copy
import math

import numpy as np
import pytest
import torch

from brewster import Photo
from brewster.errors import ModelError, PhotoError, RecipeError
from brewster.separation.models.networks import NETWORKS, NetworkEntry
from brewster.training.compact.trainer import CompactTrainer, validate
from brewster.training.losses import separation_loss
from brewster.training.recipe import with_value
from brewster.training.streams import held_out_mixtures, open_stream
from training_helpers import SmallNetwork, ignore_step, train


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_without_training_data_the_network_keeps_its_initial_weights(rendered_recipe, tmp_path):
    network = train(with_value(rendered_recipe, "data.rendered.count", 0), tmp_path, ignore_step)
    photo = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(network(photo)[:, :3], photo, atol=1e-5, rtol=0)


def test_a_photo_that_equals_its_ground_truth_has_a_finite_score():
    photo = torch.rand(1, 3, 32, 32)
    pairs = {"plain": [(photo, photo)]}
    better, worse = (validate(lambda _, made=made: made, pairs) for made in (photo, 1 - photo))
    assert better["psnr_gain_db_plain"] == 0
    assert -60 < worse["psnr_gain_db_plain"] < 0


def test_pairs_that_became_worse_are_counted():
    """One of four black predictions is worse than its photo, one is equal, and two are better."""
    black = torch.zeros(1, 3, 32, 32)
    grey = torch.full((1, 3, 32, 32), 0.4)
    pairs = [(grey, grey), (black, grey), (grey, black), (grey, black)]
    metrics = validate(torch.zeros_like, {"four": pairs})
    assert metrics["worse_four"] == 1 / 4


def test_training_lowers_the_loss_on_a_repeated_batch(recipe):
    stream = open_stream(recipe)
    longer = recipe.model_copy(update={"steps": 40})
    trainer = CompactTrainer(longer, lambda step, count, size: stream(0, 2, 64))
    losses = [trainer.training_step(step)["loss"] for step in range(30)]
    assert losses[-1] < 0.8 * losses[0]


def test_chunks_of_a_batch_on_two_cores_give_the_step_of_plain_adamw(recipe, two_threads):
    batch = open_stream(recipe)(0, 3, 64)
    trainer = CompactTrainer(recipe, lambda step, count, size: batch)
    torch.nn.init.normal_(trainer.network.head.weight, std=0.1)
    reference = copy.deepcopy(trainer.network)
    encoder = list(reference.encoder.parameters())
    rest = list(reference.parameters())[len(encoder) :]
    warmup_factor = 1 / recipe.warmup_steps
    rates = (recipe.encoder_learning_rate * warmup_factor, recipe.learning_rate * warmup_factor)
    groups = [
        {"params": group, "lr": rate} for group, rate in zip((encoder, rest), rates, strict=True)
    ]
    optimizer = torch.optim.AdamW(groups, weight_decay=recipe.weight_decay, eps=1e-3, fused=False)
    trainer.optimizer.param_groups[0]["eps"] = trainer.optimizer.param_groups[1]["eps"] = 1e-3
    sum(separation_loss(reference(batch.photo_encoded), batch).values()).backward()
    torch.nn.utils.clip_grad_norm_(reference.parameters(), 1.0)
    optimizer.step()
    trainer.training_step(0)
    expected = dict(reference.named_parameters())
    for name, actual in trainer.network.named_parameters():
        torch.testing.assert_close(actual, expected[name], atol=1e-6, rtol=1e-4, msg=name)


def test_a_nan_loss_stops_the_run_and_keeps_the_weights(recipe):
    batch = open_stream(recipe)(0, 2, 64)
    batch.transmission_encoded.fill_(float("nan"))
    trainer = CompactTrainer(recipe, lambda step, count, size: batch)
    before = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    with pytest.raises(ModelError, match="finite"):
        trainer.training_step(0)
    assert all(
        torch.equal(value, before[name]) for name, value in trainer.network.state_dict().items()
    )


def test_a_batch_whose_gradient_is_infinite_is_skipped(recipe):
    trainer = CompactTrainer(recipe, open_stream(recipe))
    before = copy.deepcopy(trainer.network.state_dict())
    next(trainer.network.parameters()).register_hook(lambda gradient: gradient / 0)
    assert math.isfinite(trainer.training_step(0)["loss"])
    assert all(
        torch.equal(value, before[name]) for name, value in trainer.network.state_dict().items()
    )


def test_a_run_starts_from_an_exported_model_and_a_new_part_from_its_initial_weights(
    recipe, tmp_path, monkeypatch
):
    """test_onnx_backend.py reads the weights of a compact network from its file."""
    monkeypatch.setitem(NETWORKS, "small", NetworkEntry(SmallNetwork, SmallNetwork))
    recipe = with_value(recipe, "network", "small")
    trainer = CompactTrainer(recipe)
    with torch.no_grad():
        for parameter in trainer.network.parameters():
            parameter.normal_().copy_(parameter.half())  # the precision of the file
    trainer._reset_ema()
    model = trainer.export(tmp_path)
    expected = trainer.network.state_dict()
    same = CompactTrainer(with_value(recipe, "init", str(model)))
    same.initialize()
    for name, value in expected.items():
        assert torch.equal(same.network.state_dict()[name], value)
        assert torch.equal(same.ema_weights[name], value)
    new_head = CompactTrainer(
        recipe.model_copy(update={"init": str(model), "trained_part": "head."})
    )
    initial = copy.deepcopy(new_head.network.state_dict())
    new_head.initialize()
    for name, value in new_head.network.state_dict().items():
        assert torch.equal(value, (initial if name.startswith("head.") else expected)[name])


def test_training_only_the_hints_changes_no_photo_without_hints(recipe):
    only_hints = {"init": "compact", "trained_part": "hints.", "hint_probability": 1.0}
    trainer = CompactTrainer(recipe.model_copy(update=only_hints))
    trainer.initialize()
    assert not any(weight.any() for weight in trainer.network.hints.state_dict().values())
    photo = torch.rand(1, 3, 64, 64)
    hints = torch.ones(1, 2, 64, 64)
    before = trainer.ema_network()(photo)
    for step in range(3):
        trainer.training_step(step)
    after = trainer.ema_network()
    assert torch.equal(after(photo), before)
    assert torch.equal(after(photo, 0 * hints), before)
    assert not torch.allclose(after(photo, hints), before, atol=1e-4)


def test_training_only_the_tone_changes_no_reflection(recipe):
    trainer = CompactTrainer(recipe.model_copy(update={"init": "compact", "trained_part": "tone."}))
    trainer.initialize()
    photo = torch.rand(1, 3, 64, 64)
    before = trainer.ema_network()(photo)
    for step in range(3):
        trainer.training_step(step)
    after = trainer.ema_network()(photo)
    assert torch.equal(after[:, 3:], before[:, 3:])
    assert not torch.allclose(after[:, :3], before[:, :3], atol=1e-4)


def test_a_run_does_not_start_from_a_model_of_another_network(recipe, model):
    with pytest.raises(ModelError, match="another network"):
        CompactTrainer(with_value(recipe, "init", str(model))).initialize()
    with pytest.raises(ModelError, match=r"gone\.onnx"):
        CompactTrainer(with_value(recipe, "init", "gone.onnx")).initialize()


def test_held_out_may_match_no_map_but_a_photo(recipe, tmp_path):
    (tmp_path / "data" / "hdri").mkdir()
    white = Photo.from_array(np.ones((16, 32, 3), np.float32), encoding="linear")
    white.save(tmp_path / "data/hdri/room.hdr")
    recipe = with_value(recipe, "data.maps", ["hdri"])
    held_out_mixtures(with_value(recipe, "data.held_out", ["2.png"]))(0, 3, 64)
    with pytest.raises(RecipeError, match=r"no photo in .* matches"):
        held_out_mixtures(with_value(recipe, "data.held_out", ["room*"]))


def test_a_damaged_photo_for_training_is_named(recipe, tmp_path):
    (tmp_path / "data" / "photos" / "permissive" / "1.png").write_bytes(b"")
    with pytest.raises(PhotoError, match=r"1\.png: the file is empty"):
        open_stream(recipe)


def test_held_out_mixtures_do_not_depend_on_seed_and_distributions_of_the_recipe(recipe):
    recipe = with_value(recipe, "data.held_out", ["2.png"])
    other = with_value(with_value(recipe, "seed", 99), "mix.reflection_ratio", [1.0, 2.0])
    one, two = (held_out_mixtures(each)(0, 3, 64) for each in (recipe, other))
    assert torch.equal(one.photo_encoded, two.photo_encoded)
    assert torch.equal(one.transmission_encoded, two.transmission_encoded)
