"""The models that come with brewster: name -> file, sha256, licence, defaults. Imports no torch."""

from __future__ import annotations

import difflib
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from brewster.errors import ModelError

_WEIGHTS: Final = Path(__file__).parent / "weights"


@final
@dataclass(frozen=True)
class ModelFile:
    """A model file, the digest that its bytes must have (None for a user's own file), and its licence."""

    name: str
    path: Path
    sha256: str | None
    licence: str

    def digest(self) -> str:
        """The SHA-256 of the file's bytes, as they are now."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def verify(self) -> str:
        """The digest, checked.

        Raises:
            ModelError: missing, or not the bytes that were shipped.
        """
        if not self.path.is_file():
            raise ModelError(
                f"{self.path} is missing", f"the file of model {self.name}", "reinstall brewster"
            )
        digest = self.digest()
        if self.sha256 not in (None, digest):
            raise ModelError(
                f"{self.path} has SHA-256 {digest[:12]}...",
                f"{self.sha256[:12]}..." if self.sha256 else "",
                "reinstall brewster",
            )
        return digest

    def card(self) -> str:
        """The model card, Markdown.

        Raises:
            ModelError: a user's own file without a card beside it.
        """
        path = self.path.with_suffix(".md")
        if not path.is_file():
            raise ModelError(f"{self.name} has no card", f"a file {path}", "write one beside the model")
        return path.read_text()


MODELS: Final = {
    model.name: model
    for model in (
        ModelFile(
            "compact",
            _WEIGHTS / "compact.onnx",
            "7f297bafce586d1c37b8c69c77602629ddcc3e485a3eaf9fc85afc2d3b57d9d1",
            "Apache-2.0",
        ),
    )
}


LARGE: Final = {
    "kontext": "brewster.models.diffusion.families.kontext:Kontext",
    "klein": "brewster.models.diffusion.families.klein:Klein",
    "qwen": "brewster.models.diffusion.families.qwen:Qwen",
}
"""Large image models: name -> its `Backbone`, as text because importing it imports torch; needs the extra `large`."""


TINY: Final = "tiny:"
"""What a backbone's toy twin is called, before the backbone's name."""


def is_large(name: str) -> bool:
    """Whether this names a large image model or a LoRA: by name, folder, toy twin ("tiny:kontext") or hub id."""
    if name in MODELS or Path(name).is_file():
        return False
    return name in LARGE or name.startswith(TINY) or Path(name).is_dir() or _is_hub_id(name)


def model_name(model: str) -> str:
    """What a model is called, by whatever it is named: "compact", a file's stem, a folder's name.

    Raises:
        ModelError: a small model that is not there.
    """
    if is_large(model):
        return Path(model).resolve().name.replace(":", "-")
    return find_model(model).name


def _is_hub_id(name: str) -> bool:
    """OWNER/NAME; where there is a folder OWNER, a file in it was meant, and nobody out there shall be asked for it."""
    is_one = re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", name) is not None
    return is_one and not name.endswith(".onnx") and not Path(name).parent.is_dir()


def find_model(name: str) -> ModelFile:
    """A model by its name in the zoo, or by the path of an .onnx file.

    Raises:
        ModelError: neither.
    """
    if name in MODELS:
        return MODELS[name]
    if is_large(name):
        raise ModelError(
            f"{name} is a large model, which has no file here",
            f"one of {', '.join(MODELS)}, or the path of an .onnx file",
            "brewster models card FOLDER prints the card of a LoRA",
        )
    path = Path(name)
    if path.is_file():
        return ModelFile(path.stem, path, None, "unknown")
    close = difflib.get_close_matches(name, (*MODELS, *LARGE), n=1) if path.name == name else []
    raise ModelError(
        f"there is no model {name!r}",
        f"one of {', '.join((*MODELS, *LARGE))}, an .onnx file, or the folder or hub id of a LoRA",
        f"did you mean {close[0]}?"
        if close
        else "check the path; brewster models list shows those that are here",
    )
