"""Training improves results on unseen data: toy scenes behind glass that differ from those of pretraining."""

import pytest
import torch

from brewster.training.loop import open_trainer, run
from brewster.training.recipe import LoraRecipe
from toy_scenes import SIDE_PX, STRONG, pretrain, psnr, scenes, write_pairs


def transmissions(trainer, photos):
    """Returns the generated T of each photo."""
    return torch.cat([trainer.separate(photo[None])["T"] for photo in photos])


def scores(tmp_path, name, *, vae_steps, pretraining, steps, unseen_count=96):
    """Returns the mean PSNR of T in dB on unseen toy scenes, of four predictions.

    "copy" is the photo, "mean" the mean T of the training scenes, "base" the result of the backbone without the LoRA.
    """
    prompt = pretrain(name, tmp_path / "base", vae_steps=vae_steps, steps=pretraining)
    training, unseen = scenes(2, 64, "blob", STRONG), scenes(3, unseen_count, "blob", STRONG)
    write_pairs(tmp_path / "pairs", training)
    recipe = LoraRecipe.model_validate({
        "backbone": str(tmp_path / "base"), "prompt": str(prompt), "objective": "one_step", "seed": 1,
        "flip": False, "rank": 16, "alpha": 16, "max_composite_pixels": 3 * SIDE_PX**2, "steps": steps,
        "batch_size": 2, "learning_rate": 1e-2, "warmup_steps": 5, "weight_decay": 1e-4,
        "panel_weights": {"I": 0.1, "R": 0.1}, "report_every": steps, "checkpoint_every": steps,
        "data": {"pairs": [tmp_path / "pairs"], "pairs_share": 1.0},
    })  # fmt: skip
    trainer = open_trainer(recipe)
    trainer.initialize()
    predictions = {"copy": unseen["I"], "mean": training["T"].mean(0).expand_as(unseen["T"])}
    predictions["base"] = transmissions(trainer, unseen["I"])
    run(trainer, tmp_path / "run", lambda *_: None)
    predictions["LoRA"] = transmissions(trainer, unseen["I"])
    return {key: psnr(images, unseen["T"]) for key, images in predictions.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kontext", "klein", "qwen"])
def test_longer_training_beats_the_mean_of_the_training_scenes_for_every_backbone(tmp_path, name, capsys):
    found = scores(tmp_path, name, vae_steps=400, pretraining=400, steps=200)
    with capsys.disabled():
        print(f"\n{name}: " + ", ".join(f"{key} {value:.2f} dB" for key, value in found.items()))
    assert found["LoRA"] > found["base"] + 0.1, found
    assert found["LoRA"] > found["copy"] + 1.5, found
    assert found["LoRA"] > found["mean"], found
