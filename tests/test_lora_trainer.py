"""Training of LoRAs on tiny versions: checkpoints, exported files, and errors."""

import json

import numpy as np
import pytest
import torch

import brewster.diffusion.lora.trainer as trainer_module
from brewster.diffusion.adapter.lora import (
    LORA_FILE,
    load_lora,
    lora_state_dict,
    read_lora_metadata,
)
from brewster.diffusion.backbones.registry import tiny
from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.diffusion.lora.trainer import LoraTrainer
from brewster.diffusion.pipeline import sample
from brewster.diffusion.task import GUIDANCE, STEPS, conditioning_image, split
from brewster.errors import DeviceError, ModelError, RecipeError
from brewster.photo import Photo
from brewster.training.data.sample_rng import SampleRng
from brewster.training.loop import Checkpoint, open_trainer, run
from published_models import save_backbone
from set_folders import render_set
from toy_scenes import SIDE_PX, STRONG, pretrain, psnr, scenes, write_pairs
from training_helpers import Killed, kill_after

RECIPE = {
    "backbone": "tiny:kontext",
    "rank": 2,
    "alpha": 2,
    "max_composite_pixels": 3 * 32 * 16,
    "seed": 1,
    "steps": 6,
    "batch_size": 2,
    "learning_rate": 1e-2,
    "warmup_steps": 2,
    "weight_decay": 1e-4,
    "report_every": 6,
    "checkpoint_every": 2,
}


@pytest.fixture(scope="module")
def rendered_set(tmp_path_factory):
    render_set(tmp_path_factory.mktemp("sets") / "tiny", count=3)
    return next(tmp_path_factory.getbasetemp().glob("sets*/tiny"))


@pytest.fixture
def recipe(rendered_set, monkeypatch):
    monkeypatch.setattr(trainer_module, "_MAX_VALIDATION_SAMPLES", 1)
    return lambda **changes: LoraRecipe.model_validate(
        RECIPE
        | {"data": {"rendered": {"datasets": [rendered_set], "target": "transmission"}}}
        | changes
    )


@pytest.fixture
def make_trainer(recipe):
    def initialize(**changes):
        trainer = LoraTrainer(recipe(**changes))
        trainer.initialize()
        return trainer

    return initialize


def train(recipe, out, last=None):
    trainer = open_trainer(recipe)
    run(trainer, out, kill_after(last))
    return trainer


def photo(width=48, height=32):
    return torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(3)) * 2 - 1


def test_a_killed_and_resumed_run_ends_with_a_bit_identical_lora(recipe, rendered_set, tmp_path):
    pairs = tmp_path / "pairs"
    for role in ("blended", "transmission", "reflection"):
        (pairs / role).mkdir(parents=True)
        pixels = np.random.default_rng(len(role)).integers(0, 256, (32, 48, 3), dtype=np.uint8)
        Photo.from_array(pixels, encoding="srgb").save(pairs / role / "a.png")
    rendered = {"datasets": [rendered_set], "target": "transmission"}
    paired_recipe = recipe(data={"pairs": [pairs], "pairs_share": 0.5, "rendered": rendered})
    uninterrupted = train(paired_recipe, tmp_path / "one").export(tmp_path / "one")
    with pytest.raises(Killed):
        train(paired_recipe, tmp_path / "two", last=5)
    resumed = train(paired_recipe, tmp_path / "two").export(tmp_path / "two")
    assert (uninterrupted / LORA_FILE).read_bytes() == (resumed / LORA_FILE).read_bytes()
    ends = [Checkpoint.read(tmp_path / name / "checkpoint.pt").state for name in ("one", "two")]
    moments = [state["optimizer"]["state"] for state in ends]
    for index, values in moments[0].items():
        assert all(torch.equal(value, moments[1][index][name]) for name, value in values.items())


def test_a_run_writes_a_log_images_and_a_folder_for_diffusers(recipe, tmp_path):
    place = train(recipe(), tmp_path).export(tmp_path)
    names = {path.name for path in place.iterdir()}
    assert names == {LORA_FILE, "prompt.safetensors", "recipe.json", "README.md"}
    assert json.loads((place / "recipe.json").read_text())["backbone"] == "tiny:kontext"
    (line,) = (tmp_path / "log.jsonl").read_text().splitlines()
    assert json.loads(line).keys() == {
        "step",
        "loss",
        "loss_panel_I",
        "loss_panel_T",
        "loss_panel_R",
        "psnr_gain_db_training",
        "seconds",
    }
    assert Photo.open(tmp_path / "samples.png").size == (6 * 240, 20 + 20 + 160)


@pytest.mark.parametrize("backbone", ["kontext", "klein", "qwen"])
@pytest.mark.parametrize("objective", ["flow", "one_step"])
def test_training_lowers_the_loss_of_a_repeated_step(make_trainer, backbone, objective):
    options = {"batch_size": 1, "rank": 4, "learning_rate": 5e-2}
    trainer = make_trainer(backbone=f"tiny:{backbone}", objective=objective, **options)
    losses = [trainer.training_step(0)["loss"] for _ in range(15)]
    assert losses[-1] < 0.9 * losses[0]


def test_the_exported_lora_generates_the_same_panels_in_another_backbone(make_trainer, tmp_path):
    trainer = make_trainer(warmup_steps=1)
    for step in range(3):
        trainer.training_step(step)
    panels = trainer.separate(photo())
    backbone, _ = tiny("kontext")
    shown = conditioning_image(photo(), trainer.recipe.layout)
    plain = split(sample(backbone, shown, trainer.prompt, size=(144, 32)), trainer.recipe.layout)
    card, prompt = load_lora(trainer.export(tmp_path), backbone)
    again = sample(backbone, shown, prompt, size=(144, 32), steps=STEPS, guidance=GUIDANCE)
    again = split(again, card.task.layout)
    assert panels.keys() == again.keys() == {"I", "T", "R"}
    for name, panel in panels.items():
        torch.testing.assert_close(again[name], panel, atol=1e-5, rtol=0)
        assert not torch.allclose(plain[name], panel, atol=1e-3)


def test_one_step_starts_from_the_photo_in_every_panel_and_subtracts_the_velocity(make_trainer):
    trainer = make_trainer(objective="one_step", panels=["T", "R"])
    encode = trainer.backbone.encode
    prompt = trainer.prompt
    start = encode(torch.cat([photo(), photo()], dim=3))
    with torch.no_grad():
        velocity = trainer.backbone.predict(start, encode(photo()), torch.ones(1), prompt, 1.0)
        expected = trainer.backbone.decode(start - velocity).clamp(-1, 1)
    panels = trainer.separate(photo())
    torch.testing.assert_close(torch.cat([panels["T"], panels["R"]], dim=3), expected)


def test_a_panel_of_weight_zero_has_no_loss_and_the_others_share_its_weight(make_trainer):
    equal = make_trainer()
    uneven = make_trainer(panel_weights={"I": 0, "T": 3, "R": 1})
    before = equal.training_step(0)
    after = uneven.training_step(0)
    assert after["loss_panel_I"] == 0
    assert after["loss_panel_T"] == pytest.approx(before["loss_panel_T"] * 3 * 3 / 4)
    assert after["loss_panel_R"] == pytest.approx(before["loss_panel_R"] * 3 / 4)
    assert after["loss"] == pytest.approx(after["loss_panel_T"] + after["loss_panel_R"])


def test_the_loss_of_a_batch_is_the_mean_of_its_samples(make_trainer):
    trainer = make_trainer(batch_size=2)
    alone = [trainer._losses(SampleRng(1, 0, slot)) for slot in range(2)]
    expected = sum(part.item() for parts in alone for part in parts.values()) / 2
    assert trainer.training_step(0)["loss"] == pytest.approx(expected)


def test_data_and_machine_are_checked_before_anything_is_loaded(recipe, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("the backbone was loaded before the checks")

    for name in ("load_backbone", "encode_prompt"):
        monkeypatch.setattr(trainer_module, name, refuse)
    with pytest.raises(RecipeError, match="gone"):
        LoraTrainer(recipe(data={"rendered": {"datasets": [tmp_path / "gone"]}}))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match=r"torch finds no GPU, and kontext has"):
        LoraTrainer(recipe(backbone="kontext"))
    with pytest.raises(AssertionError, match="loaded before"):
        LoraTrainer(recipe()).initialize()


def test_values_for_inference_are_stored_with_the_lora(make_trainer, tmp_path):
    inference = {"inference_steps": 3, "inference_guidance": 2.5}
    trainer = make_trainer(**inference, white_space=False, target_modules=["*.attn.*"])
    metadata = read_lora_metadata(trainer.export(tmp_path))
    assert (metadata.task.steps, metadata.task.guidance) == (3, 2.5)
    assert not metadata.task.layout.white_space
    assert metadata.target_modules == ("*.attn.*",)
    steps = []
    monitor = trainer.backbone.transformer.register_forward_hook(lambda *_: steps.append(1))
    trainer.separate(photo())
    monitor.remove()
    assert len(steps) == 3


def test_a_nan_loss_stops_the_run_and_keeps_the_last_valid_checkpoint(
    recipe, tmp_path, monkeypatch
):
    losses = LoraTrainer._losses
    trainer = open_trainer(recipe())

    def break_after_2(step, steps, metrics, logged):
        if step == 2:
            nan = float("nan")
            monkeypatch.setattr(
                trainer, "_losses", lambda rng: {"loss": nan * losses(trainer, rng)["panel_T"]}
            )

    with pytest.raises(ModelError, match="the loss is nan at step 2; expected a finite loss"):
        run(trainer, tmp_path, break_after_2)
    saved = Checkpoint.read(tmp_path / "checkpoint.pt")
    assert saved.step == 2
    for name, tensor in lora_state_dict(trainer.backbone).items():
        assert torch.equal(tensor, saved.state["lora"][name])


def test_an_infinite_gradient_does_not_change_the_lora(make_trainer):
    trainer = make_trainer()
    before = {name: tensor.clone() for name, tensor in lora_state_dict(trainer.backbone).items()}
    trainer._parameters[0].register_hook(lambda gradient: gradient * float("inf"))
    with pytest.raises(ModelError, match=r"the gradient is (inf|nan) at step 0"):
        trainer.training_step(0)
    after = lora_state_dict(trainer.backbone)
    assert all(torch.equal(tensor, before[name]) for name, tensor in after.items())


def test_an_encoded_prompt_is_used_if_it_was_encoded_for_this_backbone(make_trainer, tmp_path):
    for name in ("kontext", "klein"):
        tiny(name, seed=5)[1].save(tmp_path / f"{name}.safetensors")
    trainer = make_trainer(prompt=str(tmp_path / "kontext.safetensors"))
    assert trainer.prompt.sha256 == tiny("kontext", seed=5)[1].sha256
    with pytest.raises(ModelError, match="encoded for klein; expected a prompt for kontext"):
        make_trainer(prompt=str(tmp_path / "klein.safetensors"))


@pytest.mark.parametrize("quantization", [None, "int8"])
def test_a_backbone_in_a_folder_trains_like_its_tiny_version(make_trainer, tmp_path, quantization):
    backbone, prompt = tiny("kontext")
    save_backbone(backbone, tmp_path / "base")
    prompt.save(tmp_path / "prompt.safetensors")
    paths = {"backbone": str(tmp_path / "base"), "prompt": str(tmp_path / "prompt.safetensors")}
    trainer = make_trainer(**paths, quantization=quantization)
    twin = make_trainer()
    expected = pytest.approx(twin.training_step(0)["loss"], rel=0.05 if quantization else 1e-6)
    assert trainer.training_step(0)["loss"] == expected
    assert trainer.training_step(1)["loss"] > 0
    changed = lora_state_dict(trainer.backbone)
    assert any(tensor.any() for name, tensor in changed.items() if "lora_B" in name)


def transmissions(trainer, photos):
    """Returns the generated T of each photo."""
    return torch.cat([trainer.separate(photo[None])["T"] for photo in photos])


def scores(tmp_path, name, *, vae_steps, pretraining, steps, unseen_count=96):
    """Returns the mean PSNR of T in dB on unseen toy scenes, of four predictions.

    "copy" is the photo, "mean" the mean T of the training scenes, "base" the result of the backbone
    without the LoRA.
    """
    prompt = pretrain(name, tmp_path / "base", vae_steps=vae_steps, steps=pretraining)
    training = scenes(2, 64, "blob", STRONG)
    unseen = scenes(3, unseen_count, "blob", STRONG)
    write_pairs(tmp_path / "pairs", training)
    recipe = LoraRecipe.model_validate(
        {
            "backbone": str(tmp_path / "base"),
            "prompt": str(prompt),
            "objective": "one_step",
            "seed": 1,
            "flip": False,
            "rank": 16,
            "alpha": 16,
            "max_composite_pixels": 3 * SIDE_PX**2,
            "steps": steps,
            "batch_size": 2,
            "learning_rate": 1e-2,
            "warmup_steps": 5,
            "weight_decay": 1e-4,
            "panel_weights": {"I": 0.1, "R": 0.1},
            "report_every": steps,
            "checkpoint_every": steps,
            "data": {"pairs": [tmp_path / "pairs"], "pairs_share": 1.0},
        }
    )
    trainer = open_trainer(recipe)
    trainer.initialize()
    predictions = {"copy": unseen["I"], "mean": training["T"].mean(0).expand_as(unseen["T"])}
    predictions["base"] = transmissions(trainer, unseen["I"])
    run(trainer, tmp_path / "run", lambda *_: None)
    predictions["LoRA"] = transmissions(trainer, unseen["I"])
    return {key: psnr(images, unseen["T"]) for key, images in predictions.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kontext", "klein", "qwen"])
def test_longer_training_beats_the_mean_of_the_training_scenes_for_every_backbone(
    tmp_path, name, capsys
):
    found = scores(tmp_path, name, vae_steps=400, pretraining=400, steps=200)
    with capsys.disabled():
        print(f"\n{name}: " + ", ".join(f"{key} {value:.2f} dB" for key, value in found.items()))
    assert found["LoRA"] > found["base"] + 0.1, found
    assert found["LoRA"] > found["copy"] + 1.5, found
    assert found["LoRA"] > found["mean"], found
