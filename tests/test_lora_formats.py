"""LoRAs of other programs. The oracle is stock diffusers wherever it reads the same file."""

import json

import pytest
import torch
from safetensors.torch import save_file

from brewster import Separator
from brewster.errors import ModelError
from brewster.models.diffusion.adapter.importer import import_lora, read_layers
from brewster.models.diffusion.adapter.lora import LORA_FILE, load_lora, read_lora_metadata
from brewster.models.diffusion.adapter.lora_formats import read_lora_layers, scaling_from_config
from brewster.models.diffusion.backbones.registry import tiny
from brewster.models.diffusion.pipeline import load_pipeline
from brewster.models.diffusion.tensors import read_tensors
from published_models import diffusers_pipeline, linear_layers, random_pair, velocity

# Layers in diffusers, and the layer of the original code that contains them one after the other.
BLOCK = "transformer_blocks.0."
KONTEXT = {
    "double_blocks.0.img_attn.qkv": [f"{BLOCK}attn.to_{part}" for part in "qkv"],
    "double_blocks.0.txt_attn.qkv": [f"{BLOCK}attn.add_{part}_proj" for part in "qkv"],
    "double_blocks.1.txt_mlp.0": ["transformer_blocks.1.ff_context.net.0.proj"],
    "double_blocks.0.img_mod.lin": [f"{BLOCK}norm1.linear"],
    "single_blocks.1.linear2": ["single_transformer_blocks.1.proj_out"],
}
KLEIN = {
    "double_blocks.0.img_attn.qkv": [f"{BLOCK}attn.to_{part}" for part in "qkv"],
    "double_blocks.0.txt_attn.proj": [f"{BLOCK}attn.to_add_out"],
    "double_blocks.0.img_mlp.2": [f"{BLOCK}ff.linear_out"],
    "single_blocks.0.linear1": ["single_transformer_blocks.0.attn.to_qkv_mlp_proj"],
    "single_blocks.0.linear2": ["single_transformer_blocks.0.attn.to_out"],
}
QWEN = {name: [name] for name in (f"{BLOCK}attn.to_q", f"{BLOCK}attn.to_add_out", f"{BLOCK}img_mlp.net.2")}
ORIGINAL = {"kontext": KONTEXT, "klein": KLEIN, "qwen": QWEN}


def fused(layers):
    """A linear layer of the original code, which has the rows of several layers in diffusers."""
    return torch.nn.Linear(layers[0].in_features, sum(layer.out_features for layer in layers), device="meta")


def weights(name, *, original):
    """Pairs of random matrices by layer, with ranks 2 and 3."""
    layers, generator = linear_layers(tiny(name, seed=1)[0].transformer), torch.Generator().manual_seed(6)
    table = ORIGINAL[name]
    if not original:
        table = {target: [target] for parts in table.values() for target in parts}
    return {
        key: random_pair(fused([layers[part] for part in parts]), 2 + index % 2, generator)
        for index, (key, parts) in enumerate(table.items())
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
    "diffusers": lambda name: peft(weights(name, original=False), "transformer."),
    "kohya": lambda name: kohya(weights(name, original=True)),
    "ComfyUI": lambda name: (
        peft(weights(name, original=True), "diffusion_model.")
        if name == "klein"  # stock diffusers ignores the other spelling
        else kohya(weights(name, original=True), "diffusion_model.", flat=False)
    ),
}


def imported(path, name, folder, alpha=None):
    """The backbone with the imported LoRA, opened as a user opens it."""
    options = {"base_model": f"tiny:{name}", "prompt": "remove the reflection", "panels": ("T",)}
    import_lora(str(path), folder, **options, alpha=alpha)
    backbone, _ = tiny(name, seed=1)
    load_lora(folder, backbone)
    return backbone


@pytest.mark.parametrize("style", list(STYLES))
@pytest.mark.parametrize("name", list(ORIGINAL))
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


@pytest.mark.parametrize(("prefix", "adapter"), [("base_model.model.", ""), ("", ".default"), ("transformer.", ".x")])
def test_the_styles_of_peft_predict_as_that_of_diffusers(prefix, adapter, tmp_path):
    """peft also needs alpha. With the rank of the layer, it has no effect, as in diffusers."""
    pairs = {name: pair for name, pair in weights("kontext", original=False).items() if len(pair[0]) == 2}
    predictions = []
    alpha = None if prefix == "transformer." else 2
    for index, tensors in enumerate((peft(pairs, "transformer."), peft(pairs, prefix, adapter))):
        save_file(tensors, tmp_path / f"{index}.safetensors")
        path, folder = tmp_path / f"{index}.safetensors", tmp_path / str(index)
        backbone = imported(path, "kontext", folder, alpha if index else None)
        predictions.append(velocity(backbone, tiny("kontext", seed=1)[1]))
    assert torch.equal(*predictions)


def test_an_imported_lora_is_opened_by_model_and_by_diffusers(tmp_path):
    path, folder = tmp_path / "lora.safetensors", tmp_path / "imported"
    save_file(STYLES["kohya"]("klein"), path)
    backbone = imported(path, "klein", folder)
    _, prompt = tiny("klein", seed=1)
    stock, _ = tiny("klein", seed=1)
    diffusers_pipeline(stock).load_lora_weights(folder)
    torch.testing.assert_close(velocity(stock, prompt), velocity(backbone, prompt), atol=1e-5, rtol=0)
    metadata = read_lora_metadata(folder)
    assert (metadata.backbone, metadata.base_model, metadata.rank) == ("klein", "tiny:klein", 3)
    assert metadata.task.layout.panels == ("T",)
    pipeline = load_pipeline(str(folder))
    assert pipeline.prompt.text == "remove the reflection"
    assert Separator.load(str(folder), steps=1).name == "imported"


def test_a_layer_of_several_is_split_by_rows_and_the_top_level_layer_is_not_mistaken(tmp_path):
    """`linear1` is q, k, v and the MLP, and `proj_out` occurs twice. diffusers assumes the sizes of the full model."""
    transformer = tiny("kontext", seed=1)[0].transformer
    layers, generator = linear_layers(transformer), torch.Generator().manual_seed(7)
    single = "single_transformer_blocks.0."
    parts = [f"{single}attn.to_q", f"{single}attn.to_k", f"{single}attn.to_v", f"{single}proj_mlp"]
    pairs = {
        "single_blocks.0.linear1": random_pair(fused([layers[part] for part in parts]), 2, generator),
        "final_layer.linear": random_pair(layers["proj_out"], 5, generator),
        "final_layer.adaLN_modulation.1": random_pair(layers["norm_out.linear"], 2, generator),
    }
    save_file(kohya(pairs, alpha=4.0), tmp_path / "lora.safetensors")
    found = imported(tmp_path / "lora.safetensors", "kontext", tmp_path / "imported")
    expected, prompt = tiny("kontext", seed=1)
    changes = {name: 4 / len(down) * up @ down for name, (down, up) in pairs.items()}
    sizes = [layers[part].out_features for part in parts]
    merged = dict(zip(parts, changes["single_blocks.0.linear1"].split(sizes), strict=True))
    shift, scale = changes["final_layer.adaLN_modulation.1"].chunk(2)
    merged |= {"proj_out": changes["final_layer.linear"], "norm_out.linear": torch.cat([scale, shift])}
    with torch.no_grad():
        for name, change in merged.items():
            expected.transformer.get_submodule(name).weight += change
    torch.testing.assert_close(velocity(found, prompt), velocity(expected, prompt), atol=1e-5, rtol=0)
    adapted = [name for name, _ in found.transformer.named_modules() if name.endswith(".lora_A")]
    assert {name.removesuffix(".lora_A") for name in adapted} == set(merged)


def test_alphas_come_from_the_metadata_of_diffusers_and_the_settings_of_peft(tmp_path):
    pairs = weights("qwen", original=False)
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
        import_lora(str(source), folder, base_model="tiny:qwen", prompt="x", panels=("T",))
        layers.append(read_tensors(folder / LORA_FILE)[0])
    for name, (_, up) in pairs.items():
        alpha = 8 if name.endswith("to_q") else 4
        expected = up * alpha / up.shape[1]
        for tensors in layers:
            torch.testing.assert_close(tensors[f"transformer.{name}.lora_B.weight"], expected)


@pytest.mark.parametrize("prefix", ["base_model.model.", ""])
def test_a_lora_of_peft_without_its_settings_needs_its_alpha(prefix, tmp_path):
    name, path = f"{BLOCK}attn.to_q", tmp_path / "adapter_model.safetensors"
    pair, (backbone, _) = weights("qwen", original=False)[name], tiny("qwen", seed=1)
    save_file({key: value.bfloat16() for key, value in peft({name: pair}, prefix).items()}, path)
    with pytest.raises(ModelError, match=r"no alpha for .*to_q; expected adapter_config\.json"):
        read_layers(path, backbone)
    expected = 8 / len(pair[0]) * pair[1].bfloat16().float()
    torch.testing.assert_close(read_layers(path, backbone, alpha=8)[f"{name}.lora_B.weight"], expected)
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
    name, path = f"{BLOCK}attn.to_q", tmp_path / "lora.safetensors"
    pair = weights("qwen", original=False)[name]
    save_file(kohya({name: pair}, alpha=3.0), path)
    (tmp_path / "adapter_config.json").write_text(json.dumps({"lora_alpha": 8}))
    found = read_layers(path, tiny("qwen", seed=1)[0])[f"{name}.lora_B.weight"]
    torch.testing.assert_close(found, 3 / len(pair[0]) * pair[1])


def test_rank_stabilised_loras_have_their_own_scale():
    assert scaling_from_config({"lora_alpha": 8, "use_rslora": True})("x", 4) == 4
    assert scaling_from_config({"lora_alpha": 8})("x", 4) == 2
    assert scaling_from_config({})("x", 4) == 1


A, B = torch.zeros(2, 32), torch.zeros(32, 2)
NO_LAYER = "belongs to no layer of qwen"


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"lora_unet_double_blocks_0_img_attn_qkv.lora_down.weight": A}, f"in the style of kohya, {NO_LAYER}"),
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
        ({"model.diffusion_model.x.lora_A.weight": A}, "the key x of the LoRA, in the style of ComfyUI"),
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


TO_Q, QKV = f"{BLOCK}attn.to_q", "double_blocks.0.img_attn.qkv"


@pytest.mark.parametrize(("first", "second"), [
    ((TO_Q, "transformer.", ""), (TO_Q, "diffusion_model.", "")),
    ((TO_Q, "transformer.", ""), (TO_Q.replace(".", "_"), "lora_transformer_", "")),
    ((TO_Q, "transformer.", ""), (QKV, "diffusion_model.", "")),
    ((TO_Q, "transformer.", ".first"), (TO_Q, "transformer.", ".second")),
])  # fmt: skip
def test_a_layer_that_occurs_twice_is_refused(first, second):
    transformer, tensors = tiny("kontext", seed=1)[0].transformer, {}
    for name, prefix, adapter in (first, second):
        pairs = weights("kontext", original=name == QKV)
        tensors |= peft({name: pairs[QKV if name == QKV else TO_Q]}, prefix, adapter)
    with pytest.raises(ModelError, match=r"more than one LoRA for the layer .*to_q"):
        read_lora_layers(tensors, transformer, "kontext")


def test_a_lora_is_imported(run_without_model, tmp_path):
    matrices = torch.ones(2, 32), torch.ones(32, 2)
    tensors = peft({f"{BLOCK}attn.to_q": matrices}, "transformer.")
    save_file(tensors, tmp_path / "lora.safetensors")
    arguments = ("models", "import", "lora.safetensors", "imported", "--base-model", "tiny:kontext")
    code, _, err = run_without_model(*arguments)
    assert (code, "--prompt" in err) == (2, True)
    code, _, err = run_without_model(*arguments, "--prompt", "remove the reflection", "--panels", "T,R", "--alpha", "4")
    assert (code, "use it with: --model imported" in err) == (0, True)
    written, _ = read_tensors(tmp_path / "imported" / LORA_FILE)
    assert torch.equal(written[f"transformer.{BLOCK}attn.to_q.lora_B.weight"], 4 / 2 * matrices[1])
    assert read_lora_metadata(tmp_path / "imported").task.layout.panels == ("T", "R")
    code, _, err = run_without_model(*arguments, "--prompt", "another", "--panels", "T", "--alpha", "4")
    assert (code, "imported exists already" in err) == (1, True)
