"""The table of diffusion backbones: loading of tiny versions, and all errors for damaged or wrong
folders.
"""

import importlib.metadata
import importlib.util
import json
import shutil
import sys
from types import ModuleType

import pytest
import torch
import transformers
from tokenizers.pre_tokenizers import ByteLevel
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

from brewster.diffusion import lazy_imports
from brewster.diffusion.adapter.lora import add_lora
from brewster.diffusion.backbones import loading
from brewster.diffusion.backbones.loading import encode_prompt, load_backbone
from brewster.diffusion.backbones.qwen import Qwen
from brewster.diffusion.backbones.registry import BACKBONES, build, tiny
from brewster.diffusion.memory import BACKBONE_COSTS
from brewster.diffusion.prompt import PROMPT
from brewster.errors import ModelError
from published_models import diffusers_pipeline, save_backbone, velocity


@pytest.fixture(scope="module")
def tiny_folders(tmp_path_factory):
    """Folders of tiny versions; tests must not change them."""
    folder = tmp_path_factory.mktemp("tiny")
    for name in BACKBONES:
        save_backbone(tiny(name, seed=1)[0], folder / name)
    return folder


@pytest.fixture
def folder(tiny_folders, tmp_path):
    """A folder of a tiny Kontext that a test may change."""
    return shutil.copytree(tiny_folders / "kontext", tmp_path / "kontext")


@pytest.mark.parametrize("name", list(BACKBONES))
def test_a_tiny_version_survives_saving_and_loading(tiny_folders, name):
    original, prompt = tiny(name, seed=1)
    loaded = load_backbone(str(tiny_folders / name))
    assert type(loaded) is BACKBONES[name]
    weights = loaded.transformer.state_dict()
    assert all(
        torch.equal(weights[key], value) for key, value in original.transformer.state_dict().items()
    )
    torch.testing.assert_close(
        velocity(loaded, prompt), velocity(original, prompt), atol=1e-6, rtol=0
    )
    assert not any(parameter.requires_grad for parameter in loaded.transformer.parameters())


@pytest.mark.parametrize("name", list(BACKBONES))
def test_tiny_versions_have_the_classes_of_the_full_size_models_and_differ_by_seed_only(name):
    original, prompt = tiny(name, seed=1)
    same, same_prompt = tiny(name, seed=1)
    other, other_prompt = tiny(name, seed=2)
    parts = {
        "transformer": original.transformer,
        "vae": original.vae,
        "scheduler": original.scheduler,
    }
    assert {
        part: type(value).__name__ for part, value in parts.items()
    }.items() <= original.classes.items()
    assert torch.equal(velocity(original, prompt), velocity(same, same_prompt))
    assert not torch.equal(velocity(original, prompt), velocity(other, prompt))
    assert prompt.sha256 == same_prompt.sha256 != other_prompt.sha256
    assert prompt.text == PROMPT


@pytest.mark.parametrize(
    ("name", "billions", "targets"),
    [("kontext", 11.90, 494), ("klein", 3.88, 100), ("qwen", 20.43, 840)],
)
def test_full_size_architectures_need_no_memory_on_the_meta_device(name, billions, targets):
    backbone = build(name, device="meta", dtype=torch.bfloat16)
    parameters = sum(parameter.numel() for parameter in backbone.transformer.parameters())
    assert parameters / 1e9 == pytest.approx(billions, abs=0.005)
    assert len(backbone.lora_targets()) == targets
    assert backbone.dtype == torch.bfloat16
    vae = sum(parameter.numel() for parameter in backbone.vae.parameters())
    cost = BACKBONE_COSTS[backbone.name]
    assert (parameters, vae) == (cost.transformer, cost.vae)


@pytest.mark.parametrize("name", list(BACKBONES))
def test_latent_statistics_are_applied_and_inverted(name, monkeypatch):
    backbone, _ = tiny(name, seed=1)
    mean, deviation = backbone.statistics()
    assert mean.abs().max() > 0.05
    assert (deviation - 1).abs().max() > 0.05
    grid = torch.randn(1, backbone.channels // 4, 4, 4)
    monkeypatch.setattr(backbone, "_vae_encode", lambda image: grid)
    black = torch.zeros(1, 3, 32, 32)
    decoded = []
    monkeypatch.setattr(backbone, "_vae_decode", lambda latent: decoded.append(latent) or black)
    backbone.decode(backbone.encode(black))
    torch.testing.assert_close(decoded, [grid])


def test_a_quantized_base_predicts_nearly_the_same_and_trains_a_lora(tiny_folders):
    plain, prompt = tiny("kontext", seed=1)
    quantized = load_backbone(
        str(tiny_folders / "kontext"), quantization="int8", dtype=torch.bfloat16
    )
    weight = quantized.transformer.transformer_blocks[0].attn.to_q.weight
    assert type(weight) not in {torch.Tensor, torch.nn.Parameter}
    expected = velocity(plain, prompt)
    assert (velocity(quantized, prompt) - expected).std() < 0.2 * expected.std()
    parameters = add_lora(quantized, rank=2)
    velocity(quantized, prompt).square().mean().backward()
    assert any(parameter.grad.abs().max() > 0 for parameter in parameters)
    assert {parameter.dtype for parameter in parameters} == {torch.float32}


def test_a_base_that_was_silently_left_unquantized_is_refused(tiny_folders, monkeypatch):
    monkeypatch.setattr(loading, "_device_map", lambda device: {"device_map": {"": device}})
    with pytest.raises(
        ModelError, match=r"loaded as torch\.bfloat16; expected weights stored as int8"
    ):
        load_backbone(str(tiny_folders / "kontext"), quantization="int8", dtype=torch.bfloat16)


@pytest.mark.parametrize("name", list(BACKBONES))
def test_a_base_computes_in_the_dtype_in_which_it_was_loaded(tiny_folders, name):
    """bitsandbytes stores weights as integers, and diffusers may keep the first floating-point
    layer in float32.
    """
    loaded = load_backbone(str(tiny_folders / name), dtype=torch.bfloat16)
    first = next(loaded.transformer.parameters())
    first.data = first.data.float()
    assert loaded.transformer.dtype == torch.float32
    backbone = type(loaded)(loaded.transformer, loaded.vae, loaded.scheduler, dtype=torch.bfloat16)
    assert loaded.dtype == backbone.dtype == torch.bfloat16


class StoredIn4Bits(torch.nn.Parameter):
    """A parameter of another type than those in full precision, like that of bitsandbytes."""


@pytest.mark.parametrize(
    ("name", "skipped"),
    [("qwen", ["transformer_blocks.0.img_mod"]), ("kontext", None), ("klein", None)],
)
def test_nf4_leaves_layers_in_full_precision_that_the_backbone_names(
    tiny_folders, monkeypatch, name, skipped
):
    """The stand-in for the loader of diffusers stores all other layers in 4 bits, as bitsandbytes
    does on a GPU.
    """
    version = importlib.metadata.version
    ours = {"bitsandbytes": "0.50.2"}
    monkeypatch.setattr(importlib.metadata, "version", lambda name: ours.get(name) or version(name))
    monkeypatch.setitem(sys.modules, "bitsandbytes", ModuleType("bitsandbytes"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(loading, "_device_map", lambda device: {})
    load_part = loading._load_part
    configs = []

    def load(folder, backbone_class, part, *, quantization_config=None, **options):
        model = load_part(folder, backbone_class, part, **options)
        if quantization_config:
            configs.append(quantization_config)
            for layer, module in model.named_modules():
                is_skipped = layer.startswith(
                    tuple(quantization_config.llm_int8_skip_modules or ())
                )
                if isinstance(module, torch.nn.Linear) and not is_skipped:
                    module.weight = StoredIn4Bits(module.weight, requires_grad=False)
        return model

    monkeypatch.setattr(loading, "_load_part", load)
    backbone = load_backbone(str(tiny_folders / name), device="cuda", quantization="nf4")
    assert [config.llm_int8_skip_modules for config in configs] == [skipped]
    assert [config.quantization_method() for config in configs] == ["nf4"]
    weights = {
        name: backbone.transformer.get_submodule(name).weight for name in backbone.lora_targets()
    }
    kept = [name for name, weight in weights.items() if type(weight) is torch.nn.Parameter]
    assert kept == (["transformer_blocks.0.img_mod.1"] if skipped else [])


@pytest.fixture(scope="module")
def text_encoder_folders(tmp_path_factory):
    """Folders of tiny versions with text encoders, and tokenizers whose tokens are single bytes."""
    folder = tmp_path_factory.mktemp("words")
    letters = sorted(ByteLevel.alphabet())
    torch.manual_seed(0)
    clip_words = [
        *letters,
        *(letter + "</w>" for letter in letters),
        "<|startoftext|>",
        "<|endoftext|>",
    ]
    clip_words = {word: index for index, word in enumerate(clip_words)}
    clip = transformers.CLIPTokenizer(vocab=clip_words, merges=[], model_max_length=77)
    t5_words = ["<pad>", "</s>", "<unk>", "\u2581", *map(chr, range(33, 127))]
    t5 = transformers.T5TokenizerFast(vocab=[(word, -1.0) for word in t5_words], extra_ids=0)
    qwen_words = [*letters, "<|endoftext|>", "<|im_start|>", "<|im_end|>"]
    words = {word: index for index, word in enumerate(qwen_words)}
    qwen = transformers.Qwen2TokenizerFast(vocab=words, merges=[])
    qwen.chat_template = "{% for m in messages %}<|im_start|>{{ m.content }}<|im_end|>{% endfor %}"
    small = {"intermediate_size": 16, "num_attention_heads": 2, "hidden_size": 16}
    clip_config = transformers.CLIPTextConfig(vocab_size=len(clip), num_hidden_layers=1, **small)
    t5_sizes = {"d_model": 32, "d_kv": 8, "d_ff": 16, "num_layers": 1, "num_heads": 2}
    t5_config = transformers.T5Config(vocab_size=len(t5), **t5_sizes)
    qwen_sizes = {"num_hidden_layers": 28, "num_key_value_heads": 1, "head_dim": 8}
    qwen_config = transformers.Qwen3Config(vocab_size=300, **qwen_sizes, **small)
    kontext = {"tokenizer": clip, "text_encoder": transformers.CLIPTextModel(clip_config)}
    kontext |= {"tokenizer_2": t5, "text_encoder_2": transformers.T5EncoderModel(t5_config)}
    klein = {"tokenizer": qwen, "text_encoder": transformers.Qwen3ForCausalLM(qwen_config)}
    text_modules = {"kontext": kontext, "klein": klein}
    lazy_imports.disable_progress_bars_in_pipes()
    for name, modules in text_modules.items():
        pipeline = diffusers_pipeline(tiny(name)[0])
        pipeline.register_modules(**modules)
        pipeline.save_pretrained(folder / name)
    return folder


@pytest.mark.parametrize(("name", "shapes"), [
    ("kontext", {"embeds": (1, 512, 32), "pooled": (1, 16)}),
    ("klein", {"embeds": (1, 512, 48), "negative": (1, 512, 48)}),
])  # fmt: skip
def test_a_prompt_is_encoded_by_the_text_encoders_of_the_folder(text_encoder_folders, name, shapes):
    prompt = encode_prompt(str(text_encoder_folders / name))
    assert (prompt.backbone, prompt.text) == (name, PROMPT)
    assert {key: tuple(tensor.shape) for key, tensor in prompt.tensors.items()} == shapes
    assert {tensor.dtype for tensor in prompt.tensors.values()} == {torch.bfloat16}
    assert encode_prompt(str(text_encoder_folders / name)).sha256 == prompt.sha256
    assert not torch.equal(
        encode_prompt(str(text_encoder_folders / name), "a cat").embeds, prompt.embeds
    )


INDEX = "model_index.json"
CONFIG = "transformer/config.json"
WEIGHTS = "diffusion_pytorch_model.safetensors"


@pytest.mark.parametrize(("name", "change", "message"), [
    (f"transformer/{WEIGHTS}", lambda data: b"", ("transformer cannot be loaded.*download the "
                                                 "model again")),
    (INDEX, lambda data: data.replace(b"FluxKontext", b"Other"), "contains a OtherPipeline"),
    (CONFIG, lambda data: with_values(data, num_layers=3), "transformer"),
    (CONFIG, lambda data: data.replace(b"FluxT", b"QwenImageT"), ("expected a "
                                                                 "FluxTransformer2DModel")),
])  # fmt: skip
def test_a_damaged_or_other_file_is_refused(folder, name, change, message):
    (folder / name).write_bytes(change((folder / name).read_bytes()))
    with pytest.raises(ModelError, match=message):
        load_backbone(str(folder))


def with_values(data, **values):
    return json.dumps(json.loads(data) | values).encode()


SPECIAL_TOKENS = [
    "<|endoftext|>",
    "<|im_start|>",
    "<|im_end|>",
    "<|vision_start|>",
    "<|vision_end|>",
]
SPECIAL_TOKENS += ["<|image_pad|>", "<|video_pad|>"]
IMAGE_TOKENS = 16


class WithoutVideo(transformers.Qwen2VLProcessor):
    """The processor without the check for a video processor, which needs torchvision."""

    def check_argument_for_proper_class(self, name, argument):
        if name != "video_processor":
            super().check_argument_for_proper_class(name, argument)


@pytest.fixture(scope="module")
def pipeline():
    """The diffusers pipeline with a tokenizer of single bytes. It encodes an image as 16 tokens."""
    words = {
        word: number for number, word in enumerate([*sorted(ByteLevel.alphabet()), *SPECIAL_TOKENS])
    }
    special = {"additional_special_tokens": SPECIAL_TOKENS}
    tokenizer = transformers.Qwen2TokenizerFast(vocab=words, merges=[], **special)
    image_processor = Qwen2VLImageProcessorPil(
        min_pixels=28 * 28, max_pixels=28 * 28 * IMAGE_TOKENS
    )
    text = {
        "vocab_size": len(words),
        "hidden_size": 32,
        "intermediate_size": 16,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
        "bos_token_id": 0,
        "eos_token_id": 0,
        "rope_scaling": {"type": "mrope", "mrope_section": [2, 3, 3]},
    }
    vision = {
        "depth": 1,
        "hidden_size": 16,
        "intermediate_size": 16,
        "num_heads": 2,
        "out_hidden_size": 32,
    }
    marks = ("image", "_pad"), ("video", "_pad"), ("vision_start", ""), ("vision_end", "")
    tokens = {f"{name}_token_id": words[f"<|{name}{end}|>"] for name, end in marks}
    vision["fullatt_block_indexes"] = [0]
    config = transformers.Qwen2_5_VLConfig(text_config=text, vision_config=vision, **tokens)
    torch.manual_seed(0)
    pipeline = diffusers_pipeline(tiny("qwen")[0])
    pipeline.register_modules(
        tokenizer=tokenizer,
        processor=WithoutVideo(image_processor=image_processor, tokenizer=tokenizer),
        text_encoder=transformers.Qwen2_5_VLForConditionalGeneration(config).eval(),
    )
    return pipeline


def test_a_prompt_is_encoded_with_a_uniform_grey_image(pipeline):
    calls = []
    hook = pipeline.text_encoder.register_forward_pre_hook(
        lambda module, args, kwargs: calls.append(kwargs), with_kwargs=True
    )
    with torch.no_grad():
        prompt = Qwen.embed(pipeline, PROMPT)
    hook.remove()
    for words, kwargs, embeds in zip(
        (PROMPT, " "), calls, (prompt.embeds, prompt.negative), strict=True
    ):
        token_ids = pipeline.tokenizer(pipeline.prompt_template_encode.format(words)).input_ids
        count = len(token_ids) - 1 + IMAGE_TOKENS - pipeline.prompt_template_encode_start_idx
        assert embeds.shape == (1, count, 32)
        processor = pipeline.processor.image_processor
        mean = torch.tensor(processor.image_mean)
        std = torch.tensor(processor.image_std)
        grey = (128 / 255 - mean) / std
        pixels = kwargs["pixel_values"].unflatten(1, (3, -1))
        torch.testing.assert_close(
            pixels, grey[:, None].expand_as(pixels).to(pixels), atol=1e-5, rtol=0
        )
    assert (prompt.backbone, prompt.text, prompt.pooled) == ("qwen", PROMPT, None)


def test_other_prompts_have_other_embeddings_that_guide_and_the_same_empty_prompt(pipeline):
    with torch.no_grad():
        one, same, other = (Qwen.embed(pipeline, words) for words in ("a cat", "a cat", "a dog"))
    assert one.sha256 == same.sha256
    assert not torch.equal(one.embeds, other.embeds)
    assert torch.equal(one.negative, other.negative)
    backbone, _ = tiny("qwen")
    with torch.no_grad():
        latents = backbone.noise((96, 32), 0)
        plain, guided = (
            backbone.predict(latents, latents, torch.ones(1), one, guidance)
            for guidance in (1.0, 4.0)
        )
    assert guided.isfinite().all()
    assert not torch.allclose(plain, guided, atol=1e-4)
