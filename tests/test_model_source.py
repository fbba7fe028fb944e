"""What a value of --model is, and how often its files are requested."""

import huggingface_hub.constants
import pytest

from brewster.errors import DeviceError, ModelError
from brewster.models.diffusion.model_source import find_model_source
from brewster.models.diffusion.pipeline import load_pipeline
from published_models import write_qwen_edit_plus, write_windowseat

BASE = "Qwen/Qwen-Image-Edit-2509"
WINDOWSEAT = "huawei-bayerlab/windowseat-reflection-removal-v1-0"


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A hub with a tiny WindowSeat and its base, an empty cache, and the list of downloads."""
    folders = {
        BASE: write_qwen_edit_plus(tmp_path / "base"),
        WINDOWSEAT: write_windowseat(tmp_path / "windowseat", BASE),
    }
    requests = []

    def snapshot_download(source, *, allow_patterns, dry_run=False, local_files_only=False):
        if dry_run:
            return []
        if local_files_only:
            raise OSError("not in the cache")
        requests.append(source)
        return str(folders[source])

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    return requests


@pytest.mark.parametrize("transformer", [None, "someone/windowseat-gguf/model.gguf"])
def test_the_machine_is_checked_before_any_download(hub, transformer):
    """This machine has no GPU."""
    with pytest.raises(DeviceError, match=f"finds no GPU, and {BASE} has 20.4 billion parameters"):
        load_pipeline("windowseat", transformer=transformer)
    assert hub == []


def test_a_name_is_a_backbone_without_files():
    source = find_model_source("kontext")
    assert (source.base, source.folder, source.task.layout.panels) == ("kontext", None, ("T",))
    assert source.needs_text_encoders
    with pytest.raises(ModelError, match="kontext is a backbone, and the base model klein was given"):
        find_model_source("kontext", "klein")
