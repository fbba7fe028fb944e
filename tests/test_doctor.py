"""`brewster doctor`: the checks of packages and for diffusion models."""

import importlib.util

import click
import huggingface_hub
import pytest

from brewster.cli import doctor
from brewster.errors import MissingExtra


def check_diffusion(monkeypatch, versions):
    monkeypatch.setattr(doctor, "_version", versions.get)
    return {check.name: check for check in doctor._diffusion()}


def test_optional_parts_for_diffusion_models_are_checked_if_diffusers_is_installed(monkeypatch):
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: None)
    assert check_diffusion(monkeypatch, {}) == {}
    missing = check_diffusion(monkeypatch, {"diffusers": "1"})
    assert [check.cure for check in missing.values()] == ["pip install bitsandbytes", "hf auth login"]
    assert not any(check.needed for check in missing.values())


def test_another_build_of_onnx_runtime_is_accepted(monkeypatch):
    monkeypatch.setattr(doctor, "_version", {"onnxruntime-gpu": "1.31"}.get)
    checks = {check.name: check for check in doctor._packages()}
    assert (checks["onnxruntime"].status, checks["onnxruntime"].detail) == ("ok", "1.31 (onnxruntime-gpu)")
    assert checks["numpy"].status == "missing"


def test_a_token_is_found_wherever_the_hub_client_finds_it_and_never_shown(monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    found = check_diffusion(monkeypatch, {"diffusers": "1", "bitsandbytes": "2"})
    assert {check.status for check in found.values()} == {"ok"}
    assert "secret" not in found["hub token"].detail


def test_a_script_is_told_all_missing_extras_and_one_command_that_installs_them(monkeypatch):
    find_spec = importlib.util.find_spec
    missing = {"peft", "mitsuba"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in missing else find_spec(name)
    )
    with pytest.raises(MissingExtra, match=r"mitsuba, peft; .*'\.\[render,web,diffusion\]'"):
        doctor.doctor.main(["--needs", "render,web,diffusion"], standalone_mode=False)
    doctor.doctor.main(["--needs", "evaluate,web"], standalone_mode=False)
    with pytest.raises(click.BadParameter, match="no extra 'trian'"):
        doctor.doctor.main(["--needs", "trian"], standalone_mode=False)
