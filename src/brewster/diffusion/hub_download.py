"""Finds models from the Hugging Face Hub in the cache, or downloads them.

Before a download begins, its size and licence are printed, and the free disk space is checked."""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from brewster.base.files import free_disk_bytes
from brewster.diffusion.lazy_imports import import_library
from brewster.diffusion.model_table import licence_of
from brewster.errors import DownloadError, ModelError

_MIN_ANNOUNCED_BYTES: Final = 50_000_000
"""Smaller downloads, such as configuration files, are not announced."""
_RESERVE_BYTES: Final = 1_000_000_000
"""Disk space that stays free."""


def resolve_model_folder(source: str, patterns: list[str]) -> Path:
    """Returns a local folder unchanged, or that of the files of a hub id which match the patterns,
    and downloads them.

    The token is that of `hf auth login` or HF_TOKEN. Raises DownloadError if the account has no
    access, the hub has no such model, there is no connection, or the disk is full; ModelError if
    `source` is neither a folder nor a hub id.
    """
    if Path(source).is_dir():
        return Path(source)
    hub = import_library("huggingface_hub")
    errors = import_library("huggingface_hub.errors")
    # If this request fails, the download reports the reason, or finds the files in the cache.
    with contextlib.suppress(
        errors.HTTPError, errors.HFValidationError, errors.DryRunError, OSError
    ):
        _announce_download(source, patterns)
    with translate_hub_errors(source):
        return Path(hub.snapshot_download(source, allow_patterns=patterns))


def cached_model_folder(source: str, patterns: list[str]) -> Path | None:
    """Returns the local folder of a model, or None if it is not in the cache. Downloads nothing."""
    if Path(source).is_dir():
        return Path(source)
    hub = import_library("huggingface_hub")
    with contextlib.suppress(OSError, ValueError):
        return Path(hub.snapshot_download(source, allow_patterns=patterns, local_files_only=True))
    return None


@contextlib.contextmanager
def translate_hub_errors(source: str) -> Iterator[None]:
    """Converts the exceptions of huggingface_hub to brewster's errors."""
    errors = import_library("huggingface_hub.errors")
    page = f"https://huggingface.co/{source}"
    try:
        yield
    except errors.GatedRepoError as error:
        raise DownloadError(
            f"{source} is gated, and no token of an account with access was sent",
            f"expected that the owner of the token has accepted the licence at {page}",
            "open that page, agree to the licence, then run `hf auth login` or set HF_TOKEN",
        ) from error
    except errors.RepositoryNotFoundError as error:
        raise DownloadError(
            f"the hub has no model {source}, or your token has no access to it",
            "expected a public model, or a private one that your token may read",
            f"check {page}, then run `hf auth login` or set HF_TOKEN",
        ) from error
    except errors.HFValidationError as error:
        happened = f"there is no folder {source}, and {source} is not a hub id"
        raise ModelError(
            happened, "expected a model's folder or OWNER/NAME", "check the path"
        ) from error
    except (errors.LocalEntryNotFoundError, errors.OfflineModeIsEnabled) as error:
        raise DownloadError(
            f"{source} is not in the cache and the hub cannot be reached "
            f"({error.__cause__ or error})",
            "expected a network connection, or a folder with the model's files",
            f"connect, or copy the model from {page} and pass its folder",
        ) from error
    except (errors.HTTPError, OSError) as error:
        raise DownloadError(
            f"{source} could not be downloaded ({type(error).__name__}: {error})",
            "expected a connection, a token with read access, and a writable cache folder "
            "(HF_HOME)",
            "check them, then try again",
        ) from error


def _announce_download(source: str, patterns: list[str]) -> None:
    """Prints the size and the licence on stderr if files that match the patterns are not in the
    cache yet. Raises DownloadError if the files do not fit on the disk, or an exception of
    huggingface_hub if the request fails.
    """
    hub = import_library("huggingface_hub")
    planned = hub.snapshot_download(source, allow_patterns=patterns, dry_run=True)
    size = sum(file.file_size or 0 for file in planned if file.will_download)
    if size < _MIN_ANNOUNCED_BYTES:
        return
    cache = Path(hub.constants.HF_HUB_CACHE)
    free = free_disk_bytes(cache)
    if free < size + _RESERVE_BYTES:
        raise DownloadError(
            f"{source} has {size / 1e9:.1f} GB to download, and {free / 1e9:.1f} GB are free in "
            f"{cache}",
            f"expected {(size + _RESERVE_BYTES) / 1e9:.1f} GB of free disk space",
            "free disk space, or set HF_HOME to a folder on a larger disk",
        )
    sys.stderr.write(
        f"downloading {size / 1e9:.1f} GB of {source} to {cache}; licence: {licence_of(source)}\n"
    )
    sys.stderr.flush()
