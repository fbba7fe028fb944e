"""A world of toys behind glass, and twins that have seen something like it: what the tests of learning share.

What is behind the glass is a soft gradient; what is mirrored in it is a bright shape; in linear light the photo is
their sum. A twin is first pretrained, in full: its VAE on bars of any strength, the transformer on taking faint bars
away. So it has never met what its LoRA is to learn: strong blobs.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from brewster.models.diffusion.backbones import tiny
from brewster.models.diffusion.panels import PanelLayout, compose, conditioning_image
from brewster.photo import Photo
from brewster.srgb import to_encoded, to_linear

SIDE_PX = 32
LAYOUT = PanelLayout()
ANY, FAINT, STRONG = (0.1, 1.5), (0.1, 0.8), (0.7, 1.5)
"""Light of the shapes; white is 1."""
FOLDERS = {"I": "blended", "T": "transmission", "R": "reflection"}


def scenes(seed, count, shape, strength):
    """I, T and R of so many scenes, (count, 3, 32, 32) each, encoded, in [-1, 1]; `strength` is the shapes' light."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *size):
        return low + (high - low) * torch.rand(count, *size, generator=generator)

    corners = (uniform(0.1, 0.75, 3, 1, 1) + uniform(-0.15, 0.15, 3, 2, 2)).clamp(min=0.05)
    side = {"size": (SIDE_PX, SIDE_PX), "mode": "bilinear", "align_corners": True}
    transmission = to_linear(functional.interpolate(corners, **side))
    line = torch.linspace(0, 1, SIDE_PX)
    rows, columns = (line[:, None] - uniform(0.15, 0.85, 1, 1, 1)), (line - uniform(0.15, 0.85, 1, 1, 1))
    width, angle = uniform(0.2, 0.35, 1, 1, 1), uniform(0, math.pi, 1, 1, 1)
    across = columns * angle.cos() + rows * angle.sin()
    distance = {"blob": (rows**2 + columns**2) / width**2, "bar": across**2 / (0.7 * width) ** 2}[shape]
    light = uniform(*strength, 1, 1, 1) * uniform(0.6, 1, 3, 1, 1)
    reflection = light * torch.exp(-distance)
    layers = {"I": transmission + reflection, "T": transmission, "R": reflection}
    return {name: 2 * to_encoded(layer.clamp(0, 1)) - 1 for name, layer in layers.items()}


def write_pairs(folder, layers):
    """The scenes as a folder of real pairs, with their reflections."""
    for name, role in FOLDERS.items():
        (folder / role).mkdir(parents=True)
        for number, picture in enumerate(layers[name]):
            pixels = ((picture + 1) * 127.5).round().byte().permute(1, 2, 0).numpy()
            Photo.from_array(np.ascontiguousarray(pixels), encoding="srgb").save(
                folder / role / f"{number:03}.png"
            )


def psnr(made, truth):
    """Mean over the pictures, in dB, of pictures in [-1, 1]."""
    errors = ((made - truth) / 2).square().mean(dim=(1, 2, 3))
    return (-10 * errors.log10()).mean().item()


def pretrain(name, folder, *, vae_steps, steps):
    """A twin that can see and show toys and takes faint bars away in one step; saved with its prompt, whose path is returned."""
    backbone, prompt = tiny(name)
    seen = scenes(1, 128, "bar", FAINT)
    generator = torch.Generator().manual_seed(0)
    _learn_to_see(backbone, scenes(4, 128, "bar", ANY), vae_steps)
    shown, target, start = (
        torch.cat([backbone.encode(part) for part in pictures.split(32)])
        for pictures in (
            conditioning_image(seen["I"], LAYOUT),
            compose(seen, LAYOUT),
            compose(dict.fromkeys("ITR", seen["I"]), LAYOUT),
        )
    )

    def loss(step):
        some = torch.randint(len(target), (16,), generator=generator)
        # A real base has learnt an empty prompt, and other guidance, too.
        odd = step % 2
        told = replace(prompt, embeds=prompt.negative) if prompt.negative is not None and odd else prompt
        guidance = 4.0 if backbone.guided_by_embedding and odd else 1.0
        velocity = backbone.predict(start[some], shown[some], torch.ones(16), told, guidance)
        return (velocity - (start[some] - target[some])).square().mean()

    _minimise(loss, backbone.transformer, steps, peak=3e-3)
    backbone.save(folder)
    prompt.save(folder / "prompt.safetensors")
    return folder / "prompt.safetensors"


def _learn_to_see(backbone, seen, steps):
    """The VAE, on composites and on what the model is shown and starts from."""
    generator = torch.Generator().manual_seed(0)

    def loss(step):
        some = torch.randint(len(seen["I"]), (4,), generator=generator)
        layers = {name: pictures[some] for name, pictures in seen.items()}
        kinds = [compose(layers, LAYOUT), conditioning_image(layers["I"], LAYOUT)]
        kinds += [kinds[0], compose(dict.fromkeys("ITR", layers["I"]), LAYOUT)]
        picture = kinds[step % 4]
        return (backbone._vae_decode(backbone._vae_encode(picture)) - picture).square().mean()

    _minimise(loss, backbone.vae, steps, peak=4e-3)


def _minimise(loss, network, steps, peak):
    network.requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), peak)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, peak, total_steps=steps, pct_start=0.1)
    for step in range(steps):
        optimizer.zero_grad()
        loss(step).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    network.requires_grad_(False)
