"""Reduces the GPU memory of a prediction: the transformer is offloaded by layers, and large images are decoded in tiles.

Both are methods of diffusers. Offloading does not change the result. Tiling changes it, because the VAE of
FLUX normalises each tile by its own statistics. So tiling is used only if the decoding would not fit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch

from brewster.models.diffusion.lazy_imports import import_library
from brewster.models.diffusion_resources import DECODING_BYTES_PER_PIXEL


def offload_layers(transformer: Any, vae: Any, device: str) -> None:  # noqa: ANN401 - modules of diffusers
    """Keeps the weights of the transformer in host memory, and copies each block to the device while it computes.

    The VAE is moved to the device. A LoRA must be added before this call.
    """
    vae.to(device)
    import_library("diffusers.hooks").apply_group_offloading(
        transformer,
        onload_device=torch.device(device),
        offload_device=torch.device("cpu"),
        offload_type="block_level",
        num_blocks_per_group=1,
    )


@contextlib.contextmanager
def tiled_if_large(vae: Any, pixels: int) -> Iterator[None]:  # noqa: ANN401 - a VAE of diffusers
    """Decodes in tiles within this context if images of this total number of pixels do not fit into the free GPU memory."""
    free = free_gpu_bytes(vae.device)
    if free is None or pixels * DECODING_BYTES_PER_PIXEL <= free:
        yield
        return
    vae.enable_tiling()
    try:
        yield
    finally:
        vae.disable_tiling()


def free_gpu_bytes(device: torch.device) -> int | None:
    """The free memory of a GPU in bytes, including memory that torch has reserved but does not use; None for a CPU."""
    if device.type != "cuda":
        return None
    reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + reserved
