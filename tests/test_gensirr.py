"""GenSIRR's checkpoint on a tiny FLUX.1 Kontext: converted, opened, and compared with the published call."""

import diffusers
import pytest
import torch
from torch.nn import functional

from brewster.errors import ModelError
from brewster.inference.diffusion_predictor import DiffusionPredictor
from brewster.models.diffusion.backbones.registry import tiny
from brewster.models.diffusion.gensirr import convert
from brewster.models.diffusion.model_source import find_model_source
from brewster.models.diffusion.pipeline import load_pipeline

SIDE = 64


def checkpoint_values(seed=3, **changes):
    """The content of a tiny GenSIRR.pt: the weights of a module net_g, under "module"."""
    backbone, prompt = tiny("kontext", seed=seed)
    module = {f"net_g.transformer.{key}": value for key, value in backbone.transformer.state_dict().items()}
    module |= {f"net_g.vae.{key}": value for key, value in backbone.vae.state_dict().items()}
    module |= {
        "net_g.text_encoder.text_model.embeddings.weight": torch.zeros(2, 2),
        "net_g.cached_prompt_embeds": torch.nn.Parameter(prompt.embeds + 1),
        "net_g.cached_pooled_prompt_embeds": torch.nn.Parameter(prompt.pooled + 1),
        "net_g.cached_text_ids": torch.nn.Parameter(torch.zeros(prompt.embeds.shape[1], 3)),
        "loss.weight": torch.ones(1),
    }
    return {"module": module | changes, "global_steps": 7}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gensirr")
    torch.save(checkpoint_values(), folder / "GenSIRR.pt")
    convert(folder / "GenSIRR.pt", folder / "gensirr", base_model="tiny:kontext", short_side_px=SIDE)
    return folder / "gensirr"


@torch.no_grad()
def published_call(image, *, seed, steps):
    """The published loop with the parts of stock diffusers; image (1, 3, h, w) in [-1, 1], padded by reflection."""
    backbone, prompt = tiny("kontext", seed=3)
    height, width = image.shape[-2:]
    padded = functional.pad(image, (0, -width % 16, 0, -height % 16), mode="reflect")
    pipe, vae = diffusers.FluxKontextPipeline, backbone.vae
    encoded = (vae.encode(padded).latent_dist.mode() - vae.config.shift_factor) * vae.config.scaling_factor
    _, channels, rows, columns = encoded.shape
    condition = pipe._pack_latents(encoded, 1, channels, rows, columns)
    noise = torch.randn(encoded.shape, generator=torch.Generator().manual_seed(seed))
    latents = pipe._pack_latents(noise, 1, channels, rows, columns)
    ids = [pipe._prepare_latent_image_ids(1, rows // 2, columns // 2, "cpu", torch.float32) for _ in range(2)]
    ids[1][..., 0] = 1
    scheduler = backbone.scheduler
    config = scheduler.config
    slope = (config.max_shift - config.base_shift) / (config.max_image_seq_len - config.base_image_seq_len)
    mu = config.base_shift + slope * (latents.shape[1] - config.base_image_seq_len)
    scheduler.set_timesteps(steps, mu=mu)  # without sigmas: the scheduler takes linspace(1, 0.001)
    for time in scheduler.timesteps:
        velocity = backbone.transformer(
            hidden_states=torch.cat([latents, condition], dim=1),
            timestep=time.expand(1) / 1000,
            guidance=torch.tensor([3.5]),
            pooled_projections=prompt.pooled + 1,
            encoder_hidden_states=prompt.embeds + 1,
            txt_ids=torch.zeros(prompt.embeds.shape[1], 3),
            img_ids=torch.cat(ids),
            return_dict=False,
        )[0][:, : latents.shape[1]]
        latents = scheduler.step(velocity, time, latents, return_dict=False)[0]
    latents = pipe._unpack_latents(latents, *padded.shape[-2:], 8)
    decoded = vae.decode(latents / vae.config.scaling_factor + vae.config.shift_factor, return_dict=False)[0]
    return decoded[..., :height, :width].clamp(-1, 1)


def test_the_converted_model_predicts_as_the_published_call(model):
    pipeline = load_pipeline(str(model))
    task = pipeline.task
    assert (task.guidance, task.steps, task.last_sigma, task.layout.panels) == (3.5, 28, 0.001, ("T",))
    image = 1.6 * torch.rand(1, 3, SIDE, 80, generator=torch.Generator().manual_seed(1)) - 0.8
    found = pipeline(image, steps=4, seeds=[5])["T"]
    torch.testing.assert_close(found, published_call(image, seed=5, steps=4), atol=1e-4, rtol=0)


@pytest.mark.parametrize(("size", "inputs"), [((200, 100), [(128, 64)]), ((40, 30), [(40, 30)])])
def test_the_short_side_of_the_input_is_that_of_the_published_call(model, size, inputs):
    pipeline = load_pipeline(str(model))
    assert DiffusionPredictor(pipeline).input_sizes(size, "standard") == inputs


def test_the_command_of_the_documentation_converts_with_a_short_side(run_without_model, tmp_path):
    """The folder has the name of the model, and it is opened in its place."""
    torch.save(checkpoint_values(), tmp_path / "GenSIRR.pth")
    arguments = ("GenSIRR.pth", "gensirr", "--base-model", "tiny:kontext", "--short-side", 48)
    code, _, err = run_without_model("models", "import", *arguments)
    assert (code, "use it with: --model gensirr" in err) == (0, True)
    task = find_model_source("gensirr").task
    assert (task.short_side_px, task.max_composite_pixels, task.steps) == (48, 48**2, 28)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (checkpoint_values(**{"net_g.transformer.more": torch.zeros(1)}), "does not match the transformer"),
        (checkpoint_values(**{"net_g.depth.weight": torch.zeros(1)}), r"contains depth\.weight"),
        (checkpoint_values(**{"net_g.cached_text_ids": torch.ones(8, 3)}), "position ids"),
        ({"module": {"net_g.vae.x": torch.zeros(1)}}, "lacks 'cached_prompt_embeds'"),
    ],
)
def test_other_checkpoints_are_refused(values, message, tmp_path):
    torch.save(values, tmp_path / "model.pt")
    with pytest.raises(ModelError, match=message):
        convert(tmp_path / "model.pt", tmp_path / "out", base_model="tiny:kontext")
    assert not (tmp_path / "out").exists()


def test_a_checkpoint_cannot_run_code(tmp_path):
    class Harmful:
        def __reduce__(self):
            return (open, (str(tmp_path / "harm"), "w"))

    torch.save({"module": Harmful()}, tmp_path / "model.pt")
    with pytest.raises(ModelError, match="tensors only"):
        convert(tmp_path / "model.pt", tmp_path / "out", base_model="tiny:kontext")
    assert not (tmp_path / "harm").exists()
