"""Resizes photo and ground truth before the methods run, as a protocol demands it."""

from __future__ import annotations

from brewster.evaluate.config import EvaluationConfig
from brewster.photo import Photo


def resize(photo: Photo, config: EvaluationConfig) -> Photo:
    """Downscales a photo to `config.short_side_px`, then to sides that are multiples of `config.size_divisor`. The
    result is 8-bit sRGB, or the photo itself if both settings leave it as it is."""
    return round_sides(downscale(photo, config.short_side_px), config.size_divisor)


def downscale(photo: Photo, shorter: int | None) -> Photo:
    """Downscales a photo by area means in linear light, so that its shorter side has `shorter` px. The result is 8-bit
    sRGB, or the photo itself if it is not larger, or if `shorter` is None."""
    if shorter is None or min(photo.size) <= shorter:
        return photo
    width, height = (round(side * shorter / min(photo.size)) for side in photo.size)
    small = Photo.from_array(photo.resized(width, height), encoding="linear")
    return Photo.from_array(small.srgb_8bit(), encoding="srgb")


def round_sides(photo: Photo, size_divisor: int) -> Photo:
    """Resizes a photo so that its sides are the next smaller multiples of `size_divisor` px.

    The 8-bit values are interpolated by cubic convolution (a = -0.5, antialiased), first along the rows, as Pillow's
    `Image.resize` does by default: the test code of DSRNet, RDNet and XReflection uses it. The result is 8-bit sRGB, or the
    photo itself if its sides are multiples, or shorter than `size_divisor`.
    """
    width, height = (max(side // size_divisor * size_divisor, min(side, size_divisor)) for side in photo.size)
    if (width, height) == photo.size:
        return photo
    import torch  # noqa: PLC0415 - an extra
    from torch.nn.functional import interpolate  # noqa: PLC0415

    pixels = torch.from_numpy(photo.srgb_8bit().copy()).permute(2, 0, 1)[None].double()
    for size in ((photo.size[1], width), (height, width)):
        pixels = interpolate(pixels, size, mode="bicubic", antialias=True).add(0.5).floor().clamp(0, 255)
    return Photo.from_array(pixels[0].byte().permute(1, 2, 0).numpy(), encoding="srgb")
