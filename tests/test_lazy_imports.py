"""Third-party libraries are imported at their first use and without output, and their errors are converted."""

import subprocess
import sys

import huggingface_hub
import pytest
from huggingface_hub import errors as hub_errors

from brewster.errors import DownloadError, MissingExtra
from brewster.models.diffusion.backbones.loading import encode_prompt, load_backbone
from brewster.models.diffusion.lazy_imports import diffusers_class, import_library


def hub_error(error_class, status, **headers):
    """An error as huggingface_hub raises it for this status."""
    httpx = sys.modules[hub_errors.Response.__module__.split(".")[0]]
    request = httpx.Request("GET", "https://huggingface.co/api/models/owner/name")
    return error_class(
        f"{status} Client Error.", response=httpx.Response(status, request=request, headers=headers)
    )


def missing_entry_error(http_error):
    """The error that snapshot_download raises if the request fails and the cache is empty."""
    error = hub_errors.LocalEntryNotFoundError("Got: HfHubHTTPError")
    error.__cause__ = http_error
    return error


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (hub_error(hub_errors.GatedRepoError, 401), "is gated and no valid token was sent.*agree to the"),
        (
            hub_error(hub_errors.GatedRepoError, 403),
            "is gated and your account has no access.*open that page",
        ),
        (hub_error(hub_errors.RepositoryNotFoundError, 401), "the hub has no model .*hf auth login"),
        (hub_error(hub_errors.HfHubHTTPError, 401), "refused the token.*settings/tokens"),
        (hub_error(hub_errors.HfHubHTTPError, 503), "returned HTTP 503.*try again later"),
        (
            missing_entry_error(hub_error(hub_errors.HfHubHTTPError, 503)),
            "returned HTTP 503.*try again later",
        ),
        (OSError(28, "No space left on device"), "No space left on device.*HF_HOME"),
        (hub_errors.LocalEntryNotFoundError("no network"), "not in the cache and the hub cannot be reached"),
        (hub_errors.OfflineModeIsEnabled("HF_HUB_OFFLINE"), "the hub cannot be reached.*pass its folder"),
    ],
)
@pytest.mark.parametrize("load", [load_backbone, encode_prompt])
def test_errors_of_the_hub_are_explained(monkeypatch, error, message, load):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", refuse)
    with pytest.raises(DownloadError, match=message) as raised:
        load("kontext")
    assert "black-forest-labs/FLUX.1-Kontext-dev" in str(raised.value)


def test_a_missing_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "peft", None)
    with pytest.raises(MissingExtra, match=r"pip install -c constraints.txt -e '\.\[diffusion\]'"):
        import_library("peft")


def test_a_class_that_diffusers_does_not_have_or_cannot_import_is_an_error(monkeypatch):
    with pytest.raises(MissingExtra, match=r"NoSuchPipeline cannot .*no attribute NoSuchPipeline"):
        diffusers_class("NoSuchPipeline")
    module = "diffusers.pipelines.ddim.pipeline_ddim"
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=f"DDIMPipeline cannot be imported .*import of {module} halted"):
        diffusers_class("DDIMPipeline")


def test_libraries_are_imported_when_a_model_is_built_and_print_nothing(tmp_path):
    code = f"""
import sys
from pathlib import Path
from brewster.models.diffusion import sampling
from brewster.models.diffusion.adapter import lora
from brewster.models.diffusion.backbones.loading import load_backbone
from brewster.models.diffusion.backbones.registry import tiny
assert not {{'diffusers', 'transformers', 'peft', 'safetensors', 'huggingface_hub'}} & set(sys.modules)
tiny('kontext')[0].save(Path({str(tmp_path)!r}))
load_backbone({str(tmp_path)!r})
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def run_without_torch(*arguments):
    """Runs the command line in a process in which torch cannot be imported."""
    code = f"import sys; sys.modules['torch'] = None; sys.argv = {['brewster', *arguments]!r}; from brewster.cli import main; sys.exit(main())"
    return subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("command", "name", "line"),
    [
        ("train", "compact", 'network = "lite2-unet"'),
        ("train", "lora", 'panels = ["I", "T", "R"]'),
        ("render", "window", "samples_per_pixel ="),
    ],
)
def test_a_recipe_is_printed_without_torch(command, name, line):
    done = run_without_torch(command, "--show-recipe", name)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"\n{line}" in done.stdout


def test_a_plan_for_a_model_without_diffusion_is_refused_without_torch():
    done = run_without_torch("photo.jpg", "--plan")
    assert done.returncode == 1
    assert "a plan was requested for the model compact; expected a diffusion model" in done.stderr
    assert "pip install" not in done.stderr
