"""The models of a server: those of its command line and those of this machine. Each model is loaded
once, on first use.
"""

import contextlib
from collections.abc import Sequence
from threading import Lock
from typing import final

from pydantic import BaseModel

from brewster.errors import ModelError
from brewster.options import Device
from brewster.separation import Separator, registry


@final
class ModelRow(BaseModel):
    """A model that clients can choose."""

    name: str
    licence: str
    sha256: str | None
    card: str | None
    """The model card in Markdown: training data, scores, limits."""
    seconds: float | None = None
    """The time for a photo of 12 megapixels, for large networks."""


@final
class ModelCache:
    """Models by name, the default first. Clients choose a model by name, never by path.

    The given models, names or paths, come before those that are
    installed. Raises ModelError if a model
    does not exist, or two have the same name.
    """

    def __init__(self, models: Sequence[str] = (), *, device: Device = "auto") -> None:
        self._sources: dict[str, str] = {}
        for source in dict.fromkeys((*models, *registry.installed())):
            name = registry.find(source).name
            if name in self._sources:
                raise ModelError(
                    f"{source} and {self._sources[name]} have the same name {name}",
                    "expected different names, because clients choose models by name",
                    "rename one of the files",
                )
            self._sources[name] = source
        self._device = device
        self._lock = Lock()
        self._loaded: dict[str, Separator] = {}

    @property
    def names(self) -> list[str]:
        """The names of the models, the default first."""
        return list(self._sources)

    def rows(self) -> list[ModelRow]:
        """Returns the name, licence, digest and card of each model."""
        rows = []
        for name, source in self._sources.items():
            model = registry.find(source)
            card = None
            with contextlib.suppress(ModelError):  # that of a user has none
                card = model.card()
            rows.append(
                ModelRow(
                    name=name,
                    licence=model.licence,
                    sha256=model.expected_sha256(),
                    card=card,
                    seconds=model.seconds(),
                )
            )
        return rows

    def separator(self, name: str) -> Separator:
        """Returns the separator of a model. The model is loaded on first use. This method is
        thread-safe. Raises ModelError if the model file is damaged, and DeviceError if the device
        is not available.
        """
        with self._lock:
            if name not in self._loaded:
                self._loaded[name] = Separator.load(self._sources[name], device=self._device)
            return self._loaded[name]
