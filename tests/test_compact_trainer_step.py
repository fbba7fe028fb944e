"""The effect of one training step on the weights: learning rates, schedule, clipping and the moving
average.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.diffusion.lora.trainer import LoraTrainer
from brewster.training.compact.trainer import CompactTrainer
from brewster.training.data.mixtures import TrainingBatch
from brewster.training.data.sample_rng import SampleRng
from brewster.training.losses import separation_loss
from set_folders import render_set


def hard_batch(step, count, size):
    """Returns white photos whose transmission has stripes. The gradient of this batch is large."""
    white = torch.ones(count, 3, size, size)
    black = torch.zeros(count, 3, size, size)
    stripes = torch.arange(size).remainder(2).float().expand_as(white)
    return TrainingBatch(white, stripes, black, torch.ones(count))


@pytest.fixture
def make_trainer(recipe):
    """Returns a function that makes a compact trainer: by default 64 px, no weight decay, no
    warm-up.
    """

    def build(**changes):
        plain = {
            "steps": 100,
            "image_size_schedule": [(0.0, 64)],
            "weight_decay": 0.0,
            "warmup_steps": 1,
        }
        return CompactTrainer(recipe.model_copy(update=plain | changes), hard_batch)

    return build


def test_the_loss_has_the_weights_and_the_scales_of_the_recipe(make_trainer):
    trainer = make_trainer(edge_weight=6.0, edge_scales_px=(1, 3), clipped_weight=3.0)
    batch = hard_batch(0, trainer.recipe.batch_size, 64)
    with torch.no_grad():
        trainer.network.head.bias[6:9] = -0.1  # of the transmission
        layers = trainer.network(batch.photo_encoded)
        expected = separation_loss(layers, batch, 6.0, (1, 3), 3.0)
        other = separation_loss(layers, batch)
    logged = trainer.training_step(0)
    for name in ("edges", "clipped"):
        assert logged[f"loss_{name}"] == pytest.approx(float(expected[name]), rel=0.02)
        assert float(expected[name]) > 2 * float(other[name])


def copy_parameters(network):
    return {name: value.detach().clone() for name, value in network.named_parameters()}


def norm(gradients):
    return float(torch.cat([gradient.flatten() for gradient in gradients]).norm())


def record_norms(optimizer, parameters, norms):
    """Adds the norm of the gradients of each step."""
    optimizer.register_step_pre_hook(
        lambda *_: norms.append(norm(each.grad for each in parameters))
    )


def test_the_encoder_has_its_own_learning_rate(make_trainer):
    """The first step of AdamW changes a weight by the learning rate, independent of the
    gradient.
    """
    trainer = make_trainer(learning_rate=1e-3, encoder_learning_rate=1e-4)
    torch.nn.init.normal_(
        trainer.network.head.weight, std=1e-3
    )  # with zeros, the encoder gets no gradient
    before = copy_parameters(trainer.network)
    trainer.training_step(0)
    after = copy_parameters(trainer.network)
    changes = {name: float((value - before[name]).abs().max()) for name, value in after.items()}
    encoder = [change for name, change in changes.items() if name.startswith("encoder.")]
    rest = [change for name, change in changes.items() if not name.startswith("encoder.")]
    assert max(encoder) == pytest.approx(1e-4, rel=0.05)
    assert max(rest) == pytest.approx(1e-3, rel=0.05)


@pytest.mark.parametrize(
    ("decay_share", "shares"),
    [(1.0, {0: 1, 50: 0.5, 75: 0.1464}), (0.5, {50: 1, 75: 0.5, 99: 0.00099})],
    ids=str,
)
def test_the_learning_rate_falls_along_a_cosine_over_the_last_share(
    make_trainer, decay_share, shares
):
    rates = {"learning_rate": 1e-3, "encoder_learning_rate": 1e-4}
    trainer = make_trainer(**rates, learning_rate_decay_share=decay_share)
    for step, share in shares.items():
        trainer.training_step(step)
        rates = [group["lr"] for group in trainer.optimizer.param_groups]
        assert rates == pytest.approx([1e-4 * share, 1e-3 * share], rel=0.01)


def test_a_large_gradient_is_clipped_to_norm_one(make_trainer):
    trainer = make_trainer()
    norms = []
    batch = hard_batch(0, 2, 64)
    loss = sum(separation_loss(trainer.network(batch.photo_encoded), batch).values())
    raw = torch.autograd.grad(loss, tuple(trainer.network.parameters()), materialize_grads=True)
    assert norm(raw) > 1.5
    record_norms(trainer.optimizer, list(trainer.network.parameters()), norms)
    trainer.training_step(0)
    assert norms == [pytest.approx(1, rel=1e-3)]


@pytest.mark.parametrize(("step", "decay"), [(0, 2 / 11), (99, 0.75)])
def test_the_moving_average_has_the_decay_of_the_recipe_and_a_smaller_one_at_first(
    make_trainer, step, decay
):
    """After n steps the decay is (n + 1) / (n + 10), at most `ema_decay`."""
    trainer = make_trainer(
        ema_decay=0.75, learning_rate_decay_share=0.0, learning_rate=0.1, encoder_learning_rate=0.1
    )
    before = {name: value.clone() for name, value in trainer.ema_weights.items()}
    trainer.training_step(step)
    for name, new in copy_parameters(trainer.network).items():
        expected = decay * before[name] + (1 - decay) * new
        torch.testing.assert_close(trainer.ema_weights[name], expected, atol=1e-6, rtol=1e-6)


# --- a LoRA on a diffusion backbone


@pytest.fixture
def make_lora_trainer(tmp_path):
    """Returns a function that makes a LoRA trainer on the tiny version of kontext."""
    render_set(tmp_path / "tiny", count=1)

    def build(**changes):
        values = {
            "backbone": "tiny:kontext",
            "rank": 2,
            "alpha": 2,
            "max_composite_pixels": 3 * 32 * 16,
            "seed": 1,
            "steps": 6,
            "batch_size": 1,
            "learning_rate": 1e-3,
            "warmup_steps": 4,
            "weight_decay": 0.0,
            "report_every": 6,
            "checkpoint_every": 6,
            "data": {"rendered": {"datasets": [tmp_path / "tiny"], "target": "transmission"}},
        }
        trainer = LoraTrainer(LoraRecipe.model_validate(values | changes))
        trainer.initialize()
        return trainer

    return build


def logits(trainer, count=150):
    """Returns the logits of the training times, log(t / (1 - t))."""
    encoded = trainer._encoded_samples(SampleRng(1, 0, 0))
    times = [
        trainer._start_and_sigma(SampleRng(2, number, 0), encoded)[1] for number in range(count)
    ]
    return torch.cat(times).double().logit()


def test_training_times_are_logit_normal(make_lora_trainer):
    """The shift for the resolution adds a constant to the logit: it changes only the mean."""
    assert logits(make_lora_trainer()).std().item() == pytest.approx(1, rel=0.15)


def test_a_loras_large_gradient_is_clipped_and_its_learning_rate_warms_up(make_lora_trainer):
    trainer = make_lora_trainer(panel_weights={"T": 1})
    norms = []
    for parameter in trainer._parameters:
        parameter.register_hook(lambda gradient: gradient * 1e4)
    record_norms(trainer._optimizer, trainer._parameters, norms)
    rates = []
    for step in range(5):
        trainer.training_step(step)
        rates.append(trainer._optimizer.param_groups[0]["lr"])
    np.testing.assert_allclose(norms, 1, rtol=1e-3)
    assert rates == pytest.approx([0.25e-3, 0.5e-3, 0.75e-3, 1e-3, 1e-3])


def test_the_exact_velocity_has_no_loss(make_lora_trainer, monkeypatch):
    """At time t, a sample is (1 - t) composite + t noise. Its velocity is noise - composite."""
    trainer = make_lora_trainer()
    composite = trainer._encoded_samples(SampleRng(1, 0, 0)).composite

    def exact(latents, condition, sigma, prompt, guidance):
        return (latents - composite) / sigma

    monkeypatch.setattr(trainer.backbone, "predict", exact)
    parts = trainer._losses(SampleRng(1, 0, 0))
    assert parts.keys() == {"panel_I", "panel_T", "panel_R"}
    assert max(float(part) for part in parts.values()) < 1e-6


def test_the_loss_of_a_reflection_is_scaled_by_its_weight(make_lora_trainer, monkeypatch):
    trainer = make_lora_trainer()
    encoded = trainer._encoded_samples(SampleRng(1, 0, 0))
    parts = []
    for weight in (1.0, 0.25):
        monkeypatch.setattr(
            trainer,
            "_encoded_samples",
            lambda rng, weight=weight: replace(encoded, reflection_weight=weight),
        )
        parts.append(
            {name: part.item() for name, part in trainer._losses(SampleRng(1, 0, 0)).items()}
        )
    whole, quarter = parts
    assert quarter["panel_R"] == pytest.approx(whole["panel_R"] / 4, rel=1e-5)
    assert quarter["panel_T"] == pytest.approx(whole["panel_T"], rel=1e-5)


def test_the_gradients_of_earlier_steps_are_cleared(make_lora_trainer):
    trainer = make_lora_trainer(learning_rate=1e-12)
    norms = []
    for parameter in trainer._parameters:
        parameter.register_hook(lambda gradient: gradient * 1e-4)  # too small to be clipped
    record_norms(trainer._optimizer, trainer._parameters, norms)
    trainer.training_step(0)
    trainer.training_step(0)
    assert 0 < norms[0] < 1
    assert norms[1] == pytest.approx(norms[0], rel=1e-3)
