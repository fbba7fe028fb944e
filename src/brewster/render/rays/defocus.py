"""A thin lens over far content: where light depends on direction alone, defocus is a convolution with a disc.

A ray from the lens point l through the focus of pixel p has the direction p - l / f, in the plane at distance 1:
so the picture is the pinhole's, averaged over a disc of radius aperture / (2 f).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from brewster.scene.camera import Camera

_FINENESS = 8  # places per pixel and direction where the disc is tested
_SMALLEST_PX = 0.1


def _radius_px(camera: Camera) -> float:
    return camera.aperture_mm / 2 / camera.focus_mm / camera.pixel_rad


def margin_px(camera: Camera) -> int:
    """How many pixels around the picture the lens reaches for; 0 for a pinhole."""
    radius = _radius_px(camera)
    return math.ceil(radius + 0.5) if radius > _SMALLEST_PX else 0


def blurred(picture: Tensor, camera: Camera, margin: int) -> Tensor:
    """The picture (3, H + 2 margin, W + 2 margin) through the lens: (3, H, W)."""
    if margin == 0:
        return picture
    kernel = _disc(_radius_px(camera), margin).to(picture.device)
    height, width = (side + 2 * margin for side in picture.shape[1:])
    spectrum = torch.fft.rfft2(picture.double(), (height, width)) * torch.fft.rfft2(kernel, (height, width))
    full = torch.fft.irfft2(spectrum, (height, width)).to(picture.dtype)  # the sun needs double precision
    low, high = 2 * margin, full.shape[1] - 2 * margin
    seen: Tensor = full[:, low:high, 2 * margin : full.shape[2] - 2 * margin].clamp(min=0)
    return seen


def _disc(radius_px: float, reach: int) -> Tensor:
    """Shares of a disc in the pixels of a (2 reach + 1) square, summing to 1."""
    side = (2 * reach + 1) * _FINENESS
    place = (torch.arange(side) + 0.5) / _FINENESS - reach - 0.5
    inside = (place[:, None] ** 2 + place**2 <= radius_px**2).double()
    disc = functional.avg_pool2d(inside[None], _FINENESS)[0]
    shares: Tensor = disc / disc.sum()
    return shares
