"""Loads the AlexNet of LPIPS, which is downloaded once. The small file of channel weights is part
of brewster.

The network is that of torchvision (BSD-3-Clause): the layers `features.0`, 3, 6, 8 and 10 of
alexnet-owt-7be5be79.pth, stored as a state dict of ten tensors in the folder `weights` of the cache
or of BREWSTER_DATA. The digest of the values is always checked, because other weights define a
different metric.
"""

from __future__ import annotations

import hashlib
import io
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from brewster.base.download import Downloader, RemoteFile
from brewster.base.files import cache_folder, write_atomically
from brewster.errors import DownloadError, ModelError

if TYPE_CHECKING:
    from torch import Tensor

ALEXNET_TENSORS: Final = tuple(
    f"features.{i}.{key}" for i in (0, 3, 6, 8, 10) for key in ("weight", "bias")
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


def load_alexnet(
    remote: RemoteFile = TORCHVISION_ALEXNET, digest: str = ALEXNET_DIGEST
) -> dict[str, Tensor]:
    """Returns AlexNet's ten tensors by name, float32: from the cache, from BREWSTER_DATA, or
    downloaded into the cache. Raises ModelError if the file is damaged, or contains other weights;
    DownloadError if there is no file, and the download fails; OutputError if the cache folder
    cannot be written.
    """
    cached = cache_folder() / "weights" / ALEXNET_FILE
    data = os.environ.get("BREWSTER_DATA")
    for path in (cached, *([Path(data) / "weights" / ALEXNET_FILE] if data else [])):
        if path.is_file():
            return read_alexnet(path, digest)
    return _fetch(remote, digest, cached)


def read_alexnet(path: Path, digest: str = ALEXNET_DIGEST) -> dict[str, Tensor]:
    """Reads the ten tensors of a state dict and checks their digest. Other tensors in the file are
    ignored. Raises ModelError if the file is damaged, or contains other weights.
    """
    import torch  # noqa: PLC0415 - an extra

    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        tensors = {name: state[name].detach().float().contiguous() for name in ALEXNET_TENSORS}
    except Exception as error:  # a damaged file can raise almost any exception
        raise _not_alexnet(path, f"it cannot be read: {type(error).__name__}") from error
    if (actual := alexnet_digest(tensors)) != digest:
        raise _not_alexnet(path, f"its digest is {actual:.12}...")
    return tensors


def read_lpips_channel_weights() -> list[NDArray[np.float32]]:
    """Returns the published channel weights of LPIPS for five layers: (64,), (192,), (384,),
    (256,), (256,), all >= 0.
    """
    with np.load(Path(__file__).with_name("lpips_alex_v0.1.npz")) as file:
        return [file[f"layer{i}"] for i in range(5)]


def alexnet_digest(tensors: dict[str, Tensor]) -> str:
    """Returns the SHA-256 of name, shape and little-endian float32 values of each of
    `ALEXNET_TENSORS`.
    """
    digest = hashlib.sha256()
    for name in ALEXNET_TENSORS:
        values: NDArray[Any] = tensors[name].numpy().astype("<f4", order="C")
        digest.update(f"{name} {values.shape}\n".encode() + values.tobytes())
    return digest.hexdigest()


def _fetch(remote: RemoteFile, digest: str, cached: Path) -> dict[str, Tensor]:
    """Downloads the whole network, stores ten of its tensors (4 % of the file), and deletes the
    download.
    """
    import torch  # noqa: PLC0415 - an extra

    size = f"{remote.size / 2**20:.0f} MiB"
    sys.stderr.write(
        f"downloading {size}, AlexNet's weights for LPIPS, to {cached.parent}; licence: "
        f"BSD-3-Clause; to avoid the download, put {ALEXNET_FILE} into the folder weights of "
        "BREWSTER_DATA, or leave LPIPS out with --metrics\n"
    )
    sys.stderr.flush()
    download = cached.with_name(remote.url.rsplit("/", 1)[-1])
    try:
        Downloader().fetch(remote, download)
    except DownloadError as error:
        raise DownloadError(
            f"AlexNet's weights for LPIPS ({size}) could not be downloaded: {error.happened}",
            f"expected a network connection, or {ALEXNET_FILE} in the folder weights of "
            "BREWSTER_DATA",
            "connect and try again, or leave LPIPS out with --metrics",
        ) from error
    try:
        tensors = read_alexnet(download, digest)
        buffer = io.BytesIO()
        torch.save(tensors, buffer)
        write_atomically(cached, buffer.getvalue(), overwrite=True)
    finally:
        download.unlink(missing_ok=True)
    return tensors


def _not_alexnet(path: Path, reason: str) -> ModelError:
    return ModelError(
        f"{path} does not contain the AlexNet weights of LPIPS ({reason})",
        "expected the convolutions of torchvision's alexnet-owt-7be5be79.pth",
        "delete the file, so that brewster downloads it again (233 MiB), or replace it with the "
        "correct one",
    )
