"""Bursts with known layers, from two photographs: a motion of each layer and frame, smooth
parallax, noise and JPEG.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from brewster.photo.srgb import to_encoded, to_linear
from picture_files import file_of, pil

PICTURES = sorted((Path(__file__).parent / "pictures").glob("*.jpg"))


def linear_pictures(size):
    return [np.clip(read_photo(path, size), 0, 1) for path in (PICTURES[2], PICTURES[1])]


def psnr_db(image, truth):
    """PSNR of sRGB-encoded images after a gain for each channel, as the gain of each layer is
    unknown.
    """
    image = image * ((image * truth).sum((0, 1)) / (image * image).sum((0, 1)))
    error = to_encoded(np.clip(image, 0, 1)) - to_encoded(np.clip(truth, 0, 1))
    return -10 * np.log10(np.mean(error**2))


@dataclass(frozen=True)
class SimulatedBurst:
    frames: list[np.ndarray]
    """(H, W, 3) 8-bit sRGB."""
    transmission: np.ndarray
    """Of the middle frame: linear light."""
    reflection: np.ndarray


def simulate_burst(
    transmission,
    reflection,
    *,
    frames=5,
    relative_px=16.0,
    parallax_px=0.0,
    common_px=8.0,
    strength=0.35,
    noise=0.004,
    size=(1000, 750),
):
    """Returns a burst.

    Args:
        transmission: linear light, at least 16 % larger than `size`.
        reflection: linear light, of the same shape.
        relative_px: the motion of the reflection relative to the transmission, from the first to
            the last frame.
        parallax_px: the range of the motion within the transmission, from the first to the last
            frame.
        common_px: the motion of both layers.
        strength: the factor of the reflection; 0 is a scene without reflection.
    """
    rng = np.random.default_rng(0)
    width, height = size
    left, top = (
        (big - small) // 2 for big, small in zip(transmission.shape[1::-1], size, strict=True)
    )
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    depths = [
        cv2.resize(rng.random((5, 5)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
        for _ in range(2)
    ]
    angle = rng.uniform(-0.5, 0.5) + (np.pi if rng.random() < 0.5 else 0)
    direction = np.array([np.cos(angle), np.sin(angle)])
    reference = frames // 2
    sums = []
    truth = None
    for k in range(frames):
        time = (k - reference) / max(frames - 1, 1)
        is_moved = k != reference
        turn, zoom = rng.normal(0, [0.004, 0.002]) * is_moved
        wobble = rng.normal(0, 0.06, (3, 2)) * is_moved
        gain = np.exp(rng.normal(0, 0.02) * is_moved)
        centre_x = x - width / 2
        centre_y = y - height / 2
        turned_x = (centre_x - turn * centre_y) * (1 + zoom) + width / 2 + left
        turned_y = (centre_y + turn * centre_x) * (1 + zoom) + height / 2 + top
        layers = []
        for layer, (picture, move) in enumerate(
            ((transmission, common_px), (reflection, common_px + relative_px))
        ):
            offset = move * (direction * time + 0.3 * wobble[0]) + (
                relative_px * 0.2 * wobble[1] if layer else 0
            )
            bend = (depths[layer] - 0.5) * parallax_px * time * (1 if layer == 0 else 0.5)
            positions = np.stack(
                [
                    turned_x + offset[0] + bend * direction[0],
                    turned_y + offset[1] + bend * direction[1],
                ],
                -1,
            )
            layers.append(
                np.maximum(
                    cv2.remap(picture, positions.astype(np.float32), None, cv2.INTER_CUBIC), 0
                )
            )
        layers = [0.9 * layers[0], strength * layers[1]]
        sums.append(gain * (layers[0] + layers[1]))
        if k == reference:
            truth = layers
    exposure = 1 / max(1.0, np.percentile(sums[reference], 99.5))
    encoded = [_photograph(exposure * light, rng, noise) for light in sums]
    return SimulatedBurst(encoded, exposure * truth[0], exposure * truth[1])


def _photograph(light, rng, noise):
    noisy = light + rng.normal(size=light.shape) * noise * np.sqrt(0.15 + np.maximum(light, 0))
    encoded = np.rint(255 * to_encoded(np.clip(noisy, 0, 1))).astype(np.uint8)
    return np.asarray(pil(file_of(encoded, "JPEG", quality=92, subsampling=0)))


def read_photo(path, size):
    """Returns a photo in linear light, resized and cropped to (width, height)."""
    image = Image.open(path).convert("RGB")
    scale = max(size[0] / image.width, size[1] / image.height)
    image = image.resize(
        (round(image.width * scale + 0.5), round(image.height * scale + 0.5)), Image.LANCZOS
    )
    return to_linear(np.asarray(image)[: size[1], : size[0]].astype(np.float32) / 255).astype(
        np.float32
    )
