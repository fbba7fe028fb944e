"""LoRAs of other programs. The oracle is stock diffusers wherever it reads the same file."""

import json

import diffusers
import pytest
import torch
from safetensors.torch import save_file

from brewster import Separator
from brewster.diffusion.adapter.importer import import_lora, read_layers
from brewster.diffusion.adapter.lora import LORA_FILE, load_lora, read_lora_metadata
from brewster.diffusion.adapter.lora_formats import read_lora_layers, scaling_from_config
from brewster.diffusion.backbones.registry import tiny
from brewster.diffusion.pipeline import load_pipeline
from brewster.diffusion.tensors import read_tensors
from brewster.errors import ModelError
from published_models import diffusers_pipeline, linear_layers, random_pair, velocity

BLOCK = "transformer_blocks.0."
LAYERS = {
    "kontext": [
        *(f"{BLOCK}attn.to_{part}" for part in "qkv"),
        "transformer_blocks.1.ff_context.net.0.proj",
        f"{BLOCK}norm1.linear",
        "single_transformer_blocks.1.proj_out",
    ],
    "klein": [
        *(f"{BLOCK}attn.to_{part}" for part in "qkv"),
        f"{BLOCK}ff.linear_out",
        "single_transformer_blocks.0.attn.to_qkv_mlp_proj",
    ],
    "qwen": [f"{BLOCK}attn.to_q", f"{BLOCK}attn.to_add_out", f"{BLOCK}img_mlp.net.2"],
}


def weights(name):
    """Pairs of random matrices by layer, with ranks 2 and 3."""
    layers = linear_layers(tiny(name, seed=1)[0].transformer)
    generator = torch.Generator().manual_seed(6)
    return {
        key: random_pair(layers[key], 2 + index % 2, generator)
        for index, key in enumerate(LAYERS[name])
    }


def kohya(pairs, prefix="lora_unet_", *, flat=True, alpha=1.0):
    tensors = {}
    for name, (down, up) in pairs.items():
        key = prefix + (name.replace(".", "_") if flat else name)
        tensors |= {
            f"{key}.lora_down.weight": down,
            f"{key}.lora_up.weight": up,
            f"{key}.alpha": torch.tensor(alpha),
        }
    return tensors


def peft(pairs, prefix, adapter=""):
    return {
        f"{prefix}{name}.lora_{part}{adapter}.weight": matrix
        for name, pair in pairs.items()
        for part, matrix in zip("AB", pair, strict=True)
    }


STYLES = {
    "diffusers": lambda name: peft(weights(name), "transformer."),
    "kohya": lambda name: kohya(weights(name)),
    "ComfyUI": lambda name: kohya(weights(name), "diffusion_model.", flat=False),
}


def imported(path, name, folder, alpha=None):
    """The backbone with the imported LoRA, opened as a user opens it."""
    options = {"base_model": f"tiny:{name}", "prompt": "remove the reflection", "panels": ("T",)}
    import_lora(path, folder, **options, alpha=alpha)
    backbone, _ = tiny(name, seed=1)
    load_lora(folder, backbone)
    return backbone


@pytest.mark.parametrize(("name", "style"), [
    *((name, "diffusers") for name in LAYERS), ("qwen", "kohya"), ("qwen", "ComfyUI"),
])  # fmt: skip
def test_each_style_predicts_as_in_stock_diffusers(name, style, tmp_path):
    backbone, prompt = tiny(name, seed=1)
    plain = velocity(backbone, prompt)
    path = tmp_path / "lora.safetensors"
    save_file(STYLES[style](name), path)
    diffusers_pipeline(backbone).load_lora_weights(str(path))
    expected = velocity(backbone, prompt)
    assert (expected - plain).abs().max() > 1e-3
    found = velocity(imported(path, name, tmp_path / "imported"), prompt)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("prefix", "adapter"), [("base_model.model.", ""), ("", ".default"), ("transformer.", ".x")]
)
def test_the_styles_of_peft_predict_as_that_of_diffusers(prefix, adapter, tmp_path):
    """peft also needs alpha. With the rank of the layer, it has no effect, as in diffusers."""
    pairs = {name: pair for name, pair in weights("kontext").items() if len(pair[0]) == 2}
    predictions = []
    alpha = None if prefix == "transformer." else 2
    for index, tensors in enumerate((peft(pairs, "transformer."), peft(pairs, prefix, adapter))):
        save_file(tensors, tmp_path / f"{index}.safetensors")
        path = tmp_path / f"{index}.safetensors"
        folder = tmp_path / str(index)
        backbone = imported(path, "kontext", folder, alpha if index else None)
        predictions.append(velocity(backbone, tiny("kontext", seed=1)[1]))
    assert torch.equal(*predictions)


def test_an_imported_lora_is_opened_by_model_and_by_diffusers(tmp_path):
    path = tmp_path / "lora.safetensors"
    folder = tmp_path / "imported"
    save_file(STYLES["diffusers"]("klein"), path)
    backbone = imported(path, "klein", folder)
    _, prompt = tiny("klein", seed=1)
    stock, _ = tiny("klein", seed=1)
    diffusers_pipeline(stock).load_lora_weights(folder)
    torch.testing.assert_close(
        velocity(stock, prompt), velocity(backbone, prompt), atol=1e-5, rtol=0
    )
    metadata = read_lora_metadata(folder)
    assert (metadata.backbone, metadata.base_model, metadata.rank) == ("klein", "tiny:klein", 3)
    assert metadata.task.layout.panels == ("T",)
    pipeline = load_pipeline(str(folder))
    assert pipeline.prompt.text == "remove the reflection"
    assert Separator.load(str(folder), steps=1).name == "imported"


@pytest.mark.parametrize("name", ["kontext", "klein"])
def test_the_names_of_the_original_code_are_refused_and_diffusers_converts_them(name, tmp_path):
    down = torch.ones(2, 32)
    up = torch.ones(96, 2)
    save_file(kohya({"double_blocks.0.img_attn.qkv": (down, up)}), tmp_path / "lora.safetensors")
    with pytest.raises(
        ModelError, match=r"double_blocks_0_img_attn_qkv .* convert it with lora_state_dict"
    ):
        imported(tmp_path / "lora.safetensors", name, tmp_path / "out")
    backbone, _ = tiny(name, seed=1)
    pipeline = getattr(diffusers, backbone.classes["pipeline"])
    state = pipeline.lora_state_dict(str(tmp_path / "lora.safetensors"))
    save_file(
        {key: tensor.clone() for key, tensor in state.items()}, tmp_path / "converted.safetensors"
    )
    imported(tmp_path / "converted.safetensors", name, tmp_path / "out")
    written, _ = read_tensors(tmp_path / "out" / LORA_FILE)
    assert {key.split(".")[4] for key in written} == {"to_q", "to_k", "to_v"}


def test_the_layer_of_the_top_level_is_not_taken_for_those_of_the_blocks(tmp_path):
    """`proj_out` occurs in each block, too."""
    layers = linear_layers(tiny("kontext", seed=1)[0].transformer)
    pairs = {"proj_out": random_pair(layers["proj_out"], 2, torch.Generator().manual_seed(7))}
    save_file(kohya(pairs, alpha=4.0), tmp_path / "lora.safetensors")
    found = imported(tmp_path / "lora.safetensors", "kontext", tmp_path / "imported")
    adapted = [name for name, _ in found.transformer.named_modules() if name.endswith(".lora_A")]
    assert adapted == ["proj_out.lora_A"]


def test_alphas_come_from_the_metadata_of_diffusers_and_the_settings_of_peft(tmp_path):
    pairs = weights("qwen")
    layers = []
    settings = {"r": 2, "lora_alpha": 4, "alpha_pattern": {f"{BLOCK}attn.to_q": 8}}
    metadata = json.dumps({f"transformer.{key}": value for key, value in settings.items()})
    metadata = {"lora_adapter_metadata": metadata}
    save_file(peft(pairs, "transformer."), tmp_path / "a.safetensors", metadata)
    (tmp_path / "peft").mkdir()
    save_file(peft(pairs, "base_model.model."), tmp_path / "peft" / "adapter_model.safetensors")
    (tmp_path / "peft" / "adapter_config.json").write_text(json.dumps(settings))
    for index, source in enumerate((tmp_path / "a.safetensors", tmp_path / "peft")):
        folder = tmp_path / f"imported{index}"
        import_lora(source, folder, base_model="tiny:qwen", prompt="x", panels=("T",))
        layers.append(read_tensors(folder / LORA_FILE)[0])
    for name, (_, up) in pairs.items():
        alpha = 8 if name.endswith("to_q") else 4
        expected = up * alpha / up.shape[1]
        for tensors in layers:
            torch.testing.assert_close(tensors[f"transformer.{name}.lora_B.weight"], expected)


@pytest.mark.parametrize("prefix", ["base_model.model.", ""])
def test_a_lora_of_peft_without_its_settings_needs_its_alpha(prefix, tmp_path):
    name = f"{BLOCK}attn.to_q"
    path = tmp_path / "adapter_model.safetensors"
    pair = weights("qwen")[name]
    backbone, _ = tiny("qwen", seed=1)
    save_file({key: value.bfloat16() for key, value in peft({name: pair}, prefix).items()}, path)
    with pytest.raises(ModelError, match=r"no alpha for .*to_q; expected adapter_config\.json"):
        read_layers(path, backbone)
    expected = 8 / len(pair[0]) * pair[1].bfloat16().float()
    torch.testing.assert_close(
        read_layers(path, backbone, alpha=8)[f"{name}.lora_B.weight"], expected
    )
    (tmp_path / "adapter_config.json").write_text(json.dumps({"lora_alpha": 8}))
    torch.testing.assert_close(read_layers(path, backbone)[f"{name}.lora_B.weight"], expected)
    with pytest.raises(ModelError, match=r"alpha = 4 was given for .*, which has its own alpha"):
        read_layers(path, backbone, alpha=4)
    path = tmp_path / "kohya" / "lora.safetensors"
    path.parent.mkdir()
    save_file(kohya({name: pair}), path)
    with pytest.raises(ModelError, match="which has its own alpha"):
        read_layers(path, backbone, alpha=4)


def test_the_alphas_of_a_file_win_over_the_settings_next_to_it(tmp_path):
    name = f"{BLOCK}attn.to_q"
    path = tmp_path / "lora.safetensors"
    pair = weights("qwen")[name]
    save_file(kohya({name: pair}, alpha=3.0), path)
    (tmp_path / "adapter_config.json").write_text(json.dumps({"lora_alpha": 8}))
    found = read_layers(path, tiny("qwen", seed=1)[0])[f"{name}.lora_B.weight"]
    torch.testing.assert_close(found, 3 / len(pair[0]) * pair[1])


def test_rank_stabilised_loras_have_their_own_scale():
    assert scaling_from_config({"lora_alpha": 8, "use_rslora": True})("x", 4) == 4
    assert scaling_from_config({"lora_alpha": 8})("x", 4) == 2
    assert scaling_from_config({})("x", 4) == 1


A = torch.zeros(2, 32)
B = torch.zeros(32, 2)
NO_LAYER = "belongs to no layer of qwen"


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"lora_unet_double_blocks_0_img_attn_qkv.lora_down.weight": A}, ("in the style of "
                                                                         f"kohya, {NO_LAYER}")),
        ({"transformer.x.dora_scale": torch.zeros(2)}, NO_LAYER),
        ({"lycoris_a.lokr_w1": torch.zeros(2)}, NO_LAYER),
        ({"diffusion_model.img_in.diff_b": torch.zeros(2)}, NO_LAYER),
        ({f"base_model.model.{BLOCK}attn.to_q.lora_B.bias": torch.zeros(2)}, NO_LAYER),
        ({f"{BLOCK}attn.to_q.lora.down.weight": A}, NO_LAYER),
        ({f"{BLOCK}attn.processor.to_q_lora.up.weight": B}, NO_LAYER),
        ({"double_blocks.0.processor.proj_lora1.down.weight": A}, NO_LAYER),
        ({"lora_te1_text_model.lora_down.weight": torch.zeros(2, 2)}, NO_LAYER),
        ({f"transformer.{BLOCK}attn.to_q.lora_A.weight": A}, "only one of two matrices"),
        ({"weight": torch.zeros(2)}, "in the style of unknown"),
        ({"model.diffusion_model.x.lora_A.weight": A}, ("the key x of the LoRA, in the style of "
                                                       "ComfyUI")),
        ({}, "contains no LoRA"),
        (
            {f"transformer.{BLOCK}attn.to_q.lora_{part}.weight": torch.zeros(*size)
             for part, size in (("A", (2, 33)), ("B", (32, 2)))},
            "expected a layer with 32 x 32 weights",
        ),
    ],
)  # fmt: skip
def test_what_is_not_understood_is_one_clear_sentence(tensors, message, tmp_path):
    save_file(tensors, tmp_path / "lora.safetensors")
    with pytest.raises(ModelError, match=message):
        imported(tmp_path / "lora.safetensors", "qwen", tmp_path / "out")
    assert not (tmp_path / "out").exists()


TO_Q = f"{BLOCK}attn.to_q"


@pytest.mark.parametrize(("first", "second"), [
    ((TO_Q, "transformer.", ""), (TO_Q, "diffusion_model.", "")),
    ((TO_Q, "transformer.", ""), (TO_Q.replace(".", "_"), "lora_transformer_", "")),
    ((TO_Q, "transformer.", ".first"), (TO_Q, "transformer.", ".second")),
])  # fmt: skip
def test_a_layer_that_occurs_twice_is_refused(first, second):
    transformer = tiny("kontext", seed=1)[0].transformer
    tensors = {}
    for name, prefix, adapter in (first, second):
        tensors |= peft({name: weights("kontext")[TO_Q]}, prefix, adapter)
    with pytest.raises(ModelError, match=r"more than one LoRA for the layer .*to_q"):
        read_lora_layers(tensors, transformer, "kontext")


def test_a_lora_is_imported(run_without_model, tmp_path):
    matrices = torch.ones(2, 32), torch.ones(32, 2)
    tensors = peft({f"{BLOCK}attn.to_q": matrices}, "transformer.")
    save_file(tensors, tmp_path / "lora.safetensors")
    arguments = ("models", "import", "lora.safetensors", "imported", "--base-model", "tiny:kontext")
    code, _, err = run_without_model(*arguments)
    assert (code, "--prompt" in err) == (2, True)
    code, _, err = run_without_model(
        *arguments, "--prompt", "remove the reflection", "--panels", "T,R", "--alpha", "4"
    )
    assert (code, "use it with: --model imported" in err) == (0, True)
    written, _ = read_tensors(tmp_path / "imported" / LORA_FILE)
    assert torch.equal(written[f"transformer.{BLOCK}attn.to_q.lora_B.weight"], 4 / 2 * matrices[1])
    assert read_lora_metadata(tmp_path / "imported").task.layout.panels == ("T", "R")
    code, _, err = run_without_model(
        *arguments, "--prompt", "another", "--panels", "T", "--alpha", "4"
    )
    assert (code, "imported exists already" in err) == (1, True)
