"""The notice before a download: size, licence and free disk space."""

import shutil
from types import SimpleNamespace

import huggingface_hub
import pytest

from brewster.errors import DownloadError, ModelError
from brewster.models.diffusion.hub_download import find_weights_file, resolve_model_folder


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """huggingface_hub with a cache in a temporary folder, which has to download two of three files."""
    calls = []
    files = [
        SimpleNamespace(file_size=size, will_download=missing)
        for size, missing in ((40_000_000_000, True), (250_000_000, True), (7_000_000_000, False))
    ]

    def snapshot_download(source, *, allow_patterns, dry_run=False):
        calls.append("dry run" if dry_run else "download")
        return files if dry_run else str(tmp_path)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "not" / "yet"))
    return SimpleNamespace(calls=calls, files=files, free=lambda free: monkeypatch.setattr(
        shutil, "disk_usage", lambda _: SimpleNamespace(free=free)
    ))  # fmt: skip


def test_size_and_licence_are_printed_before_the_download(hub, capsys):
    hub.free(50_000_000_000)
    resolve_model_folder("Qwen/Qwen-Image-Edit-2509", ["*"])
    assert hub.calls == ["dry run", "download"]
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "downloading 40.2 GB of Qwen/Qwen-Image-Edit-2509" in printed.err
    assert "licence: Apache-2.0" in printed.err


def test_a_download_that_does_not_fit_on_the_disk_is_refused(hub):
    hub.free(41_000_000_000)
    with pytest.raises(DownloadError, match=r"has 40\.2 GB to download, and 41\.0 GB are free in .*HF_HOME"):
        resolve_model_folder("Qwen/Qwen-Image-Edit-2509", ["*"])
    assert hub.calls == ["dry run"]


def test_the_hub_that_cannot_be_asked_does_not_prevent_the_use_of_the_cache(monkeypatch, tmp_path):
    def snapshot_download(source, *, allow_patterns, dry_run=False):
        if dry_run:
            raise huggingface_hub.errors.DryRunError("no network")
        return str(tmp_path)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    assert resolve_model_folder("someone/model", ["*"]) == tmp_path


def test_a_connection_that_fails_during_the_download_is_an_error(monkeypatch):
    def snapshot_download(source, *, allow_patterns, dry_run=False):
        raise huggingface_hub.errors.HTTPError("the server closed the connection")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    with pytest.raises(DownloadError, match=r"because the connection failed .*the server closed the connec"):
        resolve_model_folder("someone/model", ["*"])


def test_a_file_that_does_not_exist_is_refused(tmp_path, monkeypatch):
    for path in ("missing.gguf", tmp_path / "missing.gguf", tmp_path / "no" / "folder" / "missing.gguf"):
        with pytest.raises(ModelError, match=r"there is no file .*missing\.gguf; expected one \.gguf file"):
            find_weights_file(str(path), (".gguf",))

    def snapshot_download(source, *, allow_patterns, dry_run=False):
        return [] if dry_run else str(tmp_path)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    with pytest.raises(ModelError, match=r"someone/model contains no file missing\.gguf"):
        find_weights_file("someone/model/missing.gguf", (".gguf",))
    (tmp_path / "missing.gguf").write_bytes(b"")
    assert find_weights_file(str(tmp_path / "missing.gguf"), (".gguf",)).is_file()


def test_a_file_in_a_subfolder_of_a_repository_is_found_with_its_companion(tmp_path, monkeypatch):
    """Published few-step LoRAs are in subfolders, such as that of Qwen-Image-Edit-2509."""
    requests = []

    def snapshot_download(source, *, allow_patterns, dry_run=False):
        requests.append((source, *allow_patterns))
        return [] if dry_run else str(tmp_path)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    (tmp_path / "steps" / "4").mkdir(parents=True)
    (tmp_path / "steps" / "4" / "lora.safetensors").touch()
    found = find_weights_file(
        "someone/fast/steps/4/lora.safetensors", (".safetensors",), ["adapter_config.json"]
    )
    assert found == tmp_path / "steps" / "4" / "lora.safetensors"
    assert set(requests) == {("someone/fast", "steps/4/lora.safetensors", "steps/4/adapter_config.json")}
