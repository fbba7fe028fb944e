"""A few-step LoRA, added to another LoRA: both changes of the weights are added."""

import pytest
import torch
from safetensors.torch import save_file

from brewster import Separator
from brewster.errors import ModelError
from brewster.models.diffusion.adapter.lora import attach_layers, lora_state_dict, save_lora
from brewster.models.diffusion.backbones.qwen import Qwen
from brewster.models.diffusion.backbones.registry import BACKBONES, tiny
from brewster.models.diffusion.pipeline import load_pipeline
from brewster.models.diffusion.task import DecompositionTask, PanelLayout
from published_models import merge, random_lora, velocity, with_random_lora


def few_step_layers(name):
    """Random matrices of rank 3 for all linear layers of the blocks: more than those of `with_random_lora`."""
    backbone, _ = tiny(name)
    return random_lora(backbone, 3)


def write_few_step_lora(name, path):
    """Writes a LoRA file with the keys of diffusers."""
    save_file({f"transformer.{key}": value for key, value in few_step_layers(name).items()}, path)
    return path


@pytest.fixture
def fast_file(tmp_path):
    """A LoRA file of a tiny klein."""
    return write_few_step_lora("klein", tmp_path / "lightning-4steps.safetensors")


@pytest.mark.parametrize("name", list(BACKBONES))
def test_a_stacked_lora_is_the_sum_of_both_changes(name):
    stacked, prompt = with_random_lora(name)
    state, layers = lora_state_dict(stacked), few_step_layers(name)
    merged, _ = tiny(name)
    merge(merged, state, 4 / 2)
    merge(merged, layers, 1.0)
    alone = velocity(stacked, prompt)
    attach_layers(stacked, layers, adapter="few_step")
    torch.testing.assert_close(velocity(stacked, prompt), velocity(merged, prompt), atol=1e-5, rtol=0)
    assert (velocity(stacked, prompt) - alone).abs().max() > 1e-2


def test_a_lora_for_few_steps_is_an_option_with_its_steps_and_guidance(fast_file, tmp_path):
    folder = tmp_path / "lora"
    backbone, prompt = with_random_lora("klein")
    task = DecompositionTask(PanelLayout(("T",)), 48 * 32)
    save_lora(folder, backbone, prompt, task, base_model="tiny:klein", target_modules=["*.attn.*"])
    pipeline = load_pipeline(str(folder), fast_lora=str(fast_file))
    attach_layers(backbone, few_step_layers("klein"), adapter="few_step")
    found, expected = (velocity(each, prompt) for each in (pipeline.backbone, backbone))
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    assert pipeline.task.guidance == 1  # no second prediction
    plain = load_pipeline(str(folder))
    other = load_pipeline(str(folder), fast_lora=str(fast_file), guidance=2.5)
    assert (plain.task.guidance, other.task.guidance) == (4, 2.5)
    assert len({plain.sha256, pipeline.sha256, other.sha256}) == 3
    with pytest.raises(ModelError, match=r"without the number of steps; .*; set the option steps"):
        Separator.load(str(folder), fast_lora=str(fast_file))
    assert Separator.load(str(folder), fast_lora=str(fast_file), steps=4).sha256 == pipeline.sha256


def test_a_guidance_that_is_an_input_of_the_transformer_stays(fast_file, tmp_path):
    turbo = write_few_step_lora("kontext", tmp_path / "turbo.safetensors")
    pipeline = load_pipeline("tiny:kontext", fast_lora=str(turbo))
    assert pipeline.task.guidance == 4
    with pytest.raises(ModelError, match="in the style of diffusers, belongs to no layer of kontext"):
        load_pipeline("tiny:kontext", fast_lora=str(fast_file))


def test_a_few_step_lora_for_qwen_is_sampled_at_the_times_of_its_training(tmp_path, monkeypatch):
    fast_lora = str(write_few_step_lora("qwen", tmp_path / "lightning.safetensors"))
    predict, sigmas = Qwen.predict, []

    def record(self, latents, condition, sigma, *arguments):
        sigmas.append(round(sigma.item(), 3))
        return predict(self, latents, condition, sigma, *arguments)

    monkeypatch.setattr(Qwen, "predict", record)
    plain = load_pipeline("tiny:qwen")
    fast = load_pipeline("tiny:qwen", fast_lora=fast_lora)
    other = load_pipeline("tiny:qwen", fast_lora=fast_lora, timestep_shift=1.0)
    fast(torch.zeros(1, 3, 32, 48), steps=4)
    assert sigmas == [1, 0.9, 0.75, 0.5]
    shifts = [pipeline.task.timestep_shift for pipeline in (plain, fast, other)]
    assert shifts == [None, 3, 1]
    assert len({plain.sha256, fast.sha256, other.sha256}) == 3
    assert load_pipeline("tiny:qwen", timestep_shift=3.0).task.timestep_shift == 3


def test_a_model_of_one_step_takes_no_lora_for_few_steps(fast_file, tmp_path):
    backbone, prompt = with_random_lora("klein")
    task = DecompositionTask(objective="one_step")
    save_lora(tmp_path / "lora", backbone, prompt, task, base_model="tiny:klein")
    with pytest.raises(ModelError, match="which takes one step; expected a model that samples"):
        load_pipeline(str(tmp_path / "lora"), fast_lora=str(fast_file))
    with pytest.raises(ModelError, match=r"a timestep shift was given for .*, which takes one step"):
        load_pipeline(str(tmp_path / "lora"), timestep_shift=3.0)
