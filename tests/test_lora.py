"""LoRAs on tiny versions of the backbones: training, saving, loading, and LoRAs for few steps."""

import copy

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from brewster import Separator
from brewster.errors import ModelError
from brewster.models.diffusion.adapter import lora
from brewster.models.diffusion.backbones.qwen import Qwen
from brewster.models.diffusion.backbones.registry import BACKBONES, build, tiny
from brewster.models.diffusion.pipeline import load_pipeline
from brewster.models.diffusion.task import DecompositionTask, PanelLayout
from brewster.models.diffusion.tensors import read_tensors, write_tensors
from published_models import diffusers_pipeline, merge, random_lora, save_backbone, velocity, with_random_lora


@pytest.fixture(params=list(BACKBONES))
def tiny_model(request):
    return tiny(request.param, seed=1)


def add_trained_lora(backbone, *, alpha=16, rank=4):
    """Adds a LoRA with nonzero B matrices, as after training."""
    lora.add_lora(backbone, rank=rank, alpha=alpha, seed=2)
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for parameter in lora.lora_parameters(backbone):
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return backbone


def test_all_linear_layers_of_the_blocks_and_no_others_are_adapted(tiny_model):
    backbone, _ = tiny_model
    targets = backbone.lora_targets()
    linear = {name for name, module in backbone.transformer.named_modules() if isinstance(module, nn.Linear)}
    outside = linear - set(targets)
    assert outside
    assert all("blocks." in name for name in targets)
    assert not any("blocks." in name for name in outside)
    assert "proj_out" in outside
    lora.add_lora(backbone)
    changed = {name.rsplit(".lora_", 1)[0] for name in lora.lora_state_dict(backbone)}
    assert changed == set(targets)
    assert backbone.lora_targets() == targets


def test_a_new_lora_changes_no_prediction_and_only_its_parameters_are_trained(tiny_model):
    backbone, prompt = tiny_model
    before = velocity(backbone, prompt)
    parameters = lora.add_lora(backbone, rank=4)
    assert torch.equal(velocity(backbone, prompt), before)
    assert sum(map(torch.numel, parameters)) == sum(map(torch.numel, lora.lora_state_dict(backbone).values()))
    velocity(backbone, prompt).square().mean().backward()
    named = backbone.transformer.named_parameters()
    without_gradient = {name for name, part in named if "lora_" in name and part.grad is None}
    # The text output of Qwen's last block is unused, so its layers get no gradient (DDP: find_unused_parameters).
    last = "transformer_blocks.1.attn.to_add_out", "transformer_blocks.1.txt_mlp."
    assert all(name.startswith(last) for name in without_gradient)
    assert bool(without_gradient) == (backbone.name == "qwen")


def test_the_seed_determines_the_lora_and_the_global_random_state_is_unchanged():
    backbone, _ = tiny("kontext", seed=1)
    states = []
    for seed in (7, 7, 8):
        rng = torch.get_rng_state()
        lora.add_lora(backbone, rank=4, seed=seed)
        assert torch.equal(torch.get_rng_state(), rng)
        states.append(lora.lora_state_dict(backbone))
        backbone.transformer.unload_lora()
    name = next(name for name in states[0] if "lora_A" in name)
    assert torch.equal(states[0][name], states[1][name])
    assert not torch.equal(states[0][name], states[2][name])


def test_a_lora_is_loaded_in_the_dtype_of_its_base(tmp_path):
    family = BACKBONES["kontext"]
    backbone = build("kontext", family.tiny, seed=1, dtype=torch.bfloat16)
    prompt = family.random_prompt(backbone.transformer, 1)
    plain = velocity(backbone, prompt)
    expected = velocity(add_trained_lora(backbone), prompt)
    lora.save_lora(tmp_path, backbone, prompt, DecompositionTask())
    backbone.transformer.unload_lora()
    lora.load_lora(tmp_path, backbone)
    assert {tensor.dtype for tensor in lora.lora_state_dict(backbone).values()} == {torch.bfloat16}
    assert (velocity(backbone, prompt) - expected).std() < 0.2 * (expected - plain).std()


def test_targets_select_layers_by_their_names_and_are_stored(tmp_path):
    backbone, prompt = tiny("kontext", seed=1)
    targets = ["*.attn.to_?", "single_transformer_blocks.0.*"]
    lora.add_lora(backbone, rank=2, target_modules=targets)
    adapted = {name.rsplit(".lora_", 1)[0] for name in lora.lora_state_dict(backbone)}
    assert "transformer_blocks.0.attn.to_q" in adapted
    assert "single_transformer_blocks.0.proj_out" in adapted
    assert not any(name.startswith("transformer_blocks") and ".ff." in name for name in adapted)
    assert "single_transformer_blocks.1.proj_out" not in adapted
    before = velocity(backbone, prompt)
    lora.save_lora(tmp_path, backbone, prompt, DecompositionTask(), target_modules=targets)
    fresh, _ = tiny("kontext", seed=1)
    assert lora.load_lora(tmp_path, fresh)[0].target_modules == tuple(targets)
    torch.testing.assert_close(velocity(fresh, prompt), before, atol=1e-6, rtol=0)
    fresh.transformer.unload_lora()
    with pytest.raises(ModelError, match=r"matches the target 'to_q'; expected a name with wildcards"):
        lora.add_lora(fresh, target_modules=["to_q"])


@pytest.mark.parametrize("alpha", [4, 16])
def test_a_saved_lora_gives_the_same_prediction_reloaded_and_in_diffusers(tiny_model, tmp_path, alpha):
    backbone, prompt = tiny_model
    plain = copy.deepcopy(backbone.transformer)
    untouched = velocity(backbone, prompt)
    with_lora = velocity(add_trained_lora(backbone, alpha=alpha), prompt)
    assert (with_lora - untouched).abs().max() > 1e-3
    metadata = lora.save_lora(tmp_path, backbone, prompt, DecompositionTask())

    backbone.transformer = copy.deepcopy(plain)
    assert lora.load_lora(tmp_path, backbone)[0] == metadata == lora.read_lora_metadata(tmp_path)
    assert (metadata.rank, metadata.alpha, metadata.prompt_sha256) == (4, alpha, prompt.sha256)
    torch.testing.assert_close(velocity(backbone, prompt), with_lora, atol=1e-6, rtol=0)

    backbone.transformer = plain
    diffusers_pipeline(backbone).load_lora_weights(tmp_path)
    torch.testing.assert_close(velocity(backbone, prompt), with_lora, atol=1e-5, rtol=0)


@pytest.fixture
def saved(tmp_path):
    """The folder of a LoRA of a tiny Kontext."""
    backbone, prompt = tiny("kontext", seed=1)
    lora.save_lora(tmp_path, add_trained_lora(backbone), prompt, DecompositionTask())
    return tmp_path


def change_metadata(folder, **changes):
    tensors, entries = read_tensors(folder / lora.LORA_FILE)
    metadata = vars(lora.LoraMetadata.from_json(entries["brewster"])) | changes
    write_tensors(folder / lora.LORA_FILE, tensors, entries | {"brewster": lora.LoraMetadata(**metadata).to_json()})


@pytest.mark.parametrize(("changes", "message"), [
    ({"rank": 8}, r"has the shape \(4, 32\); expected \(8, 32\); use the rank"),
    ({"prompt_sha256": "0" * 64}, "is not the prompt with which the LoRA was trained"),
])  # fmt: skip
def test_metadata_that_do_not_match_the_files_are_refused(saved, changes, message):
    change_metadata(saved, **changes)
    fresh, _ = tiny("kontext", seed=1)
    with pytest.raises(ModelError, match=message):
        lora.load_lora(saved, fresh)


def test_another_or_a_smaller_backbone_is_refused(saved):
    with pytest.raises(ModelError, match="expected None"):
        lora.load_lora(saved, tiny("klein")[0])
    fresh, _ = tiny("kontext", seed=1)
    fresh.transformer.single_transformer_blocks = fresh.transformer.single_transformer_blocks[:1]
    with pytest.raises(ModelError, match=r"^single_transformer_blocks\.1"):
        lora.load_lora(saved, fresh)


@pytest.mark.parametrize("alpha", [4, 16])
def test_the_file_for_comfyui_gives_the_same_prediction(tiny_model, tmp_path, run_without_model, alpha):
    backbone, prompt = tiny_model
    save_backbone(backbone, tmp_path / "base")
    add_trained_lora(backbone, alpha=alpha)
    task = DecompositionTask(PanelLayout(("I", "T", "R"), "stacked"), 4096, steps=3)
    lora.save_lora(tmp_path / "lora", backbone, prompt, task, base_model=str(tmp_path / "base"))
    expected = velocity(backbone, prompt)
    backbone.transformer.unload_lora()

    file = tmp_path / "glass.safetensors"
    assert run_without_model("models", "export", tmp_path / "lora", "-o", file)[0] == 0
    tensors, _ = read_tensors(file)
    for name, up in tensors.items():  # as ComfyUI reads it: W + alpha / rank * up @ down
        layer, is_up, _ = name.partition(".lora_B.weight")
        if is_up:
            scale = tensors[f"{layer}.alpha"] / len(up[0])
            target = backbone.transformer.get_submodule(layer.removeprefix("transformer."))
            target.weight.data += scale * up @ tensors[f"{layer}.lora_A.weight"]
    torch.testing.assert_close(velocity(backbone, prompt), expected, atol=1e-5, rtol=0)
    code, _, err = run_without_model("models", "export", tmp_path / "lora", "-o", file)
    assert code == 1
    assert "exists already" in err


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
    state, layers = lora.lora_state_dict(stacked), few_step_layers(name)
    merged, _ = tiny(name)
    merge(merged, state, 4 / 2)
    merge(merged, layers, 1.0)
    alone = velocity(stacked, prompt)
    lora.attach_layers(stacked, layers, adapter="few_step")
    torch.testing.assert_close(velocity(stacked, prompt), velocity(merged, prompt), atol=1e-5, rtol=0)
    assert (velocity(stacked, prompt) - alone).abs().max() > 1e-2


def test_a_lora_for_few_steps_is_an_option_with_its_steps_and_guidance(fast_file, tmp_path):
    folder = tmp_path / "lora"
    backbone, prompt = with_random_lora("klein")
    task = DecompositionTask(PanelLayout(("T",)), 48 * 32)
    lora.save_lora(folder, backbone, prompt, task, base_model="tiny:klein", target_modules=["*.attn.*"])
    pipeline = load_pipeline(str(folder), fast_lora=str(fast_file))
    lora.attach_layers(backbone, few_step_layers("klein"), adapter="few_step")
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
    lora.save_lora(tmp_path / "lora", backbone, prompt, task, base_model="tiny:klein")
    with pytest.raises(ModelError, match="which takes one step; expected a model that samples"):
        load_pipeline(str(tmp_path / "lora"), fast_lora=str(fast_file))
    with pytest.raises(ModelError, match=r"a timestep shift was given for .*, which takes one step"):
        load_pipeline(str(tmp_path / "lora"), timestep_shift=3.0)
