"""The models of a server: those of its command line and those of the zoo. Each model is loaded
once, on first use.
"""

import contextlib
from collections.abc import Sequence
from threading import Lock
from typing import final

from pydantic import BaseModel

from brewster.errors import ModelError
from brewster.options import Device
from brewster.separation import Separator
from brewster.separation.models import zoo


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

    The given models, names or paths, come before those of the zoo. Raises ModelError if a model
    does not exist, or two have the same name.
    """

    def __init__(self, models: Sequence[str] = (), *, device: Device = "auto") -> None:
        self._sources: dict[str, str] = {}
        for source in dict.fromkeys((*models, *zoo.installed_models())):
            name = zoo.model_name(source)
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
            licence = "the licence of its base model"
            sha256 = None
            card = None
            seconds = None
            if not zoo.is_diffusion_model(source):
                model = zoo.find_model(source)
                licence = model.licence
                sha256 = model.sha256
                seconds = model.network.seconds_per_photo()[0] if model.network else None
                with contextlib.suppress(
                    ModelError
                ):  # a model file that is not in the zoo has no card
                    card = model.card()
            rows.append(
                ModelRow(name=name, licence=licence, sha256=sha256, card=card, seconds=seconds)
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
