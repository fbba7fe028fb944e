"""The models of a server: those of its command line and those of the zoo. Each model is loaded once, on first use."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from threading import Lock
from typing import final

from pydantic import BaseModel

from brewster.errors import ModelError
from brewster.inference import Separator
from brewster.models import zoo
from brewster.options import Device


@final
class ModelRow(BaseModel):
    """A model that clients can choose."""

    name: str
    licence: str
    sha256: str | None
    card: str | None
    """The model card in Markdown: training data, scores, limits."""


@final
class ModelCache:
    """Models by name, the default first. Clients choose a model by name, never by path.

    Args:
        models: names or paths of models. They come before the models of the zoo.
        device: the device for all models, as in `Separator.load`.

    Raises:
        ModelError: a model does not exist, or two models have the same name.
    """

    def __init__(self, models: Sequence[str] = (), *, device: Device = "auto") -> None:
        self._sources: dict[str, str] = {}
        for source in dict.fromkeys((*models, *zoo.MODELS)):
            self._add(source)
        self._device, self._lock = device, Lock()
        self._loaded: dict[str, Separator] = {}

    def _add(self, source: str) -> None:
        name = Path(source).name if zoo.is_diffusion_model(source) else zoo.find_model(source).name
        if name in self._sources:
            raise ModelError(
                f"{source} and {self._sources[name]} have the same name {name}",
                "expected different names, because clients choose models by name",
                "rename one of the files",
            )
        self._sources[name] = source

    @property
    def names(self) -> list[str]:
        """The names of the models, the default first."""
        return list(self._sources)

    def rows(self) -> list[ModelRow]:
        """Returns the name, licence, digest and card of each model."""
        return [_model_row(name, source) for name, source in self._sources.items()]

    def separator(self, name: str) -> Separator:
        """Returns the separator of a model. The model is loaded on first use. This method is thread-safe.

        Raises:
            ModelError: the model file is damaged.
            DeviceError: the device is not available.
        """
        with self._lock:
            if name not in self._loaded:
                self._loaded[name] = Separator.load(self._sources[name], device=self._device)
            return self._loaded[name]


def _model_row(name: str, source: str) -> ModelRow:
    if zoo.is_diffusion_model(source):
        return ModelRow(name=name, licence="the licence of its base model", sha256=None, card=None)
    model = zoo.find_model(source)
    try:
        card = model.card()
    except ModelError:  # a model file that is not in the zoo has no card
        card = None
    return ModelRow(name=name, licence=model.licence, sha256=model.sha256, card=card)
