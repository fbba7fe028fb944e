"""Loads the networks of LPIPS and DISTS, which are downloaded once. The small files of channel weights are part of brewster.

Both are networks of torchvision (BSD-3-Clause). Their files are searched for in the folder `brewster/weights` of the user's
cache folder, then in the folder `weights` of BREWSTER_DATA. Their content is always checked, because other weights define
a different metric:

    LPIPS   AlexNet: the layers `features.0`, 3, 6, 8 and 10 of alexnet-owt-7be5be79.pth, stored as a state dict of ten
            tensors, `lpips_alexnet_features.pth`. The digest of the values is checked.
    DISTS   VGG16: the whole file, vgg16-397923af.pth (528 MiB). Its SHA-256 is checked.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import struct
import sys
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from brewster.download import Downloader, RemoteFile, file_digest
from brewster.errors import DownloadError, ModelError
from brewster.files import cache_folder, write_atomically

if TYPE_CHECKING:
    from torch import Tensor

ALEXNET_TENSORS: Final = tuple(
    f"features.{i}.{kind}" for i in (0, 3, 6, 8, 10) for kind in ("weight", "bias")
)

ALEXNET_FILE: Final = "lpips_alexnet_features.pth"

ALEXNET_DIGEST: Final = "b58cb12516261361a1ed14f3b70c0abad70c1ca4c1c75e1aa576654d3759aa06"
"""The expected result of `alexnet_digest`."""

TORCHVISION_ALEXNET: Final = RemoteFile(
    "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    size=244_408_911,
    algorithm="sha256",
    digest="7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
)

VGG16_FILE: Final = "vgg16-397923af.pth"

TORCHVISION_VGG16: Final = RemoteFile(
    f"https://download.pytorch.org/models/{VGG16_FILE}",
    size=553_433_881,
    algorithm="sha256",
    digest="397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
)

VGG16_TENSORS: Final = tuple(
    f"features.{i}.{kind}"
    for i in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    for kind in ("weight", "bias")
)

_LOAD_ERRORS: Final = (
    pickle.UnpicklingError,
    zipfile.BadZipFile,
    struct.error,
    RuntimeError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    AssertionError,
    EOFError,
    ImportError,
    MemoryError,
    OSError,
)
"""The exceptions of torch.load and of the lookup of tensors if the file is damaged or is not a state dict."""


def load_alexnet(
    remote: RemoteFile = TORCHVISION_ALEXNET,
    digest: str = ALEXNET_DIGEST,
    *,
    downloader: Downloader | None = None,
) -> dict[str, Tensor]:
    """Returns AlexNet's ten tensors by name, float32: from the cache, from BREWSTER_DATA, or downloaded into the cache.

    Raises:
        ModelError: the file is damaged, or contains other weights.
        DownloadError: there is no file, and the download fails.
        OutputError: the cache folder cannot be written.
    """
    path = _find(ALEXNET_FILE)
    if path:
        return read_alexnet(path, digest)
    return _fetch(remote, digest, _cached(ALEXNET_FILE), downloader or Downloader())


def load_vgg16(
    remote: RemoteFile = TORCHVISION_VGG16, *, downloader: Downloader | None = None
) -> list[Tensor]:
    """Returns VGG16's 26 tensors in the order of `VGG16_TENSORS`, float32: from the cache, BREWSTER_DATA, or downloaded.

    Raises:
        ModelError: the file is damaged, or is another file.
        DownloadError: there is no file, and the download fails.
        OutputError: the cache folder cannot be written.
    """
    import torch  # noqa: PLC0415 - an extra

    path = _find(VGG16_FILE)
    if not path:
        path = _cached(VGG16_FILE)  # the download checks the digest
        _download(remote, path, downloader or Downloader(), ("VGG16", "DISTS", VGG16_FILE))
    elif (actual := file_digest(path, remote.algorithm)) != remote.digest:
        raise ModelError(
            f"{path} has the {remote.algorithm} {actual:.12}...",
            f"expected {remote.digest:.12}..., the file {VGG16_FILE} of torchvision",
            "delete the file, so that brewster downloads it again (528 MiB), or replace it with the correct one",
        )
    state = torch.load(path, map_location="cpu", weights_only=True)
    return [state[name].detach().float().contiguous() for name in VGG16_TENSORS]


def _cached(name: str) -> Path:
    return cache_folder() / "weights" / name


def _find(name: str) -> Path | None:
    """Returns the path of the file in the cache, else in BREWSTER_DATA, or None if it is in neither."""
    data = os.environ.get("BREWSTER_DATA")
    paths = [_cached(name), *([Path(data) / "weights" / name] if data else [])]
    return next((path for path in paths if path.is_file()), None)


def read_alexnet(path: Path, digest: str = ALEXNET_DIGEST) -> dict[str, Tensor]:
    """Reads the ten tensors of a state dict and checks their digest. Other tensors in the file are ignored.

    Raises:
        ModelError: the file is damaged, or contains other weights.
    """
    import torch  # noqa: PLC0415 - an extra

    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        tensors = {name: state[name].detach().float().contiguous() for name in ALEXNET_TENSORS}
    except _LOAD_ERRORS as error:
        raise _not_alexnet(path, f"it cannot be read: {type(error).__name__}") from error
    if (actual := alexnet_digest(tensors)) != digest:
        raise _not_alexnet(path, f"its digest is {actual:.12}...")
    return tensors


def read_lpips_channel_weights() -> list[NDArray[np.float32]]:
    """Returns the published channel weights of LPIPS for the five layers: (64,), (192,), (384,), (256,), (256,), all >= 0."""
    with np.load(Path(__file__).with_name("lpips_alex_v0.1.npz")) as file:
        return [file[f"layer{i}"] for i in range(5)]


def alexnet_digest(tensors: dict[str, Tensor]) -> str:
    """Returns the SHA-256 of the name, shape and little-endian float32 values of each tensor, in the order of `ALEXNET_TENSORS`."""
    digest = hashlib.sha256()
    for name in ALEXNET_TENSORS:
        values: NDArray[Any] = tensors[name].numpy().astype("<f4", order="C")
        digest.update(f"{name} {values.shape}\n".encode() + values.tobytes())
    return digest.hexdigest()


def _fetch(remote: RemoteFile, digest: str, cached: Path, downloader: Downloader) -> dict[str, Tensor]:
    """Downloads the whole network, stores ten of its tensors in `cached`, and deletes the download.

    The other tensors, 96 % of the file, are not needed.
    """
    import torch  # noqa: PLC0415 - an extra

    download = cached.with_name(remote.url.rsplit("/", 1)[-1])
    _download(remote, download, downloader, ("AlexNet", "LPIPS", ALEXNET_FILE))
    try:
        tensors = read_alexnet(download, digest)
        buffer = io.BytesIO()
        torch.save(tensors, buffer)
        write_atomically(cached, buffer.getvalue(), overwrite=True)
    finally:
        download.unlink(missing_ok=True)
    return tensors


def _download(remote: RemoteFile, target: Path, downloader: Downloader, names: tuple[str, str, str]) -> None:
    """Downloads the weights of a network. `names` are the network, its metric, and the file that replaces the download.

    Before the download, its size and licence are printed on standard error, and how to avoid it.
    """
    network, metric, file_name = names
    size = f"{remote.size / 2**20:.0f} MiB"
    sys.stderr.write(
        f"downloading {size}, {network}'s weights for {metric}, to {target.parent}; licence: BSD-3-Clause; to avoid the download, "
        f"put {file_name} into the folder weights of BREWSTER_DATA, or leave {metric} out with --metrics\n"
    )
    sys.stderr.flush()
    try:
        downloader.fetch(remote, target)
    except DownloadError as error:
        raise DownloadError(
            f"{network}'s weights for {metric} ({size}) could not be downloaded: {error.happened}",
            f"expected a network connection, or {file_name} in the folder weights of BREWSTER_DATA",
            f"connect and try again, or leave {metric} out with --metrics",
        ) from error


def _not_alexnet(path: Path, reason: str) -> ModelError:
    return ModelError(
        f"{path} does not contain the AlexNet weights of LPIPS ({reason})",
        "expected the convolutions of torchvision's alexnet-owt-7be5be79.pth",
        "delete the file, so that brewster downloads it again (233 MiB), or replace it with the correct one",
    )
