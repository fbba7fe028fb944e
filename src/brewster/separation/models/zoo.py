"""The registry of models: shipped files with SHA-256 and licence, and diffusion models. It needs no
torch.
"""

import difflib
import re
from dataclasses import dataclass
from os.path import isdir, isfile
from pathlib import Path
from typing import Final, final

from brewster.base.download import file_digest
from brewster.errors import ModelError, read_errors
from brewster.options import Quantization
from brewster.separation.models.published_networks import PUBLISHED_NETWORKS, PublishedNetwork

_WEIGHTS: Final = Path(__file__).parent / "weights"


@final
@dataclass(frozen=True)
class ModelFile:
    """A model file, its expected SHA-256 (None for a user's own file), and its licence."""

    name: str
    path: Path
    sha256: str | None
    licence: str
    network: PublishedNetwork | None = None
    """The row of an installed network."""

    def verify(self) -> str:
        """Checks that the file has its expected digest, and returns its SHA-256."""
        cure = f"check its permissions, or {self._reinstall}"
        with read_errors(self.path, ModelError, f"expected the file of model {self.name}", cure):
            digest = file_digest(self.path, "sha256")
        if self.sha256 not in (None, digest):
            happened = f"{self.path} has SHA-256 {digest[:12]}..."
            raise ModelError(happened, f"expected {(self.sha256 or '')[:12]}...", self._reinstall)
        return digest

    @property
    def _reinstall(self) -> str:
        return f"run: brewster models install {self.name}" if self.network else "reinstall brewster"

    def card(self) -> str:
        """The text of the model card, Markdown. It is the file next to the model file with the
        suffix .md.
        """
        path = self.path.with_suffix(".md")
        if not path.is_file():
            raise ModelError(
                f"{self.name} has no model card", f"expected a file {path}", "write this file"
            )
        return path.read_text()


_BASE: Final = "a base for LoRAs; without one, an edit by prompt"
_OPEN: Final = "no account needed"
_GATED: Final = "gated: accept the licence on its page, then run `hf auth login`"


@final
@dataclass(frozen=True)
class DiffusionModel:
    """A row of the table."""

    name: str
    hub_id: str
    licence: str
    allows_commercial_use: bool
    backbone: str
    """The key in `BACKBONE_COSTS`, from which memory and download are computed."""
    output: str
    access: str = _OPEN
    quantization: Quantization | None = None
    """The quantization of the base in the published inference code."""
    has_prompt: bool = False
    """Whether the encoded prompt is part of the model, so that no text encoder is needed."""
    base_model: str | None = None
    """The hub id of the base of a LoRA or finetuned model."""


DIFFUSION_MODELS: Final = {
    model.name: model
    for model in (
        DiffusionModel(
            "windowseat",
            "huawei-bayerlab/windowseat-reflection-removal-v1-0",
            "Apache-2.0",
            allows_commercial_use=True,
            backbone="qwen",
            output="transmission; reflection derived",
            quantization="nf4",
            has_prompt=True,
            base_model="Qwen/Qwen-Image-Edit-2509",
        ),
        DiffusionModel(
            "kontext",
            "black-forest-labs/FLUX.1-Kontext-dev",
            "FLUX.1 [dev] Non-Commercial License",
            allows_commercial_use=False,
            backbone="kontext",
            output=_BASE,
            access=_GATED,
        ),
        DiffusionModel(
            "klein",
            "black-forest-labs/FLUX.2-klein-base-4B",
            "Apache-2.0",
            allows_commercial_use=True,
            backbone="klein",
            output=_BASE,
        ),
        DiffusionModel(
            "qwen",
            "Qwen/Qwen-Image-Edit",
            "Apache-2.0",
            allows_commercial_use=True,
            backbone="qwen",
            output=_BASE,
        ),
    )
}
"""name -> model."""


def licence_of(hub_id: str) -> str:
    """The licence of a repository on the hub, for a message before its download."""
    models = DIFFUSION_MODELS.values()
    owners = [model for model in models if model.hub_id == hub_id] or [
        model for model in models if model.base_model == hub_id
    ]
    return owners[0].licence if owners else "see its page on the hub"


_COMPACT_SHA256: Final = "9254d71dbcb592c33060aa8bb223f6e16d184393f1e575b7e5c40eb8b0a04a01"
MODELS: Final = {
    "compact": ModelFile("compact", _WEIGHTS / "compact.onnx", _COMPACT_SHA256, "Apache-2.0")
}

MODEL_FILE: Final = "model.onnx"
"""The name of the exported model in the folder of a training run."""
TINY_PREFIX: Final = "tiny:"
"""The prefix for the tiny version of a backbone: the same classes with few, random weights, for
tests and demos.
"""


def is_diffusion_model(name: str) -> bool:
    """Whether this is a diffusion model or LoRA: a registered name, "tiny:" and a name, a folder,
    or a hub id.
    """
    if name in MODELS or name in PUBLISHED_NETWORKS or isfile(name) or _run_model(name):
        return False
    if name in DIFFUSION_MODELS or name.startswith(TINY_PREFIX) or isdir(name):
        return True
    # OWNER/NAME is a hub id. If a folder OWNER exists, it is a local path, and the hub is not
    # queried.
    has_form = re.fullmatch(r"[\w-][\w.-]{,95}/[\w-][\w.-]{,95}", name) is not None
    return has_form and not name.endswith(".onnx") and not isdir(Path(name).parent)


def model_name(model: str) -> str:
    """The short name of a model for reports: a registered name, the stem of a file, or the name of
    a folder.
    """
    if is_diffusion_model(model):
        return Path(model).resolve().name.replace(":", "-")
    return find_model(model).name


def _run_model(name: str) -> Path | None:
    """The ONNX file that `brewster train` has exported into this folder, or None."""
    path = Path(name) / MODEL_FILE
    return path if isfile(path) else None


def installed_models() -> dict[str, ModelFile]:
    """The models of this machine by name: the shipped ones, and the published networks that are
    installed.
    """
    networks = {
        name: ModelFile(
            name, network.folder / MODEL_FILE, facts["sha256"], network.licence, network
        )
        for name, network in PUBLISHED_NETWORKS.items()
        if (facts := network.installed())
    }
    return MODELS | networks


def find_model(name: str) -> ModelFile:
    """The model file with this registered name or path. A diffusion model has no single file."""
    if found := installed_models().get(name):
        return found
    if name in PUBLISHED_NETWORKS:
        raise ModelError(
            f"{name} is not installed",
            "expected a published network, which is downloaded and converted once",
            f"run: brewster models install {name}",
        )
    if is_diffusion_model(name):
        raise ModelError(
            f"{name} is a diffusion model, which has no model file",
            f"expected one of {', '.join(MODELS)}, or the path of an .onnx file",
            "see its source with: brewster models list, and the card of a LoRA with: brewster "
            "models card FOLDER",
        )
    path = Path(name)
    if path.suffix == ".safetensors" and isfile(path):
        raise ModelError(
            f"{name} is a file of weights",
            "expected an .onnx file, or the folder or hub id of a LoRA",
            f"if brewster wrote it, pass its folder: --model {path.parent}; convert another LoRA "
            f"with: brewster models import {name} FOLDER --base-model BASE --prompt TEXT",
        )
    if isfile(path):
        return ModelFile(path.stem, path, None, "unknown")
    if exported := _run_model(name):
        return ModelFile(path.resolve().name, exported, None, "unknown")
    names = (*MODELS, *PUBLISHED_NETWORKS, *DIFFUSION_MODELS)
    close = difflib.get_close_matches(name, names, n=1) if path.name == name else []
    raise ModelError(
        f"there is no model {name!r}",
        f"expected one of {', '.join(names)}, an .onnx file, or the folder or hub id of a "
        "training run or LoRA",
        f"did you mean {close[0]}?"
        if close
        else "check the path, or print all models with: brewster models list",
    )
