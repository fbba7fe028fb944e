"""Resource estimates, compared with values that were counted and measured independently."""

import re
import types
from pathlib import Path

import pytest
import torch

from brewster.errors import DeviceError, DownloadError
from brewster.models.diffusion.backbones.registry import tiny
from brewster.models.diffusion_resources import CARDS, GraphicsCard, find_gpu, local_gpu
from brewster.training.lora.resource_estimate import estimate_resources
from brewster.training.recipe import read_recipe, with_value
from published_models import KLEIN_9B, write_klein_9b

RECIPES = Path(__file__).parents[1] / "recipes" / "train"
CARD = CARDS["RTX 4090"]


@pytest.fixture(scope="module")
def klein():
    return estimate_resources(read_recipe(RECIPES / "klein.toml"), CARD)


def test_klein_fits_the_papers_gpu_with_the_known_sizes(klein):
    assert "512 x 512 each" in klein.table()
    assert klein.generated_tokens == klein.condition_tokens == 3 * 32 * 32
    assert klein.cost.parameters == pytest.approx(3.88e9, rel=0.01)
    assert klein.memory_gib["backbone"] == pytest.approx(7.2, abs=0.1)
    klein.check_fits()
    assert klein.total_gib < 16


def test_the_estimate_for_kontext_agrees_with_the_counts_for_the_paper():
    estimate = estimate_resources(read_recipe(RECIPES / "kontext.toml"), CARD)
    assert estimate.cost.parameters == pytest.approx(11.9e9, rel=0.01)
    assert estimate.memory_gib["backbone"] == pytest.approx(11.2, abs=0.2)
    assert estimate.memory_gib["LoRA and AdamW"] == pytest.approx(1.3, abs=0.1)
    assert estimate.memory_gib["activations"] == pytest.approx(3.7, abs=0.2)
    assert estimate.tflop == pytest.approx(351, rel=0.01)
    assert 17 <= estimate.total_gib <= 19


def test_a_recipe_that_does_not_fit_is_refused_with_a_change_that_fits(klein):
    recipe = with_value(read_recipe(RECIPES / "klein.toml"), "max_composite_pixels", 768 * 256)
    for memory, cure in (
        (7, 'set quantization = "int8", which needs'),
        (5.5, 'set quantization = "nf4"'),
        (2, "lower max_composite_pixels"),
    ):
        estimate = estimate_resources(recipe, GraphicsCard("toy card", memory, 100))
        with pytest.raises(DeviceError, match=f"{memory} GiB of toy card; {cure}"):
            estimate.check_fits()


def test_gpus_are_found_by_name_and_that_of_the_paper_is_the_default_without_a_gpu(monkeypatch):
    assert find_gpu("rtx 4090") == find_gpu("NVIDIA GeForce RTX 4090") == CARD
    assert find_gpu("AMD Radeon RX 7900 XTX") == find_gpu("rx 7900 xtx") == CARDS["RX 7900 XTX"]
    with pytest.raises(
        DeviceError, match=r"no GPU 'GTX 1650' .* RTX 4060 \(8 GiB\), .*; choose one with as much memory"
    ):
        find_gpu("GTX 1650")
    with pytest.raises(DeviceError, match="M3 Max is by Apple; expected an NVIDIA or AMD GPU"):
        find_gpu("M3 Max")
    with pytest.raises(DeviceError, match="Intel Arc A770 is by Intel"):
        find_gpu("Intel Arc A770")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name, known in {
        "AMD Radeon RX 7900 XTX": "RX 7900 XTX",
        "NVIDIA A100-SXM4-80GB": "A100",
        "NVIDIA GeForce RTX 4060 Ti 16 GB": "RTX 4060 Ti 16 GB",
        "toy": "RTX 4090",
    }.items():
        found = types.SimpleNamespace(name=name, total_memory=2**34)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _device, found=found: found)
        assert local_gpu() == GraphicsCard(name, 16, CARDS[known].tflops)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert local_gpu() is None


def test_a_backbone_on_the_hub_or_in_a_folder_is_counted_by_its_configuration(tmp_path, monkeypatch):
    recipe = read_recipe(RECIPES / "klein.toml")
    write_klein_9b(tmp_path, monkeypatch)
    estimate = estimate_resources(with_value(recipe, "backbone", KLEIN_9B), CARD)
    assert estimate.cost.parameters == pytest.approx(9.08e9, rel=0.01)
    assert re.search(r"download +26 GB, of which 8 GB are text encoders", estimate.table())
    with pytest.raises(DownloadError, match="somebody/else is not in the cache"):
        estimate_resources(with_value(recipe, "backbone", "somebody/else"), CARD)
    tiny("klein")[0].save(tmp_path / "klein")
    folder = estimate_resources(with_value(recipe, "backbone", str(tmp_path / "klein")), CARD)
    assert folder.cost.parameters == tiny("klein")[0].transformer.num_parameters()
    assert re.search(r"download +0 GB, of which 0 GB are text encoders", folder.table())


def test_the_command_prints_the_estimate_and_trains_nothing(run_without_model, tmp_path, monkeypatch):
    monkeypatch.delenv("BREWSTER_DATA", raising=False)
    code, out, err = run_without_model("train", RECIPES / "lora-tiny.toml", "--plan", "--gpu", "A100")
    assert code == 0
    assert b"A100" in out
    assert "the data was not checked: BREWSTER_DATA is not set" in err
    assert list(tmp_path.iterdir()) == []
    code, _, err = run_without_model("train", RECIPES / "tiny.toml", "--plan")
    assert code != 0
    assert "train it without --plan" in err


def test_white_space_and_the_optimiser_change_the_estimate():
    recipe = read_recipe(RECIPES / "lora-tiny.toml")
    full, plain = (
        estimate_resources(recipe, CARD),
        estimate_resources(with_value(recipe, "white_space", False), CARD),
    )
    assert full.condition_tokens == 3 * plain.condition_tokens
    eight_bit = estimate_resources(with_value(recipe, "optimizer", "adamw8bit"), CARD)
    part = "LoRA and AdamW"
    assert eight_bit.memory_gib[part] == pytest.approx(full.memory_gib[part] * 10 / 16)
    attention = estimate_resources(with_value(recipe, "target_modules", ["*.attn.*"]), CARD)
    assert 0 < attention.lora_parameters < full.lora_parameters
