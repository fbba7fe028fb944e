"""Offloading by layers and decoding in tiles, on the CPU: the hooks copy from host memory to host memory."""

import pytest
import torch
from diffusers.hooks import group_offloading

from brewster.models.diffusion import offloading, pipeline
from brewster.models.diffusion.adapter.lora import add_lora, save_lora
from brewster.models.diffusion.backbones.loading import load_backbone
from brewster.models.diffusion.backbones.registry import BACKBONES, tiny
from brewster.models.diffusion.memory import Placement
from brewster.models.diffusion.offloading import DECODING_BYTES_PER_PIXEL, offload_layers
from brewster.models.diffusion.pipeline import load_pipeline
from brewster.models.diffusion.task import DecompositionTask
from published_models import save_backbone, velocity, with_random_lora

PHOTO = torch.linspace(-1, 1, 3 * 32 * 48).reshape(1, 3, 32, 48)


@pytest.fixture
def copies(monkeypatch):
    """The groups of layers that were copied to the device."""
    copied, group_class = [], group_offloading.ModuleGroup
    onload = group_class.onload_
    monkeypatch.setattr(group_class, "onload_", lambda group: (copied.append(group), onload(group)))
    return copied


@pytest.mark.parametrize("name", list(BACKBONES))
def test_an_offloaded_transformer_with_a_lora_predicts_the_same_bits(name, copies):
    backbone, prompt = with_random_lora(name)
    expected = velocity(backbone, prompt)
    offload_layers(backbone.transformer, backbone.vae, "cpu")
    assert torch.equal(velocity(backbone, prompt), expected)
    transformer = backbone.transformer
    blocks = [*transformer.transformer_blocks, *getattr(transformer, "single_transformer_blocks", [])]
    copied = {id(module) for group in copies for module in group.modules}
    assert {id(block) for block in blocks} <= copied
    assert backbone.device == torch.device("cpu")


def test_quantized_weights_are_offloaded_with_their_lora(tmp_path, copies):
    save_backbone(tiny("kontext", seed=1)[0], tmp_path)
    backbone = load_backbone(str(tmp_path), quantization="int8", dtype=torch.bfloat16)
    _, prompt = tiny("kontext", seed=1)
    add_lora(backbone, rank=2)
    with torch.no_grad():
        expected = velocity(backbone, prompt)
        offload_layers(backbone.transformer, backbone.vae, "cpu")
        assert torch.equal(velocity(backbone, prompt), expected)
    assert copies


def test_an_offloaded_lora_separates_as_a_resident_one(tmp_path, monkeypatch, copies):
    backbone, prompt = with_random_lora("kontext")
    task, targets = DecompositionTask(steps=2), ["*.attn.*"]
    save_lora(tmp_path, backbone, prompt, task, base_model="tiny:kontext", target_modules=targets)
    expected = load_pipeline(str(tmp_path))(PHOTO)
    assert not copies
    placement = Placement("cpu", is_offloaded=True)
    monkeypatch.setattr(pipeline.memory, "choose_placement", lambda *_, **__: placement)
    panels = load_pipeline(str(tmp_path))(PHOTO)
    assert copies
    assert all(torch.equal(panels[name], expected[name]) for name in "ITR")


@pytest.mark.parametrize(("name", "tolerance"), [("kontext", 0.7), ("klein", 0.7), ("qwen", 0.2)])
def test_large_images_are_decoded_in_overlapping_tiles(name, tolerance, monkeypatch):
    """The tolerance is that of the mean difference, in standard deviations of the image.

    The group norm of FLUX's VAE has the statistics of each tile, which differ most with random weights. Qwen's VAE
    normalises each pixel separately.
    """
    backbone, _ = tiny(name, seed=1)
    photo = torch.nn.functional.interpolate(PHOTO, (64, 320), mode="bicubic").clamp(-1, 1)
    for side in ("tile_sample_min_size", "tile_sample_min_height", "tile_sample_min_width"):
        if hasattr(backbone.vae, side):
            setattr(backbone.vae, side, 256)
    if hasattr(backbone.vae, "tile_latent_min_size"):
        backbone.vae.tile_latent_min_size = 32
    latents = backbone.encode(photo)
    whole = backbone.decode(latents)
    needed = 64 * 320 * DECODING_BYTES_PER_PIXEL
    monkeypatch.setattr(offloading, "free_gpu_bytes", lambda device: needed)
    assert torch.equal(backbone.decode(latents), whole)
    monkeypatch.setattr(offloading, "free_gpu_bytes", lambda device: needed - 1)
    tiled = backbone.decode(latents)
    assert tiled.shape == whole.shape
    assert 0 < (tiled - whole).abs().mean() < tolerance * whole.std()
    assert not backbone.vae.use_tiling
