"""What a base needs of the machine, with stand-ins for its GPU, memory and disk; and a cache with a
limit.
"""

import functools
import importlib.util
import sys
from types import SimpleNamespace

import huggingface_hub.constants
import numpy as np
import psutil
import pytest
import torch

from brewster.base.cache import ByteLimitedCache
from brewster.diffusion.backbones.loading import load_backbone
from brewster.diffusion.backbones.registry import BACKBONES, backbone_cost, tiny
from brewster.diffusion.memory import (
    BACKBONE_COSTS,
    Placement,
    WeightChoice,
    check_machine,
    choose_placement,
    place_on_gpu,
)
from brewster.errors import DeviceError, MissingExtra, ModelError
from brewster.separation import Separator
from published_models import KLEIN_9B, save_backbone, write_klein_9b

KONTEXT = BACKBONE_COSTS["kontext"]
QWEN = BACKBONE_COSTS["qwen"]


@pytest.mark.parametrize("name", list(BACKBONES))
def test_the_weights_of_a_folder_are_counted_whatever_their_precision(name, tmp_path):
    backbone, _ = tiny(name)
    expected = backbone.transformer.num_parameters()
    for dtype in (torch.float32, torch.bfloat16):
        backbone.transformer.to(dtype)
        save_backbone(backbone, tmp_path / str(dtype))
        assert backbone_cost(str(tmp_path / str(dtype)), BACKBONES[name]).transformer == expected
    assert backbone_cost(f"tiny:{name}", BACKBONES[name]).transformer == 0


def test_the_weights_of_a_hub_id_are_counted_by_its_configuration(tmp_path, monkeypatch):
    write_klein_9b(tmp_path, monkeypatch)
    klein = BACKBONES["klein"]
    assert backbone_cost(KLEIN_9B, klein).transformer == pytest.approx(9.08e9, rel=0.01)
    assert backbone_cost("someone/not-in-the-cache", klein) == BACKBONE_COSTS["klein"]
    config = next(tmp_path.rglob("transformer/config.json"))
    config.write_text('{"num_layers": "many"}')
    with pytest.raises(ModelError, match=r"config.json has invalid settings"):
        backbone_cost(KLEIN_9B, klein)


@pytest.fixture
def machine(monkeypatch):
    """Sets the free memory of this machine in GiB; by default it is large."""
    available = {"memory": 500.0}

    def free_bytes(_=None):
        return int(available["memory"] * (1 << 30))

    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=free_bytes()))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: [free_bytes()] * 2)
    return available


def test_a_large_base_needs_a_gpu_unless_the_cpu_is_chosen(machine, tmp_path):
    with pytest.raises(
        DeviceError, match=r"finds no GPU, and kontext has 11\.9 billion .*--device cpu"
    ):
        check_machine("kontext", KONTEXT, Placement("cpu"), requested="auto")
    check_machine("kontext", KONTEXT, Placement("cpu"), requested="cpu")
    save_backbone(tiny("kontext")[0], tmp_path / "kontext")
    for small in ("tiny:kontext", str(tmp_path / "kontext")):
        cost = backbone_cost(small, BACKBONES["kontext"])
        check_machine(small, cost, Placement("cpu"), requested="auto")


@pytest.mark.parametrize("device", ["cuda", "rocm"])
def test_a_gpu_that_torch_does_not_find_is_an_error_before_its_memory_is_read(device):
    with pytest.raises(DeviceError, match=r"there is no CUDA device; .*on Windows"):
        Separator.load("tiny:kontext", device=device)


def place(name, memory_gib, free_gib=None, **options):
    weights = BACKBONE_COSTS[name].transformer
    sizes = {"free_gib": free_gib or memory_gib, "total_gib": memory_gib}
    placement = place_on_gpu(weights, WeightChoice(**options), **sizes)
    return placement.quantization, placement.is_offloaded


def test_the_quantization_is_chosen_by_the_memory_of_the_gpu(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    chosen = {memory: place("kontext", memory) for memory in (40, 24, 16, 12, 8)}
    assert chosen == {
        40: (None, False),
        24: ("int8", False),
        16: ("int8", False),
        12: ("nf4", False),
        8: ("int8", True),
    }
    assert place("klein", 24) == (None, False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert place("kontext", 12) == ("int8", True)


@pytest.mark.parametrize(
    ("memory", "is_offloaded"), [(12, True), (16, True), (24, False), (80, False)]
)
def test_without_bitsandbytes_int8_replaces_nf4(monkeypatch, memory, is_offloaded):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert place("qwen", memory, preferred="nf4") == ("int8", is_offloaded)
    assert place("qwen", memory, preferred="nf4", offload="none") == ("int8", False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert place("qwen", 24, preferred="nf4") == ("nf4", False)


def test_nf4_without_bitsandbytes_is_refused_before_any_download(machine, monkeypatch):
    monkeypatch.setitem(sys.modules, "bitsandbytes", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(
        huggingface_hub, "snapshot_download", lambda *_, **__: pytest.fail("downloaded")
    )
    cure = r"bitsandbytes cannot be imported .*; run: pip install bitsandbytes, or choose .* int8"
    with pytest.raises(MissingExtra, match=cure):
        check_machine("qwen", QWEN, Placement("cuda", "nf4"), requested="auto")
    with pytest.raises(MissingExtra, match=cure):
        load_backbone("qwen", device="cuda", quantization="nf4")


def test_the_weights_are_offloaded_only_if_they_do_not_fit_or_on_request(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert place("kontext", 24, free_gib=10) == ("int8", True)
    assert place("kontext", 24, free_gib=10, offload="none") == ("int8", False)
    assert place("kontext", 80, offload="layers") == (None, True)
    assert place("kontext", 12, quantization="int8") == ("int8", True)
    assert place("qwen", 80, preferred="nf4", offload="layers") == ("int8", True)
    assert place("qwen", 12, free_gib=4, quantization="nf4") == ("nf4", False)
    with pytest.raises(DeviceError, match=r"with quantization = nf4; .*cannot be moved"):
        place("qwen", 80, quantization="nf4", offload="layers")


def test_on_a_cpu_nothing_is_quantized_by_default_and_nothing_is_offloaded():
    weights = KONTEXT.transformer
    assert choose_placement(weights, WeightChoice(preferred="int8"), "cpu") == Placement("cpu")
    with pytest.raises(DeviceError, match="layers was requested on the CPU; expected a GPU"):
        choose_placement(weights, WeightChoice(offload="layers"), "cpu")


def test_an_offloaded_base_needs_host_memory_instead_of_gpu_memory(machine, monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: [5 << 30] * 2)
    offloaded = Placement("cuda", "int8", is_offloaded=True)
    check_machine("kontext", KONTEXT, offloaded, requested="auto")
    with pytest.raises(DeviceError, match=r"about 14\.\d GiB of memory on cuda, and 5\.0"):
        check_machine("kontext", KONTEXT, Placement("cuda", "int8"), requested="auto")
    machine["memory"] = 12
    with pytest.raises(
        DeviceError, match=r"about 13\.\d GiB of host memory, because it is offloaded"
    ):
        check_machine("kontext", KONTEXT, offloaded, requested="auto")


def test_text_encoders_need_host_memory(machine, monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: [80 << 30] * 2)
    machine["memory"] = 15
    check = functools.partial(check_machine, placement=Placement("cuda"), requested="auto")
    check("qwen", QWEN)
    check("kontext", KONTEXT, with_text_encoders=True)
    message = r"qwen needs about 17\.4 GiB of host memory, because its text encoders .* 15\.0 GiB"
    with pytest.raises(DeviceError, match=message):
        check("qwen", QWEN, with_text_encoders=True)


def test_memory_is_checked_before_the_download(machine):
    machine["memory"] = 40
    with pytest.raises(
        DeviceError, match=r"kontext needs about 46\.\d GiB of memory on cpu, and 40\.0"
    ):
        check_machine("kontext", KONTEXT, Placement("cpu"), requested="cpu")
    machine["memory"] = 16
    with pytest.raises(
        DeviceError, match=r"about 25\.\d GiB of memory on cuda.*; choose quantization int8"
    ):
        check_machine("kontext", KONTEXT, Placement("cuda"), requested="auto")
    check_machine("kontext", KONTEXT, Placement("cuda", "int8"), requested="auto")


def test_the_values_that_were_not_used_for_the_longest_time_are_dropped():
    cache = ByteLimitedCache(600)
    first, _ = (cache.get_or_create(name, lambda: np.zeros(300, np.uint8)) for name in "ab")
    assert cache.get("a") is first
    third = cache.get_or_create("c", lambda: np.zeros(300, np.uint8))
    assert (cache.get("b"), cache.get("a") is first, cache.get("c") is third) == (None, True, True)
    large = cache.get_or_create("large", lambda: np.zeros(30_000, np.uint8))
    assert (cache.get("c"), cache.get("large") is large) == (None, True)
