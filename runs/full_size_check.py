"""What the paper's size takes: memory and time of learning and of separating, measured on the GPU that is here.

Real architectures, random weights: nothing is downloaded, and nothing but memory and time means anything. The base is
filled and quantised layer by layer, so that it never stands on the card in 16 bits as a whole. On larger cards memory
is capped, so that what runs here runs on the paper's 24 GB. See full_size_check.sh for how to call it.
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

from brewster.errors import DeviceError
from brewster.models.diffusion.adapter.lora import add_lora
from brewster.models.diffusion.backbones import build, find_family
from brewster.models.diffusion.lazy_imports import library
from brewster.models.diffusion.panels import PanelLayout, condition
from brewster.models.diffusion.prompt import PromptEmbedding
from brewster.models.diffusion.sampling import GUIDANCE, STEPS, sample

GIB = 1 << 30
CAP_GIB = 23.0  # a 24 GB card, less what CUDA itself takes
PANEL = (512, 512)
WORDS = 512
RANK = 16
PAPER_STEPS = 4000
WARM, TIMED = 2, 5
CASES = (("kontext", "int8"), ("klein", None))
TITLES = {
    "kind": "measured or estimated", "card": "card", "parameters": "parameters, billions",
    "lora": "LoRA, millions", "tokens": "tokens: generated, shown, text", "optimizer": "optimizer",
    "base_gib": "base and VAE, GiB", "learning_gib": "peak while learning, GiB",
    "reserved_gib": "the same, with what the allocator holds, GiB", "step_s": "a step, s",
    "steps_h": f"{PAPER_STEPS} steps, h", "picture_gib": "peak while separating, GiB",
    "picture_s": f"a photo in {STEPS} steps, s", "fits": "fits a 24 GB card",
}  # fmt: skip


@dataclass
class Row:
    """What one backbone took; None where nobody measured it."""

    backbone: str
    quantise: str | None
    kind: str
    card: str
    parameters: float | None = None
    lora: float | None = None
    tokens: str | None = None
    optimizer: str | None = None
    base_gib: float | None = None
    learning_gib: float | None = None
    reserved_gib: float | None = None
    step_s: float | None = None
    steps_h: float | None = None
    picture_gib: float | None = None
    picture_s: float | None = None
    fits: bool | None = None


# --- measured


def measure(name, quantise, device, *, is_tiny):
    """Learns for a few steps, then separates once."""
    panel, words, rank = ((32, 32), 8, 2) if is_tiny else (PANEL, WORDS, RANK)
    row = Row(name, quantise, "rehearsed on a toy twin" if is_tiny else "measured", card_name(device))
    try:
        backbone = furnished(name, quantise, device, is_tiny=is_tiny)
        prompt = random_words(backbone, words)
        row.parameters = weights(backbone.transformer) / 1e9
        row.base_gib = allocated(device)
        photo = torch.rand(1, 3, panel[1], panel[0]) * 2 - 1
        learn(backbone, prompt, photo, rank, row)
        separate(backbone, prompt, photo, row)
        row.fits = True
    except (torch.OutOfMemoryError, DeviceError) as error:
        row.fits = False
        print(f"{name}: {str(error).splitlines()[0]}")
    return row


def furnished(name, quantise, device, *, is_tiny):
    """A backbone with random weights on the device, and not a moment larger there than in the end."""
    size = find_family(name).tiny if is_tiny else None
    dtype = torch.float32 if device == "cpu" else torch.bfloat16
    backbone = build(name, size, device="meta", dtype=dtype)
    fill(backbone.vae, device, None)
    fill(backbone.transformer, device, quantise)
    return backbone


def fill(part, device, quantise):
    torchao = library("torchao.quantization") if quantise else None
    for module in part.modules():
        for name, parameter in list(module.named_parameters(recurse=False)):
            value = torch.empty(parameter.shape, dtype=parameter.dtype, device=device).normal_(0, 0.02)
            setattr(module, name, nn.Parameter(value, requires_grad=False))
        for name, buffer in list(module.named_buffers(recurse=False)):
            setattr(module, name, torch.ones(buffer.shape, dtype=buffer.dtype, device=device))
        if torchao and isinstance(module, nn.Linear):
            torchao.quantize_(module, torchao.Int8WeightOnlyConfig())


def random_words(backbone, count):
    """A prompt as long as the real one."""
    few = backbone.random_prompt(backbone.transformer, 0)
    tensors = {
        name: tensor[:, :1].expand(1, count, -1) if tensor.ndim == 3 else tensor
        for name, tensor in few.tensors.items()
    }
    return PromptEmbedding(few.backbone, few.text, **tensors).to(backbone.device, backbone.dtype)


def learn(backbone, prompt, photo, rank, row):
    """The steps of train/large/learner.py, without its files: encode once, then flow matching on the LoRA alone."""
    parameters = add_lora(backbone, rank=rank, alpha=rank)
    backbone.transformer.enable_gradient_checkpointing()
    optimizer = torch.optim.AdamW(parameters, lr=1e-4)
    row.lora, row.optimizer = sum(each.numel() for each in parameters) / 1e6, "AdamW, float32 moments"
    reset_peak(backbone.device)
    composite, shown = (backbone.encode(condition(photo, PanelLayout())) for _ in range(2))
    cells = composite.shape[2] * composite.shape[3]
    row.tokens = f"{cells}, {shown.shape[2] * shown.shape[3]}, {prompt.embeds.shape[1]}"
    times = [timed(lambda: step(backbone, prompt, composite, shown, optimizer)) for _ in range(WARM + TIMED)]
    row.step_s = statistics.median(times[WARM:])
    row.steps_h = row.step_s * PAPER_STEPS / 3600
    row.learning_gib, row.reserved_gib = peak(backbone.device)


def step(backbone, prompt, composite, shown, optimizer):
    optimizer.zero_grad()
    noise = torch.randn_like(composite)
    sigma = backbone.shifted(torch.randn(1).sigmoid(), composite.shape[2] * composite.shape[3])
    sigma = sigma.to(composite.device)
    velocity = backbone.predict((1 - sigma) * composite + sigma * noise, shown, sigma, prompt, 1.0)
    loss = (velocity - (noise - composite)).square().mean()
    loss.backward()
    nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 1.0)
    optimizer.step()
    assert loss.isfinite()


def separate(backbone, prompt, photo, row):
    shown = condition(photo, PanelLayout())
    size = PanelLayout().composite_size((photo.shape[3], photo.shape[2]))
    gc.collect()
    reset_peak(backbone.device)
    row.picture_s = timed(
        lambda: sample(backbone, shown, prompt, size=size, steps=STEPS, guidance=GUIDANCE, seeds=[0])
    )
    row.picture_gib, _ = peak(backbone.device)


def timed(work):
    synchronize()
    started = time.perf_counter()
    work()
    synchronize()
    return time.perf_counter() - started


def synchronize():
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def reset_peak(device):
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats()


def peak(device):
    """GiB in tensors at most, and in what the allocator held for them; unknown on a CPU."""
    if torch.device(device).type != "cuda":
        return None, None
    return torch.cuda.max_memory_allocated() / GIB, torch.cuda.max_memory_reserved() / GIB


def allocated(device):
    return torch.cuda.memory_allocated() / GIB if torch.device(device).type == "cuda" else None


def weights(part):
    return sum(each.numel() for each in part.parameters())


def card_name(device):
    return torch.cuda.get_device_name() if device == "cuda" else "CPU"


def cap():
    """As if the card had no more than the paper's."""
    total = torch.cuda.get_device_properties(0).total_memory / GIB
    torch.cuda.set_per_process_memory_fraction(min(1.0, CAP_GIB / total))


# --- estimated, where there is no GPU


def estimate(name, quantise):
    """The numbers of `brewster train --plan` for the recipe of this name, on the paper's card."""
    from brewster.training.lora.resource_estimate import CARDS, estimate_resources  # noqa: PLC0415  (the trainer may lack its libraries)
    from brewster.training.recipe import read_recipe  # noqa: PLC0415

    card = CARDS["RTX 4090"]
    recipe = read_recipe(Path(__file__).parents[1] / f"recipes/train/{name}.toml")
    plan = estimate_resources(recipe, card)
    forward_s = (
        plan.seconds / 3 / recipe.batch
    )  # of a step's three: forward, once more for the checkpoints, back
    passes = STEPS * (1 if find_family(name).guided_by_embedding else 2)
    return Row(
        name, quantise, "ESTIMATED from meta tensors, not measured", card.name,
        parameters=plan.parameters / 1e9, lora=plan.lora_parameters / 1e6,
        tokens=f"{plan.generated_tokens}, {plan.condition_tokens}, {WORDS}", base_gib=plan.memory_gib["base"] + plan.memory_gib["VAE"],
        learning_gib=plan.total_gib, step_s=plan.seconds, steps_h=plan.seconds * PAPER_STEPS / 3600,
        picture_s=passes * forward_s, fits=plan.total_gib <= card.memory_gib,
    )  # fmt: skip


# --- told


def table(rows):
    lines = [["", *(f"{row.backbone}, {row.quantise or 'bf16'}" for row in rows)], ["---"] * (len(rows) + 1)]
    lines += [[title, *(told(getattr(row, name)) for row in rows)] for name, title in TITLES.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def told(value):
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/full_size"))
    parser.add_argument("--tiny", action="store_true", help="the same code on toy twins, on the CPU too")
    asked = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*get_apply_tensor_subclass.*")
    has_card = torch.cuda.is_available()
    if has_card:
        cap()
    rows = []
    for name, quantise in CASES:
        if has_card or asked.tiny:
            rows.append(measure(name, quantise, "cuda" if has_card else "cpu", is_tiny=asked.tiny))
        else:
            rows.append(estimate(name, quantise))
        gc.collect()
        if has_card:
            torch.cuda.empty_cache()
        save(rows, asked.out)
    print(table(rows))
    return 0 if all(row.fits for row in rows) else 1


def save(rows, out):
    """After each backbone, so that a run that is cut off leaves what it has."""
    out.mkdir(parents=True, exist_ok=True)
    versions = {"torch": torch.__version__, "cuda": torch.version.cuda}
    told = {"versions": versions, "cap_gib": CAP_GIB, "rows": [asdict(row) for row in rows]}
    (out / "full_size.json").write_text(json.dumps(told, indent=2) + "\n")
    (out / "full_size.md").write_text(table(rows) + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
