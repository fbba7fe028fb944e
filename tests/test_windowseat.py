"""WindowSeat's published layout on a tiny Qwen-Image-Edit-2509, against its published arithmetic
with diffusers.
"""

import json
import shutil
from types import SimpleNamespace

import diffusers
import huggingface_hub
import numpy as np
import peft
import pytest
import torch
from safetensors.torch import load_file, save_file

from brewster import Photo, Separator
from brewster.diffusion.adapter.windowseat import (
    CONFIG_FILE,
    INDEX_FILE,
    PROMPT_FILE,
    WEIGHTS_FILE,
)
from brewster.diffusion.backbones.loading import load_backbone
from brewster.diffusion.model_table import DIFFUSION_MODELS
from brewster.diffusion.pipeline import fingerprint, load_pipeline
from brewster.diffusion.predictor import DiffusionPredictor
from brewster.diffusion.task import windowseat_task
from brewster.errors import ModelError
from brewster.photo.srgb import to_encoded, to_linear
from published_models import SIDE, hub_snapshot, write_qwen_edit_plus, write_windowseat


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return write_qwen_edit_plus(tmp_path_factory.mktemp("qwen") / "Qwen-Image-Edit-2509")


@pytest.fixture(scope="module")
def model(base, tmp_path_factory):
    """The published model; tests must not change it."""
    return write_windowseat(tmp_path_factory.mktemp("windowseat") / "windowseat", base)


@pytest.fixture
def folder(model, tmp_path):
    """The published model, which a test may change."""
    return shutil.copytree(model, tmp_path / "windowseat")


def random_image(width, height):
    """An sRGB-encoded image with smooth colours, (1, 3, h, w) in [-1, 1]."""
    coarse = torch.rand(1, 3, 4, 4, generator=torch.Generator().manual_seed(2))
    size = (height, width)
    return 1.6 * torch.nn.functional.interpolate(coarse, size, mode="bicubic").clamp(0, 1) - 0.8


@torch.no_grad()
def published_call(model, base, image):
    """The published arithmetic: a peft adapter in a stock transformer, one pass with mask, z - v,
    decode.
    """
    transformer = diffusers.QwenImageTransformer2DModel.from_pretrained(
        base, subfolder="transformer"
    )
    vae = diffusers.AutoencoderKLQwenImage.from_pretrained(base, subfolder="vae")
    transformer.add_adapter(peft.LoraConfig.from_pretrained(model / "transformer_lora"))
    missing, unexpected = transformer.load_state_dict(load_file(model / WEIGHTS_FILE), strict=False)
    assert not unexpected
    assert not any("lora" in name for name in missing)
    embeddings = load_file(model / PROMPT_FILE)
    statistics = vae.config.latents_mean, vae.config.latents_std
    mean, std = (torch.tensor(values).view(1, -1, 1, 1, 1) for values in statistics)
    latents = (vae.encode(image[:, :, None]).latent_dist.mode() - mean) / std
    channels, _, rows, columns = latents.shape[1:]
    edit = diffusers.QwenImageEditPipeline
    velocity = transformer(
        hidden_states=edit._pack_latents(latents[:, :, 0], 1, channels, rows, columns),
        timestep=torch.tensor([499.0]) / 1000,
        encoder_hidden_states=embeddings["prompt_embeds"],
        encoder_hidden_states_mask=embeddings["prompt_mask"] > 0,
        img_shapes=[[(1, rows // 2, columns // 2)]],
        guidance=None,
        return_dict=False,
    )[0]
    velocity = edit._unpack_latents(velocity, 8 * rows, 8 * columns, 8)
    return vae.decode((latents - velocity) * std + mean).sample[:, :, 0].clamp(-1, 1)


def test_the_transmission_is_that_of_the_published_call(model, base):
    image = random_image(SIDE, SIDE)
    pipeline = load_pipeline(str(model))
    panels = pipeline(image)
    expected = published_call(model, base, image)
    torch.testing.assert_close(panels["T"], expected, atol=1e-5, rtol=0)
    plain = load_backbone(str(base))
    assert (panels["I"] - plain.decode(plain.encode(image)).clamp(-1, 1)).abs().max() < 1e-5
    assert (panels["T"] - panels["I"]).abs().mean() > 0.01  # the prediction does something
    assert (pipeline.name, pipeline.backbone.name) == ("windowseat", "qwen")


def test_the_lora_has_an_effect_and_its_alpha_is_applied(model, base, folder):
    image = random_image(SIDE, SIDE)
    config = json.loads((folder / CONFIG_FILE).read_text())
    config |= {"use_rslora": True, "alpha_pattern": {"img_in": 3}}
    (folder / CONFIG_FILE).write_text(json.dumps(config))
    changed = load_pipeline(str(folder))(image)["T"]
    assert (changed - load_pipeline(str(model))(image)["T"]).abs().max() > 1e-3
    torch.testing.assert_close(changed, published_call(folder, base, image), atol=1e-5, rtol=0)


def test_a_square_photo_separates_as_published_with_a_derived_reflection(model, base):
    image = random_image(SIDE, SIDE)
    encoded = ((image[0].permute(1, 2, 0) + 1) / 2).numpy()
    photo = Photo.from_array(to_linear(encoded).astype(np.float32), encoding="linear")
    separation = Separator.load(str(model), no_guided_upsampling=True)(photo)
    expected = ((published_call(model, base, image)[0].permute(1, 2, 0) + 1) / 2).numpy()
    assert np.abs(to_encoded(separation.transmission.linear()) - expected).max() < 1e-3
    assert separation.reflection_is_derived
    derived = np.maximum(photo.linear() - separation.transmission.linear(), 0)
    np.testing.assert_allclose(separation.reflection.linear(), derived, atol=1e-5)
    assert separation.reconstruction_error is not None
    assert separation.confidence.pixels.any()


@pytest.mark.parametrize(
    ("size", "tiles"),
    [
        ((SIDE, SIDE), 1),
        ((2 * SIDE, SIDE), 3),
        ((5 * SIDE, SIDE), 6),
        ((40, 30), 2),
        ((256, 192), 2),
    ],
)
def test_photos_of_any_shape_are_divided_into_squares_of_the_published_side(size, tiles):
    sizes = []

    def pipeline(photo, *, steps, seeds, on_progress):
        sizes.append((photo.shape[3], photo.shape[2], steps))
        return {"I": photo, "T": photo}

    pipeline.task = windowseat_task(SIDE)
    pipeline.backbone = SimpleNamespace(size_divisor=16)
    predictor = DiffusionPredictor(pipeline)
    photo = Photo.from_array(np.full((size[1], size[0], 3), 0.3, np.float32), encoding="linear")
    inputs = [photo.resized(*each) for each in predictor.input_sizes(size, "standard")]
    predictor(inputs, "standard", lambda fraction: None)
    assert sizes == [(SIDE, SIDE, 1)] * tiles


def test_the_name_is_opened_from_the_hub_and_only_subfolders_are_fetched(
    model, base, tmp_path, monkeypatch
):
    hub_id = DIFFUSION_MODELS["windowseat"].hub_id
    shutil.copytree(model, hub_snapshot(tmp_path, hub_id, monkeypatch))
    patterns = []
    fetch = huggingface_hub.snapshot_download

    def record(*args, **options):
        patterns.append(options)
        return fetch(*args, **options)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", record)
    separator = Separator.load("windowseat", device="cpu")
    assert separator.name == "windowseat"
    assert separator.sha256 == fingerprint(str(model))
    asked = next(
        each["allow_patterns"] for each in patterns if WEIGHTS_FILE in each["allow_patterns"]
    )
    assert {INDEX_FILE, CONFIG_FILE, WEIGHTS_FILE, PROMPT_FILE} <= set(asked)
    assert not any("*" in pattern for pattern in asked)


@pytest.mark.parametrize(("file", "change", "message"), [
    (INDEX_FILE, {"base_model": None}, "base_model is None"),
    (INDEX_FILE, {"processing_resolution": 70}, "processing_resolution is 70"),
    (CONFIG_FILE, {"r": "many"}, "lacks a setting of WindowSeat"),
])  # fmt: skip
def test_damaged_settings_are_model_errors(folder, file, change, message):
    values = json.loads((folder / file).read_text())
    (folder / file).write_text(json.dumps(values | change))
    with pytest.raises(ModelError, match=message):
        load_pipeline(str(folder))


@pytest.mark.parametrize(("change", "message"), [
    ({"prompt_mask": torch.zeros(1, 9)}, "masks tokens before the end, or all"),
    ({"prompt_mask": torch.tensor([[0, 1, 1, 1, 1, 1, 1, 1, 1]])}, "masks tokens before the end"),
    ({"more": torch.zeros(1)}, "expected prompt_embeds"),
    ({"prompt_mask": torch.ones(4)}, r"'prompt_mask': \(4,\)"),
    ({"prompt_mask": torch.ones(1, 12)}, r"'prompt_mask': \(1, 12\)"),
    ({"prompt_embeds": torch.ones(0, 9, 32), "prompt_mask": torch.ones(0, 9)}, "n of at least 1"),
])  # fmt: skip
def test_damaged_embeddings_are_model_errors(folder, change, message):
    save_file(load_file(folder / PROMPT_FILE) | change, folder / PROMPT_FILE)
    with pytest.raises(ModelError, match=message):
        load_pipeline(str(folder))


@pytest.mark.parametrize(
    ("file", "change"),
    [(INDEX_FILE, {"processing_resolution": 2 * SIDE}), (CONFIG_FILE, {"lora_alpha": 4})],
)
def test_another_task_or_scale_has_another_digest(model, folder, file, change):
    assert fingerprint(str(folder)) == fingerprint(str(model))
    values = json.loads((folder / file).read_text())
    (folder / file).write_text(json.dumps(values | change))
    assert fingerprint(str(folder)) != fingerprint(str(model))


def test_another_base_is_used_and_has_another_digest(model, base, tmp_path):
    copy = shutil.copytree(base, tmp_path / "copy")
    (copy / "note").write_text("another")
    assert load_pipeline(str(model), base_model=str(copy)).sha256 != fingerprint(str(model))
