"""Toy scenes behind glass, and toy backbones that are pretrained on similar scenes, for the tests
of LoRA training.

The transmission is a smooth gradient, the reflection is a bright shape. In linear light, the photo
is their sum. All weights of a toy backbone are pretrained first: its VAE on bars of any strength,
its transformer on the removal of faint bars. The LoRA is then trained to remove strong blobs, which
are not in the data of pretraining.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from brewster.diffusion.backbones.backbone import ClassifierFreeBackbone
from brewster.diffusion.backbones.registry import tiny
from brewster.diffusion.task import PanelLayout, compose, conditioning_image
from brewster.photo import Photo
from brewster.photo.srgb import to_encoded, to_linear
from published_models import save_backbone

SIDE_PX = 32
LAYOUT = PanelLayout()
ANY = (0.1, 1.5)
FAINT = (0.1, 0.8)
STRONG = (0.7, 1.5)
"""Ranges of the linear light of the shapes. White is 1."""
FOLDERS = {"I": "blended", "T": "transmission", "R": "reflection"}


def scenes(seed, count, shape, strength):
    """Returns I, T and R of `count` scenes, (count, 3, 32, 32) each, encoded, in [-1, 1].

    `strength` is the range of the linear light of the shapes.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *size):
        return low + (high - low) * torch.rand(count, *size, generator=generator)

    corners = (uniform(0.1, 0.75, 3, 1, 1) + uniform(-0.15, 0.15, 3, 2, 2)).clamp(min=0.05)
    side = {"size": (SIDE_PX, SIDE_PX), "mode": "bilinear", "align_corners": True}
    transmission = to_linear(functional.interpolate(corners, **side))
    line = torch.linspace(0, 1, SIDE_PX)
    rows, columns = (
        (line[:, None] - uniform(0.15, 0.85, 1, 1, 1)),
        (line - uniform(0.15, 0.85, 1, 1, 1)),
    )
    width = uniform(0.2, 0.35, 1, 1, 1)
    angle = uniform(0, math.pi, 1, 1, 1)
    across = columns * angle.cos() + rows * angle.sin()
    distance = {"blob": (rows**2 + columns**2) / width**2, "bar": across**2 / (0.7 * width) ** 2}[
        shape
    ]
    light = uniform(*strength, 1, 1, 1) * uniform(0.6, 1, 3, 1, 1)
    reflection = light * torch.exp(-distance)
    layers = {"I": transmission + reflection, "T": transmission, "R": reflection}
    return {name: 2 * to_encoded(layer.clamp(0, 1)) - 1 for name, layer in layers.items()}


def write_pairs(folder, layers):
    """Writes the scenes as a folder of real pairs with reflections."""
    for name, role in FOLDERS.items():
        for number, image in enumerate(layers[name]):
            pixels = ((image + 1) * 127.5).round().byte().permute(1, 2, 0).numpy()
            photo = Photo.from_array(np.ascontiguousarray(pixels), encoding="srgb")
            photo.save(folder / role / f"{number:03}.png")


def psnr(predictions, ground_truth):
    """Returns the mean PSNR in dB of images in [-1, 1]."""
    errors = ((predictions - ground_truth) / 2).square().mean(dim=(1, 2, 3))
    return (-10 * errors.log10()).mean().item()


def pretrain(name, folder, *, vae_steps, steps):
    """Pretrains a toy backbone on the removal of faint bars in one step, and saves it with its
    prompt.

    Returns:
        The path of the prompt.
    """
    backbone, prompt = tiny(name)
    training = scenes(1, 128, "bar", FAINT)
    generator = torch.Generator().manual_seed(0)
    _train_vae(backbone, scenes(4, 128, "bar", ANY), vae_steps)
    composites = [
        compose(panels, LAYOUT) for panels in (training, dict.fromkeys("ITR", training["I"]))
    ]
    condition, target, start = (
        torch.cat([backbone.encode(part) for part in images.split(32)])
        for images in (conditioning_image(training["I"], LAYOUT), *composites)
    )

    def loss(step):
        batch = torch.randint(len(target), (16,), generator=generator)
        # Real backbones are also trained with an empty prompt and with other guidance. Here, every
        # second step is.
        used = prompt
        guidance = 1.0
        if step % 2 and prompt.negative is not None:
            used = replace(prompt, embeds=prompt.negative)
        if step % 2 and not isinstance(backbone, ClassifierFreeBackbone):
            guidance = 4.0
        velocity = backbone.predict(start[batch], condition[batch], torch.ones(16), used, guidance)
        return (velocity - (start[batch] - target[batch])).square().mean()

    _minimize(loss, backbone.transformer, steps, peak=3e-3)
    save_backbone(backbone, folder)
    prompt.save(folder / "prompt.safetensors")
    return folder / "prompt.safetensors"


def _train_vae(backbone, layers, steps):
    """Trains the VAE on composite images, conditioning images, and composites with the photo in
    every panel.
    """
    generator = torch.Generator().manual_seed(0)

    def loss(step):
        indices = torch.randint(len(layers["I"]), (4,), generator=generator)
        batch = {name: images[indices] for name, images in layers.items()}
        kinds = [compose(batch, LAYOUT), conditioning_image(batch["I"], LAYOUT)]
        kinds += [kinds[0], compose(dict.fromkeys("ITR", batch["I"]), LAYOUT)]
        image = kinds[step % 4]
        return (backbone._vae_decode(backbone._vae_encode(image)) - image).square().mean()

    _minimize(loss, backbone.vae, steps, peak=1.5e-3)


def _minimize(loss, network, steps, peak):
    network.requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), peak)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, peak, total_steps=steps, pct_start=0.1
    )
    for step in range(steps):
        optimizer.zero_grad()
        loss(step).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    network.requires_grad_(False)
