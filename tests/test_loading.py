"""Tensor files, and downloads from the hub."""

import shutil
from types import SimpleNamespace

import huggingface_hub
import pytest
import torch

from brewster.diffusion.adapter.importer import find_lora_file
from brewster.diffusion.hub_download import resolve_model_folder
from brewster.diffusion.tensors import read_tensors, write_tensors
from brewster.errors import DownloadError, ModelError


def test_tensors_and_metadata_survive_a_round_trip(tmp_path):
    tensors = {
        "b": torch.randn(2, 3).T,
        "a": torch.arange(3, dtype=torch.bfloat16),
        "empty": torch.zeros(0),
    }
    write_tensors(tmp_path / "t", tensors, {"name": "größer", "a": "1"})
    loaded, metadata = read_tensors(tmp_path / "t")
    assert metadata == {"format": "pt", "name": "größer", "a": "1"}
    assert all(torch.equal(loaded[name], tensor) for name, tensor in tensors.items())


@pytest.mark.parametrize("size", [0, 4, 40, -1])
def test_a_truncated_file_is_refused(tmp_path, size):
    write_tensors(tmp_path / "t", {"a": torch.zeros(9)}, {})
    whole = (tmp_path / "t").read_bytes()
    (tmp_path / "t").write_bytes(whole[:size])
    with pytest.raises(ModelError, match="cannot be read"):
        read_tensors(tmp_path / "t")


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """huggingface_hub, whose repositories contain `folder`; `errors` are those of a dry run or a
    download.
    """
    hub = SimpleNamespace(folder=tmp_path / "repository", calls=[], planned=[], errors={})
    hub.folder.mkdir()

    def snapshot_download(source, *, allow_patterns, dry_run=False):
        kind = "dry run" if dry_run else "download"
        hub.calls.append((kind, source, *allow_patterns))
        if kind in hub.errors:
            raise hub.errors[kind]
        return hub.planned if dry_run else str(hub.folder)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "not" / "yet"))
    return hub


def set_download(hub, monkeypatch, *, free):
    """Two of three files must be downloaded, and the disk has `free` bytes."""
    sizes = ((40_000_000_000, True), (250_000_000, True), (7_000_000_000, False))
    hub.planned = [
        SimpleNamespace(file_size=size, will_download=missing) for size, missing in sizes
    ]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))


def test_size_and_licence_are_printed_before_the_download(hub, monkeypatch, capsys):
    set_download(hub, monkeypatch, free=50_000_000_000)
    resolve_model_folder("Qwen/Qwen-Image-Edit-2509", ["*"])
    assert [call[0] for call in hub.calls] == ["dry run", "download"]
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "downloading 40.2 GB of Qwen/Qwen-Image-Edit-2509" in printed.err
    assert "licence: Apache-2.0" in printed.err


def test_a_download_that_does_not_fit_on_the_disk_is_refused(hub, monkeypatch):
    set_download(hub, monkeypatch, free=41_000_000_000)
    with pytest.raises(
        DownloadError, match=r"has 40\.2 GB to download, and 41\.0 GB are free in .*HF_HOME"
    ):
        resolve_model_folder("Qwen/Qwen-Image-Edit-2509", ["*"])
    assert [call[0] for call in hub.calls] == ["dry run"]


def test_a_hub_that_cannot_be_asked_does_not_prevent_the_use_of_the_cache_but_a_download(hub):
    hub.errors["dry run"] = huggingface_hub.errors.DryRunError("no network")
    assert resolve_model_folder("someone/model", ["*"]) == hub.folder
    hub.errors["download"] = huggingface_hub.errors.HTTPError("the server closed the connection")
    with pytest.raises(
        DownloadError, match=r"could not be downloaded .*the server closed the connection"
    ):
        resolve_model_folder("someone/model", ["*"])


def test_the_file_of_a_lora_is_the_only_one_of_its_folder(tmp_path):
    for path in (
        tmp_path / "missing.safetensors",
        tmp_path / "no" / "folder" / "missing.safetensors",
    ):
        with pytest.raises(
            ModelError, match=r"there is no file .*missing\.safetensors; .*hf download OWNER/NAME"
        ):
            find_lora_file(path)
    with pytest.raises(ModelError, match=r"contains no such file; expected one \.safetensors file"):
        find_lora_file(tmp_path)
    (tmp_path / "lora.safetensors").touch()
    assert (
        find_lora_file(tmp_path)
        == find_lora_file(tmp_path / "lora.safetensors")
        == tmp_path / "lora.safetensors"
    )
    (tmp_path / "other.safetensors").touch()
    with pytest.raises(ModelError, match=r"contains lora\.safetensors, other\.safetensors;"):
        find_lora_file(tmp_path)
