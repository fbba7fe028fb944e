"""The effect of one training step on the weights: learning rates, schedule, clipping and the moving average."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from brewster.training.compact.trainer import CompactTrainer
from brewster.training.data.mixtures import TrainingBatch
from brewster.training.data.sample_rng import SampleRng
from brewster.training.lora.trainer import LoraTrainer
from brewster.training.losses import separation_loss
from brewster.training.recipe import LoraRecipe
from set_folders import make


def hard_batch(step, count, size):
    """White photos of striped scenes, without a reflection: the gradient is large."""
    white, black = torch.ones(count, 3, size, size), torch.zeros(count, 3, size, size)
    stripes = torch.arange(size).remainder(2).float().expand_as(white)
    return TrainingBatch(white, stripes, black, torch.ones(count))


@pytest.fixture
def trainer(recipe):
    """Builds the compact network's trainer: by default 64 px, no weight decay, no warm-up."""

    def build(**changes):
        plain = {"steps": 100, "sizes": [(0.0, 64)], "weight_decay": 0.0, "warmup_steps": 1}
        return CompactTrainer(recipe.model_copy(update=plain | changes), hard_batch)

    return build


def copy_of(network):
    return {name: value.detach().clone() for name, value in network.named_parameters()}


def norm(gradients):
    return float(torch.cat([gradient.flatten() for gradient in gradients]).norm())


def test_the_encoder_has_its_own_learning_rate(trainer):
    """The first step of AdamW changes a weight by the learning rate, independent of the gradient."""
    one = trainer(learning_rate=1e-3, encoder_learning_rate=1e-4)
    torch.nn.init.normal_(one.network.head.weight, std=1e-3)  # with zeros, the encoder gets no gradient
    before = copy_of(one.network)
    one.training_step(0)
    moved = {name: float((v - before[name]).abs().max()) for name, v in copy_of(one.network).items()}
    encoder = [change for name, change in moved.items() if name.startswith("encoder.")]
    rest = [change for name, change in moved.items() if not name.startswith("encoder.")]
    assert max(encoder) == pytest.approx(1e-4, rel=0.05)
    assert max(rest) == pytest.approx(1e-3, rel=0.05)


@pytest.mark.parametrize(
    ("step", "decay_share", "share"),
    [(0, 1.0, 1), (50, 1.0, 0.5), (75, 1.0, 0.1464), (50, 0.5, 1), (75, 0.5, 0.5), (99, 0.5, 0.00099)],
)
def test_the_learning_rate_falls_along_a_cosine_over_the_last_share_of_the_run(
    trainer, step, decay_share, share
):
    one = trainer(learning_rate=1e-3, encoder_learning_rate=1e-4, decay_share=decay_share)
    one.training_step(step)
    rates = [group["lr"] for group in one.optimizer.param_groups]
    assert rates == pytest.approx([1e-4 * share, 1e-3 * share], rel=0.01)


def test_the_learning_rate_rises_linearly_during_warm_up(trainer):
    one = trainer(learning_rate=1e-3, warmup_steps=4, decay_share=0.0)
    rates = []
    for step in range(5):
        one.training_step(step)
        rates.append(one.optimizer.param_groups[1]["lr"])
    assert rates == pytest.approx([0.25e-3, 0.5e-3, 0.75e-3, 1e-3, 1e-3])


def test_a_large_gradient_is_clipped_to_norm_one(trainer):
    one, seen = trainer(), []
    batch = hard_batch(0, 2, 64)
    loss = sum(separation_loss(one.network(batch.photo_encoded), batch).values())
    raw = torch.autograd.grad(loss, tuple(one.network.parameters()))
    assert norm(raw) > 1.5
    one.optimizer.register_step_pre_hook(
        lambda *_: seen.append(norm(parameter.grad for parameter in one.network.parameters()))
    )
    one.training_step(0)
    assert seen == [pytest.approx(1, rel=1e-3)]


@pytest.mark.parametrize(("step", "decay"), [(0, 2 / 11), (99, 0.75)])
def test_the_moving_average_has_the_decay_of_the_recipe_and_a_smaller_one_at_first(trainer, step, decay):
    """After n steps the decay is (n + 1) / (n + 10), at most `average_decay`."""
    one = trainer(average_decay=0.75, decay_share=0.0, learning_rate=0.1, encoder_learning_rate=0.1)
    before = {name: value.clone() for name, value in one.ema_weights.items()}
    one.training_step(step)
    for name, new in copy_of(one.network).items():
        expected = decay * before[name] + (1 - decay) * new
        torch.testing.assert_close(one.ema_weights[name], expected, atol=1e-6, rtol=1e-6)


def test_the_exported_network_has_the_averaged_weights(trainer):
    one = trainer(learning_rate=0.1, encoder_learning_rate=0.1)
    one.training_step(0)
    exported, trained = copy_of(one.ema_network()), copy_of(one.network)
    assert all(value.equal(one.ema_weights[name]) for name, value in exported.items())
    assert not any(value.equal(trained[name]) for name, value in exported.items() if "head" in name)


def test_the_loss_is_the_sum_of_its_parts(trainer):
    metrics = trainer().training_step(0)
    assert metrics["edges"] > 0
    assert metrics["loss"] == pytest.approx(
        sum(metrics[name] for name in ("transmission", "reflection", "edges", "psnr")), rel=1e-5
    )


# --- a LoRA on a large backbone


@pytest.fixture
def lora(tmp_path):
    """Builds a LoRA's trainer on the toy twin of kontext."""
    make(tmp_path / "tiny", count=1)

    def build(**changes):
        values = {
            "backbone": "tiny:kontext", "rank": 2, "alpha": 2, "budget_px": 3 * 32 * 16, "seed": 1, "steps": 6,
            "batch": 1, "learning_rate": 1e-3, "warmup_steps": 4, "weight_decay": 0.0, "report_every": 6,
            "checkpoint_every": 6, "data": {"rendered": {"sets": [tmp_path / "tiny"], "target": "transmission"}},
        }  # fmt: skip
        one = LoraTrainer(LoraRecipe.model_validate(values | changes))
        one.initialize()
        return one

    return build


def logits(trainer, count=150):
    """The logits of the training times, log(t / (1 - t))."""
    encoded = trainer._latents(SampleRng(1, 0, 0))
    times = [trainer._start_and_sigma(SampleRng(2, number, 0), encoded)[1] for number in range(count)]
    return torch.cat(times).double().logit()


def test_training_times_are_logit_normal_with_the_recipes_mean_and_deviation(lora):
    """The shift for the resolution adds a constant to the logit: it changes the mean alone."""
    usual = logits(lora())
    assert usual.std().item() == pytest.approx(1, rel=0.15)
    one = lora(logit_mean=0.7, logit_deviation=0.2)
    assert logits(one).std().item() == pytest.approx(0.2, rel=0.15)
    assert logits(one).mean().item() - usual.mean().item() == pytest.approx(0.7, abs=0.2)


def test_a_loras_large_gradient_is_clipped_and_its_learning_rate_warms_up(lora):
    one, seen = lora(panel_weights={"T": 1}), []
    for parameter in one._parameters:
        parameter.register_hook(lambda gradient: gradient * 1e4)
    one._optimizer.register_step_pre_hook(lambda *_: seen.append(norm(p.grad for p in one._parameters)))
    rates = []
    for step in range(5):
        one.training_step(step)
        rates.append(one._optimizer.param_groups[0]["lr"])
    np.testing.assert_allclose(seen, 1, rtol=1e-3)
    assert rates == pytest.approx([0.25e-3, 0.5e-3, 0.75e-3, 1e-3, 1e-3])


def test_the_exact_velocity_has_no_loss(lora, monkeypatch):
    """At time t a sample is (1 - t) picture + t noise, and its velocity is noise - picture."""
    one = lora()
    picture = one._latents(SampleRng(1, 0, 0)).composite

    def exact(latents, condition, sigma, prompt, guidance):
        return (latents - picture) / sigma

    monkeypatch.setattr(one.backbone, "predict", exact)
    parts = one._losses(SampleRng(1, 0, 0))
    assert parts.keys() == {"panel_I", "panel_T", "panel_R"}
    assert max(float(part) for part in parts.values()) < 1e-6


def test_the_loss_of_a_reflection_is_scaled_by_its_weight(lora, monkeypatch):
    one = lora()
    encoded = one._latents(SampleRng(1, 0, 0))
    parts = []
    for weight in (1.0, 0.25):
        monkeypatch.setattr(
            one, "_latents", lambda rng, weight=weight: replace(encoded, reflection_weight=weight)
        )
        parts.append({name: part.item() for name, part in one._losses(SampleRng(1, 0, 0)).items()})
    whole, quarter = parts
    assert quarter["panel_R"] == pytest.approx(whole["panel_R"] / 4, rel=1e-5)
    assert quarter["panel_T"] == pytest.approx(whole["panel_T"], rel=1e-5)


def test_the_gradients_of_earlier_steps_are_cleared(lora):
    one, seen = lora(learning_rate=1e-12), []
    for parameter in one._parameters:
        parameter.register_hook(lambda gradient: gradient * 1e-4)  # too small to be clipped
    one._optimizer.register_step_pre_hook(lambda *_: seen.append(norm(p.grad for p in one._parameters)))
    one.training_step(0)
    one.training_step(0)
    assert 0 < seen[0] < 1
    assert seen[1] == pytest.approx(seen[0], rel=1e-3)
