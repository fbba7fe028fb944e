"""Qwen's prompt through the real pipeline of diffusers, with a tiny version of its text and image encoder."""

import math

import diffusers
import numpy as np
import pytest
import torch
import transformers
from tokenizers.pre_tokenizers import ByteLevel
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

from brewster.models.diffusion.backbones.qwen import Qwen
from brewster.models.diffusion.backbones.registry import tiny
from brewster.models.diffusion.prompt import PROMPT
from published_models import diffusers_pipeline

SPECIAL_TOKENS = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>"]
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
    words = {word: number for number, word in enumerate([*sorted(ByteLevel.alphabet()), *SPECIAL_TOKENS])}
    special = {"additional_special_tokens": SPECIAL_TOKENS}
    tokenizer = transformers.Qwen2TokenizerFast(vocab=words, merges=[], **special)
    image_processor = Qwen2VLImageProcessorPil(min_pixels=28 * 28, max_pixels=28 * 28 * IMAGE_TOKENS)
    text = {
        "vocab_size": len(words), "hidden_size": 32, "intermediate_size": 16, "num_hidden_layers": 2,
        "num_attention_heads": 2, "num_key_value_heads": 1, "bos_token_id": 0, "eos_token_id": 0,
        "rope_scaling": {"type": "mrope", "mrope_section": [2, 3, 3]},
    }  # fmt: skip
    vision = {"depth": 1, "hidden_size": 16, "intermediate_size": 16, "num_heads": 2, "out_hidden_size": 32}
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
    for words, kwargs, embeds in zip((PROMPT, " "), calls, (prompt.embeds, prompt.negative), strict=True):
        token_ids = pipeline.tokenizer(pipeline.prompt_template_encode.format(words)).input_ids
        count = len(token_ids) - 1 + IMAGE_TOKENS - pipeline.prompt_template_encode_start_idx
        assert embeds.shape == (1, count, 32)
        processor = pipeline.processor.image_processor
        mean, std = torch.tensor(processor.image_mean), torch.tensor(processor.image_std)
        grey = (128 / 255 - mean) / std
        pixels = kwargs["pixel_values"].unflatten(1, (3, -1))
        torch.testing.assert_close(pixels, grey[:, None].expand_as(pixels).to(pixels), atol=1e-5, rtol=0)
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
            backbone.predict(latents, latents, torch.ones(1), one, guidance) for guidance in (1.0, 4.0)
        )
    assert guided.isfinite().all()
    assert not torch.allclose(plain, guided, atol=1e-4)


@pytest.mark.parametrize("steps", [4, 8])
def test_a_shift_of_three_gives_the_published_sigmas_of_few_step_loras(steps):
    """Qwen-Image-Lightning: the exponential shift by log 3 for all sizes, without a terminal sigma."""
    sizes = {"base_image_seq_len": 256, "max_image_seq_len": 8192}
    shifts = {"base_shift": math.log(3), "max_shift": math.log(3), "use_dynamic_shifting": True}
    published = diffusers.FlowMatchEulerDiscreteScheduler(**sizes, **shifts, shift_terminal=None)
    published.set_timesteps(sigmas=np.linspace(1, 1 / steps, steps), mu=math.log(3))
    sigmas = tiny("qwen")[0].schedule(3072, steps, timestep_shift=3.0)
    torch.testing.assert_close(sigmas, published.sigmas, atol=1e-6, rtol=0)
