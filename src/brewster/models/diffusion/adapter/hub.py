"""Checks a LoRA's folder and uploads it to the Hugging Face hub in one commit.

    plan = plan_push(Path("out/kontext/lora"), "my-name/my-lora")
    print(plan.table())                     # nothing has been sent yet
    commit_url = push(plan)

Exactly four files are sent. Local paths in the recipe and in the LoRA's metadata are replaced in the uploaded copies.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final, final

from brewster.errors import DownloadError, ModelError
from brewster.models.diffusion.adapter.lora import LORA_FILE, LoraMetadata, read_lora_metadata, read_prompt
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
class UploadFile:
    """A file of the upload: its name in the repository and its bytes."""

    name: str
    data: bytes = field(repr=False)

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes, in hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()


@final
@dataclass(frozen=True)
class UploadPlan:
    """A checked upload: repository, files, commit message, visibility, and remarks for the user."""

    repo_id: str
    files: tuple[UploadFile, ...]
    message: str
    is_private: bool
    remarks: tuple[str, ...]

    def table(self) -> str:
        """The plan as text: one line per file (name, bytes, SHA-256), then the total."""
        lines = [f"{file.name:36}{len(file.data):>13,}  {file.sha256[:12]}" for file in self.files]
        total = sum(len(file.data) for file in self.files)
        visibility = "private" if self.is_private else "public"
        return "\n".join([*lines, f"{total / 1e6:.1f} MB to {self.repo_id} ({visibility}): {self.message}"])

    def to_dict(self) -> dict[str, Any]:
        """The plan as JSON values, without the contents of the files."""
        files = [{"name": file.name, "bytes": len(file.data), "sha256": file.sha256} for file in self.files]
        return {
            "repo": self.repo_id, "private": self.is_private, "message": self.message,
            "files": files, "remarks": list(self.remarks),
        }  # fmt: skip


def plan_push(folder: Path, repo_id: str, *, message: str = "", public: bool = False) -> UploadPlan:
    """Checks a LoRA's folder and prepares its upload; needs no network connection.

    Raises:
        ModelError: a file is missing or damaged, the prompt does not belong to the LoRA, the model card has no front
            matter, a file or the message contains the path of a home folder, or `repo_id` is not OWNER/NAME.
        MissingExtra: huggingface_hub is not installed.
    """
    _check_repo_id(repo_id)
    data = {name: _read_bytes(folder / name) for name in FILES}
    metadata, recipe = read_lora_metadata(folder), _parse_recipe(folder, data[RECIPE_FILE])
    read_prompt(folder, metadata)
    _check_front_matter(folder, data[CARD_FILE], is_tiny=_is_tiny(metadata))
    replacements = {path: PureWindowsPath(path).name for path in _local_paths(recipe)}
    replacements |= _base_replacement(metadata)
    if replacements:
        data[RECIPE_FILE] = f"{json.dumps(_replace_strings(recipe, replacements), indent=2)}\n".encode()
        data[LORA_FILE] = _replace_base(data[LORA_FILE], metadata, replacements)
    for name, content in data.items():
        _refuse_home_folders(str(folder / name), _readable_text(name, content))
    _refuse_home_folders("the commit message", message)
    return UploadPlan(
        repo_id,
        tuple(UploadFile(name, content) for name, content in data.items()),
        message
        or f"LoRA of {replacements.get(metadata.base_model, metadata.base_model)}, rank {metadata.rank}",
        not public,
        tuple(_remarks(folder, metadata, replacements)),
    )


def push(plan: UploadPlan, token: str | None = None) -> str:
    """Creates the repository if it does not exist, and sends the files in one commit.

    The token is `token`, HF_TOKEN, or that of `hf auth login`.

    Returns:
        The URL of the commit.

    Raises:
        DownloadError: there is no token, the token is invalid or may not write, the repository exists with the other
            visibility (public or private), or there is no network connection.
        MissingExtra: huggingface_hub is not installed.
    """
    hub = import_library("huggingface_hub")
    if not (token or hub.get_token()):
        raise DownloadError(
            f"there is no token to write to {plan.repo_id}", "expected a token with write access", LOGIN_HINT
        )
    if not sys.stderr.isatty():
        import_library("huggingface_hub.utils").disable_progress_bars()
    api = hub.HfApi(token=token, library_name="brewster")
    added = [hub.CommitOperationAdd(file.name, file.data) for file in plan.files]
    with _translate_push_errors(plan.repo_id):
        api.create_repo(plan.repo_id, private=plan.is_private, exist_ok=True)
        is_private = bool(api.model_info(plan.repo_id).private)
        if plan.is_private != is_private:
            raise DownloadError(
                f"{plan.repo_id} exists already and is {'private' if is_private else 'public'}",
                f"expected a {'private' if plan.is_private else 'public'} repository",
                f"{'leave out' if is_private else 'pass'} --public, or choose another name, or change its settings",
            )
        commit = api.create_commit(plan.repo_id, added, commit_message=plan.message)
    return str(commit.commit_url)


def _check_repo_id(repo_id: str) -> None:
    reason = "" if "/" in repo_id else "it has no owner"
    try:
        import_library("huggingface_hub.utils").validate_repo_id(repo_id)
    except import_library("huggingface_hub.errors").HFValidationError as error:
        reason = str(error).rstrip(".")
    if reason:
        raise ModelError(
            f"{repo_id!r} is not a valid hub id ({reason})",
            "expected OWNER/NAME",
            "pass your user name and a repository name",
        )


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"{path} cannot be read ({error.strerror})",
            f"expected a LoRA's folder, with {', '.join(FILES)}",
            "pass the folder named `lora` in the output folder of brewster train, or train again to write it",
        ) from error


def _parse_recipe(folder: Path, data: bytes) -> Any:  # noqa: ANN401 - JSON
    try:
        return json.loads(data)
    except ValueError as error:
        raise ModelError(
            f"{folder / RECIPE_FILE} is not JSON: {error}",
            "expected the recipe of the LoRA",
            "train again to write it",
        ) from error


def _check_front_matter(folder: Path, card: bytes, *, is_tiny: bool) -> None:
    """Checks the front matter of the model card: the hub reads licence, base and library from it."""
    yaml_errors = (ValueError, TypeError, import_library("yaml").YAMLError)
    required = {"license", "library_name"} | (set() if is_tiny else {"base_model"})
    try:
        text = card.decode()
        fields = (
            import_library("huggingface_hub").ModelCard(text).data.to_dict() if text.startswith("---") else {}
        )
    except yaml_errors as error:
        raise ModelError(
            f"the front matter of {folder / CARD_FILE} is not YAML: {error}",
            "expected YAML that the hub can read",
            _CARD_HINT,
        ) from error
    missing = sorted(required - {name for name, value in fields.items() if value})
    if missing:
        raise ModelError(
            f"the front matter of {folder / CARD_FILE} has no {', '.join(missing)}",
            "expected these fields as YAML between two lines ---",
            _CARD_HINT,
        )


def _local_paths(value: object) -> Iterator[str]:
    """Yields all strings in a JSON value that are paths of this machine."""
    if isinstance(value, str) and _is_local_path(value):
        yield value
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _local_paths(item)


def _is_local_path(text: str) -> bool:
    return PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute() or text.startswith("~")


def _replace_strings(value: Any, replacements: Mapping[str, str]) -> Any:  # noqa: ANN401 - JSON
    """Replaces strings in a JSON value, and returns the new value."""
    if isinstance(value, dict):
        return {name: _replace_strings(item, replacements) for name, item in value.items()}
    if isinstance(value, list):
        return [_replace_strings(item, replacements) for item in value]
    return replacements.get(value, value) if isinstance(value, str) else value


def _base_replacement(metadata: LoraMetadata) -> dict[str, str]:
    """{local folder: hub id} if the base is a local folder; otherwise empty."""
    is_local = metadata.base_model not in BACKBONES and (
        _is_local_path(metadata.base_model) or Path(metadata.base_model).is_dir()
    )
    return {metadata.base_model: find_backbone_class(metadata.backbone).hub_id} if is_local else {}


def _replace_base(data: bytes, metadata: LoraMetadata, replacements: Mapping[str, str]) -> bytes:
    """Replaces the base in the metadata of the LoRA file, and returns the new bytes."""
    new_text = dataclasses.replace(
        metadata, base_model=replacements.get(metadata.base_model, metadata.base_model)
    ).to_json()
    return with_metadata(
        data,
        {
            name: new_text if text == metadata.to_json() else text
            for name, text in read_metadata(data).items()
        },
    )


def _readable_text(name: str, data: bytes) -> str:
    """Returns the text of a file, or the metadata of a .safetensors file."""
    return json.dumps(read_metadata(data)) if name.endswith(".safetensors") else data.decode(errors="replace")


def _refuse_home_folders(source: str, text: str) -> None:
    """Refuses a text with the path of a home folder, because the path can contain the user's name.

    `source` is the path of the file, or "the commit message".
    """
    home = str(Path.home())
    match = _HOME_FOLDERS.search(text)
    if match or (len(home) > 1 and home in text):
        raise ModelError(
            f"{source} contains the path {match[0] if match else home}",
            "expected no path of a home folder, because it is published",
            f"remove it from {source}",
        )


def _is_tiny(metadata: LoraMetadata) -> bool:
    return metadata.base_model.startswith(TINY_PREFIX)


def _remarks(folder: Path, metadata: LoraMetadata, replacements: Mapping[str, str]) -> Iterator[str]:
    licence = find_backbone_class(metadata.backbone).licence
    if _is_tiny(metadata):
        yield f"the base of the LoRA is {metadata.base_model}, a tiny version: the LoRA cannot separate photos"
    elif not licence.allows_commercial_use:
        yield f"the base of the LoRA has the licence {licence.title}, which also applies to the LoRA: not for commercial use"
    yield from (f"{path} is replaced by {name} in the uploaded files" for path, name in replacements.items())
    other_files = sorted(path.name for path in folder.iterdir() if path.name not in FILES)
    if other_files:
        yield f"not sent: {', '.join(other_files)}"


@contextlib.contextmanager
def _translate_push_errors(repo_id: str) -> Iterator[None]:
    """Converts the exceptions of huggingface_hub to DownloadError."""
    try:
        with translate_hub_errors(repo_id, "write"):
            yield
    except json.JSONDecodeError as error:
        raise DownloadError(
            f"the server's response is not JSON ({error})",
            "expected a Hugging Face hub",
            "check HF_ENDPOINT and your proxy settings",
        ) from error
    except ValueError as error:  # huggingface_hub raises it if the hub rejects the front matter
        raise DownloadError(
            f"the hub refused {CARD_FILE}: {error}", "expected valid front matter", _CARD_HINT
        ) from error
