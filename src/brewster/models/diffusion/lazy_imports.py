"""Imports diffusers, transformers, peft and huggingface_hub at their first use, and converts their errors."""

from __future__ import annotations

import contextlib
import importlib
import logging
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from brewster.errors import DeviceError, DownloadError, MissingExtra, ModelError
from brewster.models.diffusion.download_notice import announce_download

_CPU_MEMORY_ERROR = re.compile(r"out of memory|not enough memory|can't allocate memory", re.IGNORECASE)


def import_library(name: str) -> Any:  # noqa: ANN401 - a module of a library that may be missing
    """Imports a module of a third-party library and returns it.

    Raises:
        MissingExtra: the library is not installed.
    """
    try:
        with suppress_warnings():
            return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtra(
            f"{error.name or name} cannot be imported ({error})",
            "expected a library that the large models need",
            "run: pip install 'brewster[large]'",
        ) from error


def diffusers_class(name: str) -> Any:  # noqa: ANN401 - diffusers has no types that mypy reads
    """A class of diffusers by its name; diffusers imports the module of the class at this first access.

    Raises:
        MissingExtra: diffusers, or a library that this class needs, is not installed.
    """
    diffusers = import_library("diffusers")
    with suppress_warnings():
        return getattr(diffusers, name)


@contextlib.contextmanager
def suppress_warnings() -> Iterator[None]:
    """Disables log messages up to WARNING: on import, diffusers and transformers warn about optional packages."""
    previous_level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(previous_level)


def disable_progress_bars_in_pipes() -> None:
    """Disables the progress bars of third-party libraries unless stderr is a terminal: they also write to pipes."""
    if sys.stderr.isatty():
        return
    import_library("huggingface_hub.utils").disable_progress_bars()
    import_library("diffusers.utils.logging").disable_progress_bar()
    import_library("transformers.utils.logging").disable_progress_bar()


def fetch(source: str, patterns: list[str]) -> Path:
    """Returns the local folder of a model, and downloads its files if necessary.

    If `source` is a folder, it is returned unchanged. Otherwise `source` is a hub id, and the files that match the
    patterns are found in the cache or downloaded. The token is that of `hf auth login` or HF_TOKEN.

    Raises:
        DownloadError: the account has no access (the message says how to get it), the hub has no such model, there is
            no network connection, or the disk is full.
        ModelError: `source` is neither a folder nor a hub id.
        MissingExtra: huggingface_hub is not installed.
    """
    if Path(source).is_dir():
        return Path(source)
    hub, errors = import_library("huggingface_hub"), import_library("huggingface_hub.errors")
    page = f"https://huggingface.co/{source}"
    # If the hub cannot be asked, the download itself reports why, or finds the files in the cache.
    with contextlib.suppress(errors.HfHubHTTPError, errors.HFValidationError, errors.DryRunError, OSError):
        announce_download(hub, source, patterns)
    try:
        return Path(hub.snapshot_download(source, allow_patterns=patterns))
    except errors.GatedRepoError as error:
        raise _gated_error(error, source, page) from error
    except errors.RepositoryNotFoundError as error:
        raise DownloadError(
            f"the hub has no model {source}, or your token has no access to it",
            "expected a public model, or a private one that your token may read",
            f"check {page}, then run `hf auth login` or set HF_TOKEN",
        ) from error
    except errors.HfHubHTTPError as error:
        raise _http_error(error, source) from error
    except errors.HFValidationError as error:
        raise ModelError(
            f"there is no folder {source}, and {source} is not a hub id",
            "expected a model's folder or OWNER/NAME",
            "check the path",
        ) from error
    except (errors.LocalEntryNotFoundError, errors.OfflineModeIsEnabled) as error:
        # If the cache is empty, huggingface_hub reports a missing file and chains the HTTP error as its cause.
        if isinstance(error.__cause__, errors.HfHubHTTPError):
            raise _http_error(error.__cause__, source) from error
        raise DownloadError(
            f"{source} is not in the cache and the hub cannot be reached",
            "expected a network connection, or a folder with the model's files",
            f"connect, or copy the model from {page} and pass its folder",
        ) from error
    except OSError as error:
        raise DownloadError(
            f"{source} could not be downloaded: {error}",
            "expected enough disk space in the cache folder (HF_HOME)",
            "free disk space and try again",
        ) from error


def is_cached(hub_id: str) -> bool:
    """Whether the transformer of a model on the hub is in the cache, so that loading it downloads at most a few files.

    Raises:
        MissingExtra: huggingface_hub is not installed.
    """
    hub = import_library("huggingface_hub")
    with contextlib.suppress(OSError, ValueError):
        folder = Path(hub.snapshot_download(hub_id, allow_patterns=["transformer/*"], local_files_only=True))
        return any(folder.glob("transformer/*.safetensors"))
    return False


def has_token() -> bool:
    """Whether huggingface_hub finds a token: in HF_TOKEN, or in the file that `hf auth login` writes.

    Raises:
        MissingExtra: huggingface_hub is not installed.
    """
    return import_library("huggingface_hub").get_token() is not None


def _gated_error(error: Exception, source: str, page: str) -> DownloadError:
    """The error for a gated model. The hub returns 401 without a token, and 403 if the account has no access."""
    is_authenticated = _status(error) == 403
    return DownloadError(
        f"{source} is gated and {'your account has no access' if is_authenticated else 'no valid token was sent'}",
        f"expected that the owner of the token has accepted the licence at {page}",
        "open that page, agree to the licence, then run `hf auth login` or set HF_TOKEN to a token with read access",
    )


def _http_error(error: Exception, source: str) -> DownloadError:
    status = _status(error)
    if status in {401, 403}:
        return DownloadError(
            f"the hub refused the token for {source} (HTTP {status})",
            "expected a valid token with read access",
            "create one at https://huggingface.co/settings/tokens, then run `hf auth login` or set HF_TOKEN",
        )
    return DownloadError(
        f"the hub returned HTTP {status} for {source}", "expected the model's files", "try again later"
    )


def _status(error: Exception) -> int | None:
    return getattr(getattr(error, "response", None), "status_code", None)


@contextlib.contextmanager
def explain_out_of_memory(hint: str) -> Iterator[None]:
    """Converts out-of-memory errors of any device to a DeviceError; `hint` says what to reduce.

    Raises:
        DeviceError: out of memory.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or _CPU_MEMORY_ERROR.search(str(error)):
            first = str(error).splitlines()[0] if str(error) else "out of memory"
            raise DeviceError(
                f"the device ran out of memory ({first})", "expected enough memory for the model", hint
            ) from error
        raise
