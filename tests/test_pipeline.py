"""The sampling loop, compared with diffusers on tiny versions; and what a value of --model is."""

import huggingface_hub.constants
import pytest
import torch
from diffusers.hooks import group_offloading
from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit
from PIL import Image

from brewster.diffusion import offloading, pipeline
from brewster.diffusion.adapter.lora import add_lora, save_lora
from brewster.diffusion.backbones.backbone import ClassifierFreeBackbone
from brewster.diffusion.backbones.loading import load_backbone
from brewster.diffusion.backbones.registry import BACKBONES, tiny
from brewster.diffusion.memory import Placement
from brewster.diffusion.model_source import find_model_source
from brewster.diffusion.offloading import DECODING_BYTES_PER_PIXEL, offload_layers
from brewster.diffusion.pipeline import load_pipeline, sample
from brewster.diffusion.prompt import PromptEmbedding
from brewster.diffusion.task import DecompositionTask
from brewster.errors import DeviceError, ModelError
from published_models import (
    diffusers_pipeline,
    save_backbone,
    velocity,
    with_random_lora,
    write_qwen_edit_plus,
    write_windowseat,
)

SIZE = (192, 64)
STEPS = 4


@pytest.fixture(params=list(BACKBONES), scope="module")
def tiny_model(request):
    return tiny(request.param, seed=1)


def image_8bit(width, height):
    """An image with 8-bit values, so that pipelines that only accept PIL images get the same
    numbers.
    """
    generator = torch.Generator().manual_seed(5)
    return torch.randint(0, 256, (1, 3, height, width), generator=generator) / 127.5 - 1


def to_pil(image):
    return Image.fromarray(((image[0] + 1) * 127.5).round().byte().permute(1, 2, 0).numpy())


def sample_with_diffusers(tiny_model, condition, monkeypatch, *, guidance=4.0, seed=3):
    """The image of the diffusers pipeline in [0, 1], without its rescaling, with the noise of the
    seed.
    """
    backbone, prompt = tiny_model
    width, height = SIZE
    options = {
        "prompt_embeds": prompt.embeds,
        "height": height,
        "width": width,
        "output_type": "pt",
    }
    options |= {"num_inference_steps": STEPS, "generator": torch.Generator().manual_seed(seed)}
    if backbone.name == "kontext":
        options |= {"image": (condition + 1) / 2, "pooled_prompt_embeds": prompt.pooled}
        options |= {"max_area": width * height, "_auto_resize": False, "guidance_scale": guidance}
    elif backbone.name == "klein":
        options |= {"image": to_pil(condition), "negative_prompt_embeds": prompt.negative}
        options |= {"guidance_scale": guidance}
    else:
        unchanged = (condition.shape[3], condition.shape[2], None)
        monkeypatch.setattr(
            pipeline_qwenimage_edit, "calculate_dimensions", lambda area, ratio: unchanged
        )
        options |= {"image": to_pil(condition), "negative_prompt_embeds": prompt.negative}
        options |= {"true_cfg_scale": guidance}
    pipe = diffusers_pipeline(backbone)
    pipe.set_progress_bar_config(disable=True)
    return pipe(**options).images


def sample_with_brewster(tiny_model, condition, **options):
    backbone, prompt = tiny_model
    return sample(
        backbone, condition, prompt, **({"size": SIZE, "steps": STEPS, "seeds": [3]} | options)
    )


@pytest.mark.parametrize("condition_size", [SIZE, (64, 96)])
@pytest.mark.parametrize("guidance", [1.0, 4.0])
def test_the_loop_gives_the_image_of_diffusers_pipeline(
    tiny_model, monkeypatch, guidance, condition_size
):
    condition = image_8bit(*condition_size)
    expected = sample_with_diffusers(tiny_model, condition, monkeypatch, guidance=guidance)
    actual = (sample_with_brewster(tiny_model, condition, guidance=guidance) + 1) / 2
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=0)
    assert expected.std() > 0.01


def test_a_seed_gives_the_same_image_alone_and_with_others(tiny_model):
    condition = image_8bit(*SIZE)
    several = sample_with_brewster(tiny_model, condition, seeds=[3, 4, 5])
    assert torch.equal(sample_with_brewster(tiny_model, condition, seeds=[4]), several[1:2])
    assert (several[0] - several[1]).abs().max() > 0.01


def test_the_schedule_counts_generated_tokens_and_ends_at_sigma_0(tiny_model):
    backbone, _ = tiny_model
    few = backbone.schedule(256, 20)
    many = backbone.schedule(3072, 20)
    assert len(few) == 21
    assert (few[0], few[-1]) == (1, 0)
    assert (few.diff() < 0).all()
    assert (many[1:-2] > few[1:-2]).all()  # larger images get more steps at high noise


def test_training_times_are_shifted_like_those_of_the_schedule(tiny_model):
    backbone, _ = tiny_model
    times = backbone.shifted(torch.linspace(1, 1 / 8, 8), 3072, steps=8)
    if backbone.scheduler.config.shift_terminal:  # the last one of the stretched times
        stretch = (1 - times[-1]) / (1 - backbone.scheduler.config.shift_terminal)
        times = 1 - (1 - times) / stretch
    torch.testing.assert_close(times, backbone.schedule(3072, 8)[:-1], atol=1e-6, rtol=0)


@pytest.mark.parametrize("steps", [1, 2])
def test_few_steps_are_allowed_and_every_step_is_reported(tiny_model, steps):
    reported = []
    options = {"steps": steps, "seeds": [1, 2], "on_progress": lambda *step: reported.append(step)}
    sample_with_brewster(tiny_model, image_8bit(*SIZE), **options)
    assert reported == [(done, 2 * steps) for done in range(1, 2 * steps + 1)]


def test_guidance_without_an_empty_prompt_is_refused_with_a_hint(tiny_model):
    backbone, prompt = tiny_model
    if not isinstance(backbone, ClassifierFreeBackbone):
        pytest.skip("this backbone has distilled guidance")
    without_negative = PromptEmbedding(prompt.backbone, prompt.text, prompt.embeds)
    model = backbone, without_negative
    with pytest.raises(
        ModelError, match=r"no embedding of the empty prompt.*set the guidance to 1"
    ):
        sample_with_brewster(model, image_8bit(*SIZE))
    assert sample_with_brewster(model, image_8bit(*SIZE), guidance=1.0).isfinite().all()


BASE = "Qwen/Qwen-Image-Edit-2509"
WINDOWSEAT = "huawei-bayerlab/windowseat-reflection-removal-v1-0"


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A hub with a tiny WindowSeat and its base, an empty cache, and the list of downloads."""
    folders = {
        BASE: write_qwen_edit_plus(tmp_path / "base"),
        WINDOWSEAT: write_windowseat(tmp_path / "windowseat", BASE),
    }
    requests = []

    def snapshot_download(source, *, allow_patterns, dry_run=False, local_files_only=False):
        if dry_run:
            return []
        if local_files_only:
            raise OSError("not in the cache")
        requests.append(source)
        return str(folders[source])

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    return requests


def test_the_machine_is_checked_before_any_download(hub):
    """This machine has no GPU."""
    with pytest.raises(DeviceError, match=f"finds no GPU, and {BASE} has 20.4 billion parameters"):
        load_pipeline("windowseat")
    assert hub == []


def test_a_name_is_a_backbone_without_files():
    source = find_model_source("kontext")
    assert (source.base, source.folder, source.task.layout.panels) == ("kontext", None, ("T",))
    assert source.needs_text_encoders
    with pytest.raises(
        ModelError, match="kontext is a backbone, and the base model klein was given"
    ):
        find_model_source("kontext", "klein")


PHOTO = torch.linspace(-1, 1, 3 * 32 * 48).reshape(1, 3, 32, 48)


@pytest.fixture
def copies(monkeypatch):
    """The groups of layers that were copied to the device."""
    copied = []
    group_class = group_offloading.ModuleGroup
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
    blocks = [
        *transformer.transformer_blocks,
        *getattr(transformer, "single_transformer_blocks", []),
    ]
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
    task = DecompositionTask(steps=2)
    targets = ["*.attn.*"]
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

    The group norm of FLUX's VAE has the statistics of each tile, which differ most with random
    weights. Qwen's VAE normalises each pixel separately.
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
