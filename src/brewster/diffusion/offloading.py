"""Reduces the GPU memory of a prediction: the transformer is offloaded by layers, large images are
decoded in tiles.

Offloading does not change the result. Tiling does, because the VAE of FLUX normalises each tile by
its own statistics, so it is used only if the decoding would not fit.
"""

import contextlib
import re
from collections.abc import Iterator
from typing import Any, Final

import torch

from brewster.diffusion.lazy_imports import import_library
from brewster.errors import DeviceError

DECODING_BYTES_PER_PIXEL: Final = 3000
"""Activations of a full-size VAE in bf16 for one pixel of the decoded image: about six maps of 256
channels.
"""
_CPU_MEMORY_ERROR: Final = re.compile(
    r"out of memory|not enough memory|can't allocate memory", re.IGNORECASE
)


def offload_layers(transformer: Any, vae: Any, device: str) -> None:  # noqa: ANN401 - modules of diffusers
    """Keeps the weights of the transformer in host memory, and copies each block to the device
    while it computes. The VAE is moved to the device. A LoRA must be added before this call.
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
    """Decodes in tiles within this context if images with this many pixels do not fit into the free
    GPU memory.
    """
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
    """The free memory of a GPU in bytes, including memory that torch has reserved but does not use;
    None for a CPU.
    """
    if device.type != "cuda":
        return None
    reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + reserved


@contextlib.contextmanager
def explain_out_of_memory(hint: str) -> Iterator[None]:
    """Converts out-of-memory errors of any device to a DeviceError; `hint` says what to reduce."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or _CPU_MEMORY_ERROR.search(
            str(error)
        ):
            first = str(error).splitlines()[0] if str(error) else "out of memory"
            raise DeviceError(
                f"the device ran out of memory ({first})",
                "expected enough memory for the model",
                hint,
            ) from error
        raise
