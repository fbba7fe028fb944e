"""Writes tiny versions of published models with the file layouts and key names of the originals."""

import inspect
import json
import re

import huggingface_hub.constants
import torch
from safetensors.torch import save_file
from torch import nn

from brewster.diffusion.adapter.lora import add_lora, lora_parameters
from brewster.diffusion.backbones.registry import tiny
from brewster.diffusion.lazy_imports import diffusers_class, suppress_log_messages

KLEIN_9B = "black-forest-labs/FLUX.2-klein-9B"
SIDE = 64
"""The processing resolution of the tiny WindowSeat model."""
TOKENS = 9
ACTIVE_TOKENS = 6


def linear_layers(transformer):
    return {
        name: module
        for name, module in transformer.named_modules()
        if isinstance(module, nn.Linear)
    }


def random_pair(module, rank, generator):
    """The matrices lora_A (rank, in) and lora_B (out, rank) of a layer, of similar size as its
    weights.
    """
    down = torch.randn(rank, module.in_features, generator=generator) / module.in_features**0.5
    return down, 0.3 * torch.randn(module.out_features, rank, generator=generator)


def random_lora(backbone, rank):
    """Random matrices for all linear layers of the blocks, as `read_lora_layers` returns them."""
    layers = linear_layers(backbone.transformer)
    generator = torch.Generator().manual_seed(5)
    state = {}
    for name in backbone.lora_targets():
        pair = random_pair(layers[name], rank, generator)
        state |= {f"{name}.lora_A.weight": pair[0], f"{name}.lora_B.weight": pair[1]}
    return state


def velocity(backbone, prompt):
    """The prediction for fixed random latents, without guidance."""
    generator = torch.Generator().manual_seed(0)
    latents, condition = torch.randn(2, 1, backbone.channels, 2, 4, generator=generator)
    return backbone.predict(latents, condition, torch.tensor([0.7]), prompt, 1.0)


def with_random_lora(name):
    """A tiny version with a LoRA whose matrices are random, as after training."""
    backbone, prompt = tiny(name)
    add_lora(backbone, rank=2, alpha=4, target_modules=["*.attn.*"])
    with torch.no_grad():
        for parameter in lora_parameters(backbone):
            parameter.normal_(0, 0.1, generator=torch.Generator().manual_seed(3))
    return backbone, prompt


def write_json(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def hub_snapshot(cache, hub_id, monkeypatch):
    """The folder for a model in a cache of the hub, which becomes the cache of this process; there
    is no network.
    """
    repository = cache / f"models--{hub_id.replace('/', '--')}"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text("1" * 40)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(cache))
    return repository / "snapshots" / ("1" * 40)


def write_klein_9b(folder, monkeypatch):
    """Writes the configuration of FLUX.2-klein-9B into the cache of the hub."""
    snapshot = hub_snapshot(folder, KLEIN_9B, monkeypatch)
    transformer = {
        "guidance_embeds": False,
        "num_layers": 8,
        "num_single_layers": 24,
        "num_attention_heads": 32,
        "joint_attention_dim": 12288,
    }
    write_json(
        snapshot / "model_index.json", {"_class_name": "Flux2KleinPipeline", "is_distilled": True}
    )
    write_json(snapshot / "transformer" / "config.json", transformer)
    write_json(snapshot / "vae" / "config.json", {})
    write_json(snapshot / "scheduler" / "scheduler_config.json", {})


def write_qwen_edit_plus(folder):
    """Writes a tiny Qwen-Image-Edit-2509: the folder names a QwenImageEditPlusPipeline."""
    save_backbone(tiny("qwen", seed=1)[0], folder)
    index = json.loads((folder / "model_index.json").read_text())
    write_json(folder / "model_index.json", index | {"_class_name": "QwenImageEditPlusPipeline"})
    return folder


def write_windowseat(folder, base, *, dtype=torch.float32, **config):
    """Writes a tiny WindowSeat model for a base, with ranks that differ between layers."""
    generator = torch.Generator().manual_seed(5)
    layers = linear_layers(tiny("qwen", seed=1)[0].transformer)
    # Attention, feed-forward and modulation layers, and one layer outside of the blocks.
    targets = [name for name in layers if re.search(r"attn\.to_|_mod\.1|mlp|^img_in$", name)]
    ranks = {name: 2 if "attn.to_q" in name else 4 for name in targets}
    weights = {}
    for name in targets:
        pair = random_pair(layers[name], ranks[name], generator)
        for part, matrix in zip("AB", pair, strict=True):
            weights[f"{name}.lora_{part}.default.weight"] = matrix.to(dtype)
    settings = {
        "peft_type": "LORA",
        "r": 4,
        "lora_alpha": 8,
        "target_modules": targets,
        "rank_pattern": {name: rank for name, rank in ranks.items() if rank != 4},
        "alpha_pattern": {},
        "use_rslora": False,
        "init_lora_weights": True,
    }
    write_json(
        folder / "model_index.json", {"base_model": str(base), "processing_resolution": SIDE}
    )
    write_json(folder / "transformer_lora" / "adapter_config.json", settings | config)
    save_file(weights, folder / "transformer_lora" / "pytorch_lora_weights.safetensors")
    (folder / "text_embeddings").mkdir()
    embeddings = {
        "prompt_embeds": torch.randn(1, TOKENS, 32, generator=generator).to(dtype),
        "prompt_mask": (torch.arange(TOKENS) < ACTIVE_TOKENS).long()[None],
    }
    save_file(embeddings, folder / "text_embeddings" / "state_dict.safetensors")
    return folder


def save_backbone(backbone, folder):
    """Writes a folder that `load_backbone` and diffusers can load."""
    with suppress_log_messages():  # diffusers warns about missing text encoders
        diffusers_pipeline(backbone).save_pretrained(folder)


def diffusers_pipeline(backbone):
    """The pipeline of diffusers with the transformer, VAE and scheduler of a backbone, without text
    encoders.
    """
    pipeline_class = diffusers_class(backbone.classes["pipeline"])
    parts = {
        "transformer": backbone.transformer,
        "vae": backbone.vae,
        "scheduler": backbone.scheduler,
    }
    parameters = inspect.signature(pipeline_class.__init__).parameters
    required = {
        name for name, parameter in parameters.items() if parameter.default is parameter.empty
    }
    omitted = dict.fromkeys(required - {"self", *parts})
    distilled = {"is_distilled": backbone.distilled} if "is_distilled" in parameters else {}
    return pipeline_class(**parts, **omitted, **distilled)


@torch.no_grad()
def merge(backbone, state, scale):
    """Replaces the weight W of each adapted layer by W + scale B A (Hu et al. 2021)."""
    for name, up in state.items():
        layer, is_up, _ = name.partition(".lora_B.weight")
        if is_up:
            weight = backbone.transformer.get_submodule(layer).weight
            weight += scale * up.float() @ state[f"{layer}.lora_A.weight"].float()
