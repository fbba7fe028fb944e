"""What leaves this machine: a LoRA's folder as the hub shall hold it, checked first, and sent in one commit.

    plan = plan_push(Path("out/kontext/lora"), "somebody/sees-through-glass")
    print(plan.table())                     # nothing has been sent yet
    address = push(plan)

Four files and nothing else. Where the recipe or the LoRA name places of this machine, what is sent does not.
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
from brewster.models.diffusion.adapter.lora import LORA_FILE, LoraCard, read_card, read_prompt
from brewster.models.diffusion.backbones import BACKBONES, find_family
from brewster.models.diffusion.lazy_imports import import_library
from brewster.models.diffusion.prompt import PROMPT_FILE
from brewster.models.diffusion.tensors import read_metadata, with_metadata
from brewster.models.zoo import TINY

CARD_FILE: Final = "README.md"
RECIPE_FILE: Final = "recipe.json"
FILES: Final = (CARD_FILE, LORA_FILE, PROMPT_FILE, RECIPE_FILE)
"""The layout on the hub. Stock diffusers reads the LoRA by its name, and the hub the card by its own."""

_HOME_FOLDERS: Final = re.compile(r"(?:(?<![\w.])/home/|/Users/|/root/|[A-Za-z]:\\+Users\\+)[^\s\"'`,;)\]]*")
_LOGIN_HINT: Final = (
    "make one at https://huggingface.co/settings/tokens, then `hf auth login` or set HF_TOKEN"
)
_RETRAIN_HINT: Final = "train again to write the card anew, or mend it"


@final
@dataclass(frozen=True)
class UploadFile:
    """A file as it will lie on the hub."""

    name: str
    data: bytes = field(repr=False)

    @property
    def sha256(self) -> str:
        """The digest of its bytes."""
        return hashlib.sha256(self.data).hexdigest()


@final
@dataclass(frozen=True)
class UploadPlan:
    """What would be sent, where to, and what should be known before."""

    repo_id: str
    files: tuple[UploadFile, ...]
    message: str
    is_private: bool
    remarks: tuple[str, ...]

    def table(self) -> str:
        """A line for each file, then the sum."""
        lines = [f"{file.name:36}{len(file.data):>13,}  {file.sha256[:12]}" for file in self.files]
        total = sum(len(file.data) for file in self.files)
        visibility = "private" if self.is_private else "public"
        return "\n".join([*lines, f"{total / 1e6:.1f} MB to {self.repo_id} ({visibility}): {self.message}"])

    def to_dict(self) -> dict[str, Any]:
        """The same in plain values."""
        files = [{"name": file.name, "bytes": len(file.data), "sha256": file.sha256} for file in self.files]
        return {
            "repo": self.repo_id, "private": self.is_private, "message": self.message,
            "files": files, "remarks": list(self.remarks),
        }  # fmt: skip


def plan_push(folder: Path, repo_id: str, *, message: str = "", public: bool = False) -> UploadPlan:
    """Checks a LoRA's folder and says what would be sent; needs no network.

    Raises:
        ModelError: a file is missing or damaged, the prompt is not the LoRA's, the card has no front matter, a
            file names somebody's home folder, or `repo_id` is not OWNER/NAME.
        MissingExtra: huggingface_hub is not installed.
    """
    _check_repo_id(repo_id)
    data = {name: _bytes(folder / name) for name in FILES}
    card, recipe = read_card(folder), _recipe(folder, data[RECIPE_FILE])
    read_prompt(folder, card)
    _check_front_matter(folder, data[CARD_FILE], is_tiny=_is_tiny(card))
    renamed = {path: PureWindowsPath(path).name for path in _local_paths(recipe)} | _public_base(card)
    if renamed:
        data[RECIPE_FILE] = f"{json.dumps(_with_renamed(recipe, renamed), indent=2)}\n".encode()
        data[LORA_FILE] = _with_public_base(data[LORA_FILE], card, renamed)
    for name, sent in [*data.items(), ("the message", message.encode())]:
        _refuse_home_folders(folder / name, sent)
    return UploadPlan(
        repo_id,
        tuple(UploadFile(name, sent) for name, sent in data.items()),
        message or f"LoRA of {renamed.get(card.base, card.base)}, rank {card.rank}",
        not public,
        tuple(_remarks(folder, card, renamed)),
    )


def push(plan: UploadPlan, token: str | None = None) -> str:
    """Makes the repository if there is none and sends the files in one commit; the address of the commit.

    The token is `token`, HF_TOKEN or the one of `hf auth login`.

    Raises:
        DownloadError: no token, a wrong one, one that may not write, a repository that is public already
            while a private one is required, or no network.
        MissingExtra: huggingface_hub is not installed.
    """
    hub = import_library("huggingface_hub")
    if not (token or hub.get_token()):
        raise DownloadError(
            f"there is no token to write to {plan.repo_id} with", "one with write access", _LOGIN_HINT
        )
    if not sys.stderr.isatty():
        import_library("huggingface_hub.utils").disable_progress_bars()
    api = hub.HfApi(token=token, library_name="brewster")
    added = [hub.CommitOperationAdd(file.name, file.data) for file in plan.files]
    with _translate_hub_errors(plan.repo_id):
        api.create_repo(plan.repo_id, private=plan.is_private, exist_ok=True)
        is_private = bool(api.model_info(plan.repo_id).private)
        if plan.is_private != is_private:
            raise DownloadError(
                f"{plan.repo_id} is there already and {'private' if is_private else 'public'}",
                "private without --public, and public with it",
                f"{'leave out' if is_private else 'pass'} --public, choose another name, or change its settings",
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
            f"{repo_id!r} is no name on the hub ({reason})", "OWNER/NAME", "give your user name and a name"
        )


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"{path} cannot be read ({error.strerror})",
            f"a LoRA's folder, with {', '.join(FILES)}",
            "name the folder lora that brewster train wrote; train again to write it anew",
        ) from error


def _recipe(folder: Path, data: bytes) -> Any:  # noqa: ANN401 - JSON
    try:
        return json.loads(data)
    except ValueError as error:
        raise ModelError(
            f"{folder / RECIPE_FILE} is not JSON: {error}",
            "the recipe of the LoRA",
            "train again to write it",
        ) from error


def _check_front_matter(folder: Path, card: bytes, *, is_tiny: bool) -> None:
    """A card without base and licence: the hub would not know what it is, nor what may be done with it."""
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
            "what the hub reads",
            _RETRAIN_HINT,
        ) from error
    missing = sorted(required - {name for name, value in fields.items() if value})
    if missing:
        raise ModelError(
            f"the front matter of {folder / CARD_FILE} says nothing of {', '.join(missing)}",
            "what the hub reads, between two lines ---",
            _RETRAIN_HINT,
        )


def _local_paths(value: object) -> Iterator[str]:
    """The places of a machine among the strings of a recipe."""
    if isinstance(value, str) and _is_local_path(value):
        yield value
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _local_paths(item)


def _is_local_path(text: str) -> bool:
    return PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute() or text.startswith("~")


def _with_renamed(value: Any, renamed: Mapping[str, str]) -> Any:  # noqa: ANN401 - JSON
    """The same values with these strings renamed."""
    if isinstance(value, dict):
        return {name: _with_renamed(item, renamed) for name, item in value.items()}
    if isinstance(value, list):
        return [_with_renamed(item, renamed) for item in value]
    return renamed.get(value, value) if isinstance(value, str) else value


def _public_base(card: LoraCard) -> dict[str, str]:
    """A base in a folder of this machine, and what everybody can load in its place."""
    is_local = card.base not in BACKBONES and (_is_local_path(card.base) or Path(card.base).is_dir())
    return {card.base: find_family(card.backbone).hub_id} if is_local else {}


def _with_public_base(data: bytes, card: LoraCard, renamed: Mapping[str, str]) -> bytes:
    """The LoRA with a card that names its base as `renamed` does."""
    public = dataclasses.replace(card, base=renamed.get(card.base, card.base)).to_json()
    return with_metadata(
        data, {name: public if text == card.to_json() else text for name, text in read_metadata(data).items()}
    )


def _refuse_home_folders(path: Path, data: bytes) -> None:
    """Who says where he lives should know it; tensors are not looked at."""
    text = json.dumps(read_metadata(data)) if path.suffix == ".safetensors" else data.decode(errors="replace")
    home = str(Path.home())
    found = _HOME_FOLDERS.search(text)
    if found or (len(home) > 1 and home in text):
        raise ModelError(
            f"{path} names {found[0] if found else home}",
            "nothing of this machine in what everybody may read",
            "take it out of the file",
        )


def _is_tiny(card: LoraCard) -> bool:
    return card.base.startswith(TINY)


def _remarks(folder: Path, card: LoraCard, renamed: Mapping[str, str]) -> Iterator[str]:
    licence = find_family(card.backbone).licence
    if _is_tiny(card):
        yield f"its base is {card.base}, a toy: nobody can separate photos with it"
    elif not licence.is_commercial:
        yield f"its base is under the {licence.title}: so is the LoRA, and it is not for commercial use"
    yield from (f"{place} is called {name} in what is sent" for place, name in renamed.items())
    others = sorted(path.name for path in folder.iterdir() if path.name not in FILES)
    if others:
        yield f"not sent: {', '.join(others)}"


@contextlib.contextmanager
def _translate_hub_errors(repo_id: str) -> Iterator[None]:
    """Tells what the hub refuses in our words."""
    errors = import_library("huggingface_hub.errors")
    try:
        yield
    except errors.HfHubHTTPError as error:
        raise _http_error(error.response.status_code, repo_id) from error
    except (errors.HTTPError, errors.OfflineModeIsEnabled) as error:
        raise DownloadError(
            f"the hub cannot be reached ({error})", "a network", "connect and push again: nothing was sent"
        ) from error
    except json.JSONDecodeError as error:
        raise DownloadError(
            f"what answered is no hub ({error})", "JSON", "look at HF_ENDPOINT and at proxies on the way"
        ) from error
    except ValueError as error:  # what the hub has to say of the front matter
        raise DownloadError(
            f"the hub refused {CARD_FILE}: {error}", "front matter that it knows", _RETRAIN_HINT
        ) from error


def _http_error(status: int, repo_id: str) -> DownloadError:
    if status == 401:
        return DownloadError(
            f"the hub refused the token for {repo_id} (HTTP 401)",
            "a valid token with write access",
            _LOGIN_HINT,
        )
    if status == 403:
        owner = repo_id.partition("/")[0]
        return DownloadError(
            f"the token may not write to {repo_id} (HTTP 403)",
            f"a token with write access whose owner is {owner}, or may write for it",
            _LOGIN_HINT,
        )
    return DownloadError(f"the hub answered HTTP {status} for {repo_id}", "a commit", "try again later")
