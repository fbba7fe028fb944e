"""Defocus of distant content by a thin lens, as a convolution.

The ray from point l on the lens to the image of pixel p in the focus plane has the direction p - l
/ f, where p is in the plane at distance 1 and f is the focus distance. Light from infinity depends
on the direction alone, so its image is the pinhole image averaged over a disc of radius aperture /
(2 f). For near content there is no single kernel, because the blur depends on depth.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from brewster.render.scene.camera import Camera

_SUPERSAMPLING = 8  # points per pixel and axis at which the disc is tested
_MIN_RADIUS_PX = 0.1  # a smaller blur is not visible; the camera is then treated as a pinhole


def _radius_px(camera: Camera) -> float:
    return camera.aperture_mm / 2 / camera.focus_mm / camera.pixel_rad


def margin_px(camera: Camera) -> int:
    """Returns the number of pixels that the blur needs beyond each border of the image; 0 for a
    pinhole.
    """
    radius = _radius_px(camera)
    return math.ceil(radius + 0.5) if radius > _MIN_RADIUS_PX else 0


def defocus_blur(image: Tensor, camera: Camera, margin: int) -> Tensor:
    """Applies the blur of the lens to an image (3, H + 2 margin, W + 2 margin) and removes the
    margin: (3, H, W).
    """
    if margin == 0:
        return image
    kernel = _disc_kernel(_radius_px(camera), margin).to(image.device)
    height, width = (side + 2 * margin for side in image.shape[1:])
    # Rounding errors of an FFT scale with the brightest pixel. With a sun in the image, float32 is
    # too coarse for shadows.
    spectrum = torch.fft.rfft2(image.double(), (height, width)) * torch.fft.rfft2(
        kernel, (height, width)
    )
    convolved = torch.fft.irfft2(spectrum, (height, width)).to(image.dtype)
    low = 2 * margin
    high = convolved.shape[1] - 2 * margin
    blurred: Tensor = convolved[:, low:high, 2 * margin : convolved.shape[2] - 2 * margin].clamp(
        min=0
    )
    return blurred


def _disc_kernel(radius_px: float, half_size: int) -> Tensor:
    """Returns an antialiased disc on a square with sides of 2 half_size + 1 pixels; the values sum
    to 1.
    """
    side = (2 * half_size + 1) * _SUPERSAMPLING
    position = (torch.arange(side) + 0.5) / _SUPERSAMPLING - half_size - 0.5
    inside = (position[:, None] ** 2 + position**2 <= radius_px**2).double()
    disc = functional.avg_pool2d(inside[None], _SUPERSAMPLING)[0]
    kernel: Tensor = disc / disc.sum()
    return kernel
