"""Checks a LoRA's folder and uploads it to the Hugging Face hub in one commit.

    plan = plan_push(Path("out/kontext/lora"), "my-name/my-lora")
    print(plan.table())                     # nothing has been sent yet
    commit_url = push(plan)

Exactly four files are sent. Local paths in the recipe and in the LoRA's metadata are replaced in the uploaded copies.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final, final

from brewster.errors import DownloadError, ModelError
from brewster.models.diffusion.adapter.lora import LORA_FILE, read_lora_metadata, read_prompt
from brewster.models.diffusion.backbones.registry import BACKBONES, find_backbone_class
from brewster.models.diffusion.hub_download import LOGIN_HINT, translate_hub_errors
from brewster.models.diffusion.lazy_imports import import_library
from brewster.models.diffusion.prompt import PROMPT_FILE
from brewster.models.diffusion.tensors import read_metadata, with_metadata
from brewster.models.zoo import TINY_PREFIX

CARD_FILE: Final = "README.md"
RECIPE_FILE: Final = "recipe.json"
FILES: Final = (CARD_FILE, LORA_FILE, PROMPT_FILE, RECIPE_FILE)
"""The files to upload. diffusers and the hub find the LoRA and the model card by these names."""

_HOME_FOLDERS: Final = re.compile(r"(?:(?<![\w.])/home/|/Users/|/root/|[A-Za-z]:\\+Users\\+)[^\s\"'`,;)\]]*")
_CARD_HINT: Final = "correct the model card, or train again to write a new one"


@final
@dataclass(frozen=True)
class UploadPlan:
    """A checked upload: repository, files by name, commit message, visibility, and remarks for the user."""

    repo_id: str
    files: Mapping[str, bytes] = field(repr=False)
    message: str
    is_private: bool
    remarks: Sequence[str]

    def table(self) -> str:
        """The plan as text: one line per file (name, bytes, SHA-256), then the total."""
        rows = self.to_dict()["files"]
        lines = [f"{row['name']:36}{row['bytes']:>13,}  {row['sha256'][:12]}" for row in rows]
        total = sum(row["bytes"] for row in rows)
        visibility = "private" if self.is_private else "public"
        return "\n".join([*lines, f"{total / 1e6:.1f} MB to {self.repo_id} ({visibility}): {self.message}"])

    def to_dict(self) -> dict[str, Any]:
        """The plan as JSON values, without the contents of the files."""
        files = [
            {"name": name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in self.files.items()
        ]
        return {
            "repo": self.repo_id, "private": self.is_private, "message": self.message,
            "files": files, "remarks": list(self.remarks),
        }  # fmt: skip


def plan_push(folder: Path, repo_id: str, *, message: str = "", public: bool = False) -> UploadPlan:
    """Checks a LoRA's folder and prepares its upload; needs no network connection."""
    try:
        import_library("huggingface_hub.utils").validate_repo_id(repo_id if "/" in repo_id else f"/{repo_id}")
    except import_library("huggingface_hub.errors").HFValidationError as error:
        happened = f"{repo_id!r} is not a valid hub id ({str(error).rstrip('.')})"
        cure = "pass your user name and a repository name"
        raise ModelError(happened, "expected OWNER/NAME", cure) from error
    data, recipe = _read_files(folder)
    metadata = read_lora_metadata(folder)
    read_prompt(folder, metadata)
    is_tiny, base = metadata.base_model.startswith(TINY_PREFIX), metadata.base_model
    _check_front_matter(folder, data[CARD_FILE], is_tiny=is_tiny)
    backbone_class = find_backbone_class(metadata.backbone)
    replacements: dict[str, str] = {}
    if base not in BACKBONES and (_is_local_path(base) or Path(base).is_dir()):
        replacements[base] = backbone_class.hub_id
    recipe = _replace_paths(recipe, replacements)
    base = replacements.get(base, base)
    if replacements:
        data[RECIPE_FILE] = f"{json.dumps(recipe, indent=2)}\n".encode()
        new_text = dataclasses.replace(metadata, base_model=base).to_json()
        entries = read_metadata(data[LORA_FILE])
        entries = {name: new_text if text == metadata.to_json() else text for name, text in entries.items()}
        data[LORA_FILE] = with_metadata(data[LORA_FILE], entries)
    for name, content in data.items():
        is_weights = name.endswith(".safetensors")
        text = json.dumps(read_metadata(content)) if is_weights else content.decode(errors="replace")
        _refuse_home_folders(str(folder / name), text)
    _refuse_home_folders("the commit message", message)
    remarks = [f"{path} is replaced by {name} in the uploaded files" for path, name in replacements.items()]
    licence = backbone_class.licence
    limits = f"has the licence {licence.title}, which also applies to the LoRA: not for commercial use"
    if is_tiny:
        limits = f"is {base}, a tiny version: the LoRA cannot separate photos"
    if is_tiny or not licence.allows_commercial_use:
        remarks.insert(0, f"the base of the LoRA {limits}")
    if other_files := sorted(path.name for path in folder.iterdir() if path.name not in FILES):
        remarks.append(f"not sent: {', '.join(other_files)}")
    message = message or f"LoRA of {base}, rank {metadata.rank}"
    return UploadPlan(repo_id, data, message, not public, remarks)


def push(plan: UploadPlan, token: str | None = None) -> str:
    """Creates the repository if it does not exist, and sends the files in one commit.

    The token is `token`, HF_TOKEN, or that of `hf auth login`. Returns the URL of the commit.
    """
    hub = import_library("huggingface_hub")
    if not (token or hub.get_token()):
        raise DownloadError(
            f"there is no token to write to {plan.repo_id}", "expected a token with write access", LOGIN_HINT
        )
    if not sys.stderr.isatty():
        import_library("huggingface_hub.utils").disable_progress_bars()
    api = hub.HfApi(token=token, library_name="brewster")
    added = [hub.CommitOperationAdd(name, data) for name, data in plan.files.items()]
    try:
        with translate_hub_errors(plan.repo_id, "write"):
            api.create_repo(plan.repo_id, private=plan.is_private, exist_ok=True)
            is_private = bool(api.model_info(plan.repo_id).private)
            if plan.is_private != is_private:
                raise DownloadError(
                    f"{plan.repo_id} exists already and is {'private' if is_private else 'public'}",
                    f"expected a {'private' if plan.is_private else 'public'} repository",
                    f"{'leave out' if is_private else 'pass'} --public, or choose another name, or change its settings",
                )
            commit = api.create_commit(plan.repo_id, added, commit_message=plan.message)
    except json.JSONDecodeError as error:
        happened = f"the server's response is not JSON ({error})"
        cure = "check HF_ENDPOINT and your proxy settings"
        raise DownloadError(happened, "expected a Hugging Face hub", cure) from error
    except ValueError as error:  # huggingface_hub raises it if the hub rejects the front matter
        happened = f"the hub refused {CARD_FILE}: {error}"
        raise DownloadError(happened, "expected valid front matter", _CARD_HINT) from error
    return str(commit.commit_url)


def _read_files(folder: Path) -> tuple[dict[str, bytes], Any]:
    """The content of each file by name, and the recipe."""
    try:
        data = {name: (folder / name).read_bytes() for name in FILES}
        return data, json.loads(data[RECIPE_FILE])
    except OSError as error:
        raise ModelError(
            f"{error.filename} cannot be read ({error.strerror})",
            f"expected a LoRA's folder, with {', '.join(FILES)}",
            "pass the folder named `lora` in the output folder of brewster train, or train again to write it",
        ) from error
    except ValueError as error:
        happened = f"{folder / RECIPE_FILE} is not JSON: {error}"
        raise ModelError(happened, "expected the recipe of the LoRA", "train again to write it") from error


def _check_front_matter(folder: Path, card: bytes, *, is_tiny: bool) -> None:
    """Checks the front matter of the model card: the hub reads licence, base and library from it."""
    required = {"license", "library_name"} | (set() if is_tiny else {"base_model"})
    fields, problem = {}, ""
    try:
        if (text := card.decode()).startswith("---"):
            fields = import_library("huggingface_hub").ModelCard(text).data.to_dict()
    except (ValueError, TypeError, import_library("yaml").YAMLError) as error:
        problem = f"is not YAML: {error}"
    if missing := sorted(required - {name for name, value in fields.items() if value}):
        raise ModelError(
            f"the front matter of {folder / CARD_FILE} {problem or 'has no ' + ', '.join(missing)}",
            f"expected {', '.join(sorted(required))} as YAML between two lines ---",
            _CARD_HINT,
        )


def _is_local_path(text: str) -> bool:
    return PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute() or text.startswith("~")


def _replace_paths(value: Any, replacements: dict[str, str]) -> Any:  # noqa: ANN401 - JSON
    """Replaces the paths of this machine in a JSON value by their last part, and adds them to `replacements`."""
    if isinstance(value, dict):
        return {name: _replace_paths(item, replacements) for name, item in value.items()}
    if isinstance(value, list):
        return [_replace_paths(item, replacements) for item in value]
    if isinstance(value, str) and _is_local_path(value):
        replacements.setdefault(value, PureWindowsPath(value).name)
    return replacements.get(value, value) if isinstance(value, str) else value


def _refuse_home_folders(source: str, text: str) -> None:
    """Refuses a text with the path of a home folder, because the path can contain the user's name. `source` is the path
    of the file, or "the commit message"."""
    home = str(Path.home())
    match = _HOME_FOLDERS.search(text)
    if match or (len(home) > 1 and home in text):
        raise ModelError(
            f"{source} contains the path {match[0] if match else home}",
            "expected no path of a home folder, because it is published",
            f"remove it from {source}",
        )
