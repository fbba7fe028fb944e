"""LoRAs on tiny versions of the backbones: training, saving, loading."""

import copy

import pytest
import torch
from torch import nn

from brewster.diffusion.adapter import lora
from brewster.diffusion.backbones.registry import BACKBONES, build, tiny
from brewster.diffusion.task import DecompositionTask
from brewster.diffusion.tensors import read_tensors, write_tensors
from brewster.errors import ModelError
from published_models import diffusers_pipeline, velocity


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
    linear = {
        name
        for name, module in backbone.transformer.named_modules()
        if isinstance(module, nn.Linear)
    }
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
    assert sum(map(torch.numel, parameters)) == sum(
        map(torch.numel, lora.lora_state_dict(backbone).values())
    )
    velocity(backbone, prompt).square().mean().backward()
    named = backbone.transformer.named_parameters()
    without_gradient = {name for name, part in named if "lora_" in name and part.grad is None}
    # The text output of Qwen's last block is unused, so its layers get no gradient (DDP:
    # find_unused_parameters).
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
    with pytest.raises(
        ModelError, match=r"matches the target 'to_q'; expected a name with wildcards"
    ):
        lora.add_lora(fresh, target_modules=["to_q"])


@pytest.mark.parametrize("alpha", [4, 16])
def test_a_saved_lora_gives_the_same_prediction_reloaded_and_in_diffusers(
    tiny_model, tmp_path, alpha
):
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
    write_tensors(
        folder / lora.LORA_FILE,
        tensors,
        entries | {"brewster": lora.LoraMetadata(**metadata).to_json()},
    )


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


def test_the_metadata_of_an_earlier_version_are_read():
    text = lora.LoraMetadata("klein", "klein", None, 4, 4, DecompositionTask(), "0" * 64).to_json()
    earlier = text.replace('"layout"', '"last_sigma": null, "layout"').replace(
        '"time": 1.0', '"time": 1.0, "timestep_shift": null'
    )
    assert earlier != text
    assert lora.LoraMetadata.from_json(earlier).to_json() == text
    with pytest.raises(
        ModelError, match=r"the metadata of the LoRA cannot be read: .*timestep_shift"
    ):
        lora.LoraMetadata.from_json(
            earlier.replace('"timestep_shift": null', '"timestep_shift": 3.0')
        )
