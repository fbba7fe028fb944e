"""The plan of a separation: the numbers of the estimates for training, and of the pipeline that it plans."""

import importlib.util
import json
import subprocess
import sys

import huggingface_hub.constants
import numpy as np
import pytest
import torch

from brewster import Photo
from brewster.errors import DeviceError
from brewster.inference.diffusion_predictor import DiffusionPredictor
from brewster.inference.separation_plan import plan_separation
from brewster.models.diffusion.adapter.lora import add_lora, save_lora
from brewster.models.diffusion.backbones.registry import tiny
from brewster.models.diffusion.pipeline import load_pipeline
from brewster.models.diffusion.task import DecompositionTask
from brewster.models.diffusion_models import DIFFUSION_MODELS
from brewster.models.diffusion_resources import CARDS, weights_gib
from brewster.options import Options

CARD = CARDS["RTX 4090"]


@pytest.fixture(autouse=True)
def offline(tmp_path, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)


@pytest.fixture
def lora(tmp_path):
    backbone, prompt = tiny("kontext")
    add_lora(backbone, rank=1)
    save_lora(
        tmp_path / "lora", backbone, prompt, DecompositionTask(), base_model="kontext", quantization="int8"
    )
    return str(tmp_path / "lora")


def test_the_plan_of_the_papers_lora_has_the_known_numbers(lora):
    plan = plan_separation(Options(model=lora), (4096, 4096), CARD)
    assert "1 of 512 x 512 pixels a panel; 20 passes" in plan.table()
    assert plan.tflop == pytest.approx(20 * 351 / 3, rel=0.01)
    assert plan.seconds == pytest.approx(35, abs=1)
    assert plan.memory_gib["weights"] == pytest.approx(11.2, abs=0.2)
    assert 13 < plan.total_gib < 16
    assert plan.download_gb == pytest.approx(24, abs=0.5)
    assert plan.text_encoder_gb == 0  # the prompt is stored with the LoRA
    for text in (
        "int8, on the GPU",
        f"{plan.total_gib:.1f} GiB of 24 on RTX 4090",
        f"{plan.seconds:.1f} s (estimate)",
    ):
        assert text in plan.table()
    assert "host memory             0.0 GiB for the weights" in plan.table()
    small = plan_separation(Options(model=lora, steps=4), (4096, 4096), CARDS["RTX 4060"])
    assert small.placement.is_offloaded
    assert small.total_gib < 8
    copies = 4 * weights_gib(small.cost.parameters, "int8") * 1.0737 / 10
    assert small.seconds == pytest.approx(4 * 117 / (0.4 * 30) + copies, rel=0.01)
    with pytest.raises(DeviceError, match="GiB; expected at most the 8 GiB of RTX 4060"):
        plan_separation(Options(model=lora, offload="none"), (4096, 4096), CARDS["RTX 4060"]).check_fits()


@pytest.mark.parametrize(("has_bitsandbytes", "quantization"), [(True, "nf4"), (False, "int8")])
def test_windowseat_is_planned_before_its_download(monkeypatch, has_bitsandbytes, quantization):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *package: (
            (has_bitsandbytes or None) if name == "bitsandbytes" else find_spec(name, *package)
        ),
    )
    plan = plan_separation(Options(model="windowseat"), (1600, 800), CARD)
    assert "3 of 768 x 768 pixels a panel; 3 passes" in plan.table()
    assert (plan.placement.quantization, plan.text_encoder_gb) == (quantization, 0)
    assert plan.download_gb == pytest.approx(41, abs=0.5)
    assert "licence                 Apache-2.0" in plan.table()


@pytest.mark.parametrize("name", list(DIFFUSION_MODELS))
def test_the_list_of_models_agrees_with_the_plan(name, run_without_model):
    plan = plan_separation(Options(model=name), (4000, 3000), CARD)
    rows = {row["name"]: row for row in json.loads(run_without_model("models", "list", "--json")[1])}
    assert rows[name]["memory_gib"] == pytest.approx(plan.total_gib, abs=0.05)
    assert rows[name]["download_gb"] + rows[name]["text_encoder_gb"] == pytest.approx(
        plan.download_gb, abs=0.1
    )
    assert (rows[name]["weight_format"], rows[name]["licence"]) == (
        plan.placement.quantization or "bf16",
        DIFFUSION_MODELS[name].licence,
    )
    assert rows[name]["offloaded_memory_gib"] < 5


def test_a_listed_model_is_planned_without_torch_or_the_libraries_of_diffusion(tmp_path):
    Photo.from_array(np.full((64, 96, 3), 0.3, np.float32), encoding="linear").save(tmp_path / "photo.png")
    missing = [
        "torch",
        "diffusers",
        "transformers",
        "peft",
        "huggingface_hub",
        "psutil",
        "safetensors",
        "accelerate",
    ]
    code = (
        f"import importlib.util, runpy, sys; missing = {missing}; find = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *a: None if name in missing else find(name, *a)\n"
        "sys.modules.update(dict.fromkeys(missing)); runpy.run_module('brewster', run_name='__main__')"
    )
    for name in DIFFUSION_MODELS:
        command = [sys.executable, "-c", code, "photo.png", "--model", name, "--gpu", "rx 7900 xtx"]
        run = subprocess.run(command, check=False, cwd=tmp_path, capture_output=True, text=True)
        assert (run.returncode, run.stderr) == (0, ""), name
        assert f"model                   {name}, " in run.stdout
        assert "of 24 on RX 7900 XTX" in run.stdout


@pytest.mark.parametrize("quality", ["draft", "standard"])
@pytest.mark.parametrize("name", ["kontext", "klein"])
def test_the_planned_passes_are_those_of_the_separation(name, quality, monkeypatch):
    size = (96, 64)
    options = Options(model=f"tiny:{name}", steps=2, ensemble_size=2, quality=quality)
    plan = plan_separation(options, size, CARD)
    assert plan.download_gb == 0
    pipeline = load_pipeline(options.model)
    transformer, calls = pipeline.backbone.transformer, []
    transformer.register_forward_hook(lambda *_: calls.append(1))
    photo = Photo.from_array(np.full((*size[::-1], 3), 0.3, np.float32), encoding="linear")
    predictor = DiffusionPredictor(pipeline, steps=2, ensemble_size=2)
    inputs = [photo.resized(*each) for each in predictor.input_sizes(size, quality)]
    with torch.no_grad():
        predictor(inputs, quality, lambda fraction: None)
    assert f"; {len(calls)} passes" in plan.table()
