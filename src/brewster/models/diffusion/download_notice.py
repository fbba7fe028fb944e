"""Says size and licence of a model before its download begins, and checks that it fits on the disk."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any, Final

from brewster.errors import DownloadError
from brewster.models.large_models import licence_of

_MIN_ANNOUNCED_BYTES: Final = 50_000_000
"""Smaller downloads, such as configuration files, are not announced."""
_RESERVE_BYTES: Final = 1_000_000_000
"""Disk space that stays free."""


def announce_download(hub: Any, source: str, patterns: list[str]) -> None:  # noqa: ANN401 - huggingface_hub
    """Prints the size and the licence on stderr if files that match the patterns are not in the cache yet.

    Args:
        hub: the library huggingface_hub.
        source: the hub id of the model.
        patterns: the names of the files.

    Raises:
        DownloadError: the files do not fit on the disk of the cache.
        Exception: those of huggingface_hub, if the hub cannot be asked.
    """
    planned = hub.snapshot_download(source, allow_patterns=patterns, dry_run=True)
    size = sum(file.file_size or 0 for file in planned if file.will_download)
    if size < _MIN_ANNOUNCED_BYTES:
        return
    cache = Path(hub.constants.HF_HUB_CACHE)
    free = free_disk_bytes(cache)
    if free < size + _RESERVE_BYTES:
        raise DownloadError(
            f"{source} has {size / 1e9:.1f} GB to download, and {free / 1e9:.1f} GB are free in {cache}",
            f"expected {(size + _RESERVE_BYTES) / 1e9:.1f} GB of free disk space",
            "free disk space, or set HF_HOME to a folder on a larger disk",
        )
    sys.stderr.write(
        f"downloading {size / 1e9:.1f} GB of {source} to {cache}; licence: {licence_of(source)}\n"
    )
    sys.stderr.flush()


def free_disk_bytes(folder: Path) -> int:
    """The free bytes of the disk that has the folder, or will have it: of its nearest existing parent."""
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free
