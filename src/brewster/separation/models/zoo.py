"""The models that are ONNX files: the shipped one, installed networks, files of the user and
folders of training runs. It needs no torch, and no ONNX Runtime before a model is loaded.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from os.path import isfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from brewster.base.files import file_digest
from brewster.errors import BrewsterError, ModelError, read_errors
from brewster.options import Device
from brewster.separation import registry
from brewster.separation.models.published_networks import (
    PROTOCOL,
    PUBLISHED_NETWORKS,
    PublishedNetwork,
)
from brewster.separation.registry import Add, Model

if TYPE_CHECKING:
    from brewster.separation.separator import Separator

_WEIGHTS: Final = Path(__file__).parent / "weights"
MODEL_FILE: Final = "model.onnx"
"""The name of the exported model in the folder of a training run."""


@dataclass
class ModelFile(Model):
    """A model file, its expected SHA-256 (None for a user's own file), and its licence."""

    name: str
    path: Path
    sha256: str | None
    licence: str

    @property
    def _reinstall(self) -> str:
        return "reinstall brewster"

    def load(self, device: Device, **_options: Any) -> Separator:  # noqa: ANN401
        """See `Model.load`."""
        from brewster.separation.onnx_backend import OnnxBackend  # noqa: PLC0415  (ONNX Runtime)
        from brewster.separation.separator import Separator  # noqa: PLC0415

        digest = self.verify()
        backend = OnnxBackend(self.path, device)
        return Separator(
            backend,
            name=self.name,
            sha256=digest,
            device=backend.device,
            is_calibrated=self.sha256 is not None,
        )

    def verify(self) -> str:
        """Checks that the file has its expected digest, and returns its SHA-256."""
        cure = f"check its permissions, or {self._reinstall}"
        with read_errors(self.path, ModelError, f"expected the file of model {self.name}", cure):
            digest = file_digest(self.path, "sha256")
        if self.sha256 not in (None, digest):
            happened = f"{self.path} has SHA-256 {digest[:12]}..."
            raise ModelError(happened, f"expected {(self.sha256 or '')[:12]}...", self._reinstall)
        return digest

    def fingerprint(self, device: Device) -> str:  # noqa: ARG002
        """Returns the SHA-256 of the file, see `verify`."""
        return self.verify()

    def expected_sha256(self) -> str | None:
        """See `Model.expected_sha256`."""
        return self.sha256

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

    def verified(self) -> dict[str, Any]:
        """Returns the properties of the file as JSON values. `error` is the problem with it, or
        None.
        """
        row = {
            "name": self.name,
            "path": str(self.path),
            "licence": self.licence,
            "sha256": self.sha256,
        }
        try:
            return row | {"sha256": self.verify(), "bytes": self.path.stat().st_size, "error": None}
        except BrewsterError as error:
            return row | {"bytes": None, "error": str(error)}

    def describe(self) -> dict[str, Any]:
        """See `verified`."""
        return self.verified()

    def listing(self, facts: dict[str, Any]) -> tuple[str, list[str]]:
        """See `Model.listing`."""
        size = f"{facts['bytes'] / 1e6:.1f} MB" if facts["error"] is None else "damaged"
        return size, [self.licence]


@final
@dataclass
class NetworkFile(ModelFile):
    """The file of a published network, which exists once the network is installed."""

    network: PublishedNetwork
    is_exclusive = True

    @classmethod
    def of(cls, network: PublishedNetwork) -> NetworkFile:
        """Returns the file of a row of PUBLISHED_NETWORKS."""
        facts = network.installed() or {}
        path = network.folder / MODEL_FILE
        return cls(network.name, path, facts.get("sha256"), network.licence, network)

    @property
    def _reinstall(self) -> str:
        return f"run: brewster models install {self.name}"

    def check(self) -> None:
        """See `Model.check`."""
        if not self.network.installed():
            raise ModelError(
                f"{self.name} is not installed",
                "expected a published network, which is downloaded and converted once",
                f"run: brewster models install {self.name}",
            )

    def load(self, device: Device, **_options: Any) -> Separator:  # noqa: ANN401
        """See `Model.load`."""
        from brewster.separation.onnx_backend import OnnxBackend  # noqa: PLC0415  (ONNX Runtime)
        from brewster.separation.predictor import MultiScalePredictor  # noqa: PLC0415
        from brewster.separation.separator import Separator  # noqa: PLC0415

        digest = self.verify()
        backend = OnnxBackend(self.path, device, is_large=True)
        network = self.network
        predictor = MultiScalePredictor(
            backend, network.scales, flips=network.flips, tile_px=network.tile_px
        )
        return Separator(predictor, name=self.name, sha256=digest, device=backend.device)

    def seconds(self) -> float | None:
        """See `Model.seconds`."""
        return self.network.seconds_per_photo()[0]

    def describe(self) -> dict[str, Any]:
        """Returns the row of the table, and what was measured when it was installed."""
        facts = self.network.installed() or {}
        seconds, measured = self.network.seconds_per_photo()
        return asdict(self.network) | {
            "licence": self.licence,
            "seconds": round(seconds, 1),
            "measured": measured,
            "memory_gib": facts.get("memory_gib") or self.network.memory_gib,
            "is_installed": bool(facts),
        }

    def listing(self, facts: dict[str, Any]) -> tuple[str, list[str]]:
        """See `Model.listing`."""
        seconds = f"{facts['seconds']:.0f} s for a photo of 12 megapixels ({facts['measured']})"
        return f"{facts['model_mb']} MB", [
            self.licence,
            f"{seconds}, {facts['memory_gib']:g} GiB memory",
            f"published: {self.network.psnr} dB, {PROTOCOL}",
            "installed" if facts["is_installed"] else f"brewster models install {self.name}",
        ]


@final
@dataclass
class FilmNetworkFile(ModelFile):
    """The file of a network for films. It has a card and a checksum as others, but is no choice for
    `--model`: it separates no photos.
    """

    def load(self, device: Device, **_options: Any) -> Separator:  # noqa: ANN401, ARG002
        """Raises ModelError."""
        raise self._separates_no_photo()

    def fingerprint(self, device: Device) -> str:  # noqa: ARG002
        """Raises ModelError."""
        raise self._separates_no_photo()

    def _separates_no_photo(self) -> ModelError:
        return ModelError(
            f"{self.name} is a network for films, which separates no photo",
            f"expected a model for photos, such as {', '.join(MODELS)}",
            "leave out --model: the separation of a film uses this network by itself",
        )


_COMPACT_SHA256: Final = "9254d71dbcb592c33060aa8bb223f6e16d184393f1e575b7e5c40eb8b0a04a01"
MODELS: Final = {
    "compact": ModelFile("compact", _WEIGHTS / "compact.onnx", _COMPACT_SHA256, "Apache-2.0")
}
"""The shipped models by name."""
_FILM_LIGHT_SHA256: Final = "9715f33edd5702eb1bd54ad4b82b2d4eb1fbaa21ba4f622811595374d81611bc"
FILM_LIGHT: Final = FilmNetworkFile(
    "film-light", _WEIGHTS / "film-light.onnx", _FILM_LIGHT_SHA256, "Apache-2.0"
)
"""The network that finds smooth light in the wrong layer of a film, see film_light.py."""


def register(add: Add) -> None:
    """Adds the shipped models and the published networks to the table."""
    for model in (*MODELS.values(), *map(NetworkFile.of, PUBLISHED_NETWORKS.values())):
        add(model)


def find(source: str) -> ModelFile | None:
    """Returns the model of an .onnx file, or of the folder of a training run, or the network of
    films; otherwise None.
    """
    if source == FILM_LIGHT.name:
        return FILM_LIGHT
    path = Path(source)
    if path.suffix == ".safetensors" and isfile(path):
        raise ModelError(
            f"{source} is a file of weights",
            "expected an .onnx file, or the folder or hub id of a LoRA",
            f"if brewster wrote it, pass its folder: --model {path.parent}; convert another LoRA "
            f"with: brewster models import {source} FOLDER --base-model BASE --prompt TEXT",
        )
    if isfile(path):
        return ModelFile(path.stem, path, None, "unknown")
    exported = path / MODEL_FILE
    return ModelFile(path.resolve().name, exported, None, "unknown") if isfile(exported) else None


def model_file(source: str) -> ModelFile:
    """Returns the model file of a name, a file or a folder of a training run.

    Args:
        source: a name from `brewster models list`, `film-light`, or a path.

    Raises:
        ModelError: there is no such model, it is not installed, or it has no single file.
    """
    model = registry.find(source)
    if isinstance(model, ModelFile):
        return model
    raise ModelError(
        f"{source} is a model that has no model file",
        f"expected one of {', '.join(MODELS)}, or the path of an .onnx file",
        "see its source with: brewster models list, and the card of a LoRA with: brewster "
        "models card FOLDER",
    )


def installed_files() -> list[ModelFile]:
    """Returns the model files of this machine: the shipped ones and installed networks."""
    models = (*registry.installed().values(), FILM_LIGHT)
    return [model for model in models if isinstance(model, ModelFile)]
