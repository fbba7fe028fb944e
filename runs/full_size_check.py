"""Measures memory and time of training and inference at the paper's size on the local GPU.

The architectures are real, but the weights are random: nothing is downloaded, and only memory and
time are meaningful. The base model is filled and quantized layer by layer, so that the GPU never
stores the whole model in 16 bits. On larger GPUs, memory is limited to that of the paper's 24 GB
GPU. full_size_check.sh runs this script.
"""

import argparse
import gc
import json
import statistics
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import nn

from brewster.diffusion.adapter.lora import add_lora
from brewster.diffusion.backbones.registry import build, find_backbone_class
from brewster.diffusion.lazy_imports import import_library
from brewster.diffusion.pipeline import sample
from brewster.diffusion.prompt import PromptEmbedding
from brewster.diffusion.task import GUIDANCE, STEPS, PanelLayout, conditioning_image
from brewster.errors import DeviceError

GIB = 1 << 30
CAP_GIB = 23.0  # a 24 GB GPU without its CUDA context
PANEL = (512, 512)
PROMPT_TOKENS = 512
RANK = 16
PAPER_STEPS = 4000
WARMUP_STEPS = 2
TIMED_STEPS = 5
CASES = (("kontext", "int8"), ("klein", None))
TITLES = {
    "kind": "kind", "card": "GPU", "parameters": "parameters, billions",
    "lora": "LoRA, millions", "tokens": "tokens: generated, condition, "
                                        "text", "optimizer": "optimizer",
    "base_gib": "base model and VAE, GiB", "training_gib": "peak during training, GiB",
    "reserved_gib": "peak reserved by the allocator, GiB", "step_s": "training step, s",
    "steps_h": f"{PAPER_STEPS} steps, h", "photo_gib": "peak during inference, GiB",
    "photo_s": f"a photo in {STEPS} steps, s", "fits": "fits into a 24 GB GPU",
}  # fmt: skip


@dataclass
class Row:
    """Results of one backbone; None for values that were not measured."""

    backbone: str
    quantization: str | None
    kind: str
    card: str
    parameters: float | None = None
    lora: float | None = None
    tokens: str | None = None
    optimizer: str | None = None
    base_gib: float | None = None
    training_gib: float | None = None
    reserved_gib: float | None = None
    step_s: float | None = None
    steps_h: float | None = None
    photo_gib: float | None = None
    photo_s: float | None = None
    fits: bool | None = None


# --- measured


def measure(name, quantization, device, *, is_tiny):
    """Trains a backbone for a few steps, then separates one photo. Returns the measured values as a
    `Row`.
    """
    panel, prompt_tokens, rank = ((32, 32), 8, 2) if is_tiny else (PANEL, PROMPT_TOKENS, RANK)
    row = Row(
        name,
        quantization,
        "tiny version, not full size" if is_tiny else "measured",
        gpu_name(device),
    )
    try:
        backbone = random_backbone(name, quantization, device, is_tiny=is_tiny)
        prompt = random_prompt(backbone, prompt_tokens)
        row.parameters = count_parameters(backbone.transformer) / 1e9
        row.base_gib = allocated(device)
        photo = torch.rand(1, 3, panel[1], panel[0]) * 2 - 1
        train(backbone, prompt, photo, rank, row)
        separate(backbone, prompt, photo, row)
        row.fits = True
    except (torch.OutOfMemoryError, DeviceError) as error:
        row.fits = False
        print(f"{name}: {str(error).splitlines()[0]}")
    return row


def random_backbone(name, quantization, device, *, is_tiny):
    """Creates a backbone with random weights on the device. The peak memory is not above its final
    memory.
    """
    size = find_backbone_class(name).tiny if is_tiny else None
    dtype = torch.float32 if device == "cpu" else torch.bfloat16
    backbone = build(name, size, device="meta", dtype=dtype)
    fill_randomly(backbone.vae, device, None)
    fill_randomly(backbone.transformer, device, quantization)
    return backbone


def fill_randomly(part, device, quantization):
    torchao = import_library("torchao.quantization") if quantization else None
    for module in part.modules():
        for name, parameter in list(module.named_parameters(recurse=False)):
            value = torch.empty(parameter.shape, dtype=parameter.dtype, device=device).normal_(
                0, 0.02
            )
            setattr(module, name, nn.Parameter(value, requires_grad=False))
        for name, buffer in list(module.named_buffers(recurse=False)):
            setattr(module, name, torch.ones(buffer.shape, dtype=buffer.dtype, device=device))
        if torchao and isinstance(module, nn.Linear):
            torchao.quantize_(module, torchao.Int8WeightOnlyConfig())


def random_prompt(backbone, count):
    """Returns a random prompt with `count` tokens, the number of the real prompt."""
    short = backbone.random_prompt(backbone.transformer, 0)
    tensors = {
        name: tensor[:, :1].expand(1, count, -1) if tensor.ndim == 3 else tensor
        for name, tensor in short.tensors.items()
    }
    return PromptEmbedding(short.backbone, short.text, **tensors).to(
        backbone.device, backbone.dtype
    )


def train(backbone, prompt, photo, rank, row):
    """Runs the steps of diffusion/lora/trainer.py without writing files: encoding, then flow
    matching with the LoRA.
    """
    parameters = add_lora(backbone, rank=rank, alpha=rank)
    backbone.transformer.enable_gradient_checkpointing()
    optimizer = torch.optim.AdamW(parameters, lr=1e-4)
    row.lora = sum(each.numel() for each in parameters) / 1e6
    row.optimizer = "AdamW, float32 moments"
    reset_peak(backbone.device)
    composite, latents = (
        backbone.encode(conditioning_image(photo, PanelLayout())) for _ in range(2)
    )
    tokens = composite.shape[2] * composite.shape[3]
    row.tokens = f"{tokens}, {latents.shape[2] * latents.shape[3]}, {prompt.embeds.shape[1]}"
    times = [
        timed(lambda: step(backbone, prompt, composite, latents, optimizer))
        for _ in range(WARMUP_STEPS + TIMED_STEPS)
    ]
    row.step_s = statistics.median(times[WARMUP_STEPS:])
    row.steps_h = row.step_s * PAPER_STEPS / 3600
    row.training_gib, row.reserved_gib = peak(backbone.device)


def step(backbone, prompt, composite, latents, optimizer):
    optimizer.zero_grad()
    noise = torch.randn_like(composite)
    sigma = backbone.shifted(torch.randn(1).sigmoid(), composite.shape[2] * composite.shape[3])
    sigma = sigma.to(composite.device)
    velocity = backbone.predict(
        (1 - sigma) * composite + sigma * noise, latents, sigma, prompt, 1.0
    )
    loss = (velocity - (noise - composite)).square().mean()
    loss.backward()
    nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 1.0)
    optimizer.step()
    assert loss.isfinite()


def separate(backbone, prompt, photo, row):
    image = conditioning_image(photo, PanelLayout())
    size = PanelLayout().composite_size((photo.shape[3], photo.shape[2]))
    gc.collect()
    reset_peak(backbone.device)
    row.photo_s = timed(
        lambda: sample(
            backbone, image, prompt, size=size, steps=STEPS, guidance=GUIDANCE, seeds=[0]
        )
    )
    row.photo_gib, _ = peak(backbone.device)


def timed(function):
    synchronize()
    started = time.perf_counter()
    function()
    synchronize()
    return time.perf_counter() - started


def synchronize():
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def reset_peak(device):
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats()


def peak(device):
    """Returns the peak memory in GiB, allocated and reserved, or None on a CPU."""
    if torch.device(device).type != "cuda":
        return None, None
    return torch.cuda.max_memory_allocated() / GIB, torch.cuda.max_memory_reserved() / GIB


def allocated(device):
    return torch.cuda.memory_allocated() / GIB if torch.device(device).type == "cuda" else None


def count_parameters(part):
    return sum(each.numel() for each in part.parameters())


def gpu_name(device):
    return torch.cuda.get_device_name() if device == "cuda" else "CPU"


def cap_memory():
    """Limits the GPU memory to that of the paper's GPU."""
    total = torch.cuda.get_device_properties(0).total_memory / GIB
    torch.cuda.set_per_process_memory_fraction(min(1.0, CAP_GIB / total))


# --- report


def table(rows):
    lines = [
        ["", *(f"{row.backbone}, {row.quantization or 'bf16'}" for row in rows)],
        ["---"] * (len(rows) + 1),
    ]
    lines += [
        [title, *(format_cell(getattr(row, name)) for row in rows)]
        for name, title in TITLES.items()
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def format_cell(value):
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/full_size"))
    parser.add_argument(
        "--tiny",
        action="store_true",
        help="run the same code with tiny versions of the backbones; a CPU is sufficient",
    )
    options = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*get_apply_tensor_subclass.*")
    has_gpu = torch.cuda.is_available()
    if not (has_gpu or options.tiny):
        parser.error("torch finds no GPU: expected one with 24 GiB, or --tiny")
    if has_gpu:
        cap_memory()
    rows = []
    for name, quantization in CASES:
        rows.append(measure(name, quantization, "cuda" if has_gpu else "cpu", is_tiny=options.tiny))
        gc.collect()
        if has_gpu:
            torch.cuda.empty_cache()
        save(rows, options.out)
    print(table(rows))
    return 0 if all(row.fits for row in rows) else 1


def save(rows, out):
    """Writes the results. It is called after each backbone, so that an interrupted run keeps the
    finished results.
    """
    out.mkdir(parents=True, exist_ok=True)
    versions = {"torch": torch.__version__, "cuda": torch.version.cuda}
    results = {"versions": versions, "cap_gib": CAP_GIB, "rows": [asdict(row) for row in rows]}
    (out / "full_size.json").write_text(json.dumps(results, indent=2) + "\n")
    (out / "full_size.md").write_text(table(rows) + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
