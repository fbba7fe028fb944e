"""Third-party libraries are imported at their first use and without output, and their errors are converted."""

import sys
from pathlib import Path

import huggingface_hub
import pytest
from huggingface_hub import errors as hub_errors

from brewster.errors import DownloadError
from brewster.models.diffusion.backbones.loading import load_backbone
from other_processes import finished


def hub_error(error_class, status):
    """An error as huggingface_hub raises it for this status."""
    httpx = sys.modules[hub_errors.Response.__module__.split(".")[0]]
    request = httpx.Request("GET", "https://huggingface.co/api/models/owner/name")
    return error_class(f"{status} Client Error.", response=httpx.Response(status, request=request))


@pytest.mark.parametrize("error", [
    hub_error(hub_errors.GatedRepoError, 403), hub_error(hub_errors.HfHubHTTPError, 503),
    OSError(28, "No space left on device"), hub_errors.LocalEntryNotFoundError("no network"),
    hub_errors.OfflineModeIsEnabled("HF_HUB_OFFLINE"),
])  # fmt: skip
def test_an_error_of_the_hub_is_an_error_of_the_download_that_names_the_model(monkeypatch, error):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", refuse)
    with pytest.raises(DownloadError, match=r"black-forest-labs/FLUX\.1-Kontext-dev"):
        load_backbone("kontext")


def test_libraries_are_imported_when_a_model_is_built_and_print_nothing(tmp_path):
    code = f"""
import sys
from pathlib import Path
from brewster.models.diffusion import pipeline
from brewster.models.diffusion.adapter import lora
from brewster.models.diffusion.backbones.loading import load_backbone
from brewster.models.diffusion.backbones.registry import tiny
assert not {{'diffusers', 'transformers', 'peft', 'safetensors', 'huggingface_hub'}} & set(sys.modules)
sys.path.insert(0, {str(Path(__file__).parent)!r})
from published_models import save_backbone
save_backbone(tiny('kontext')[0], Path({str(tmp_path)!r}))
load_backbone({str(tmp_path)!r})
"""
    done = finished([sys.executable, "-c", code])
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def run_without_torch(*arguments):
    """Runs the command line in a process in which torch cannot be imported."""
    code = (
        "import sys; sys.modules['torch'] = None; from brewster.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    return finished([sys.executable, "-c", code, *arguments])


@pytest.mark.parametrize(("command", "name", "line"), [
    ("train", "compact", 'network = "lite2-unet"'), ("train", "lora", 'panels = ["I", "T", "R"]'),
    ("render", "window", "samples_per_pixel ="),
])  # fmt: skip
def test_a_recipe_is_printed_without_torch(command, name, line):
    done = run_without_torch(command, "--show-recipe", name)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"\n{line}" in done.stdout
