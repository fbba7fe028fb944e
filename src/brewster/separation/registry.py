"""The table of models, which brewster and packages of others fill.

    class Halves(Model):
        name = "halves"
        licence = "MIT"

        def load(self, device, **options):
            return Separator(lambda tile: (tile / 2, tile / 2), name=self.name)

    def register(add):  # an entry point of the group `brewster.models`
        add(Halves())

It imports no model: each registered object says what must be known before its model is loaded.
"""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from brewster.errors import BrewsterError, ModelError

if TYPE_CHECKING:
    from brewster.options import Device
    from brewster.separation.separator import Separator

GROUP: Final = "brewster.models"
"""The group of entry points. Each is a function that is called with `add`, see `Add`."""
_OWN: Final = ("brewster.separation.models.zoo", "brewster.diffusion.models")
"""The modules of brewster that register models, with their functions `register(add)` and
`find(source)`, which returns the model of a file, folder or hub id, or None. They are no entry
points, so that a source tree without metadata, or with old metadata, has all models.
"""


class Model(ABC):
    """A model that can be chosen, and what must be known before it is loaded.

    A subclass sets `name` and `licence`, and defines `load`. The rest has a default.
    """

    name: str
    """The name by which it is chosen and reported; that of a file is its stem."""
    licence: str
    options: Set[str] = frozenset()
    """The names of `brewster.options.LoadOptions` that `load` takes besides the device."""
    is_exclusive: bool = False
    """Whether there is memory for only one such model. An evaluation frees it before the next."""
    is_remote: bool = False
    """Whether the weights are downloaded at first use. A server offers it only if asked to."""

    package: str | None = None
    """The package that registered it, or None for brewster. It is set when the model is added."""

    @abstractmethod
    def load(self, device: Device, **options: Any) -> Separator:  # noqa: ANN401  (LoadOptions)
        """Loads the model.

        Args:
            device: the device that runs it; "auto" selects the fastest one.
            options: those of `options` that were set.

        Raises:
            BrewsterError: the model is damaged, or a device, a package or memory is missing.
        """

    def check(self) -> None:  # noqa: B027  (most models need no installation)
        """Raises ModelError if the model must be installed first."""

    def fingerprint(self, device: Device) -> str:
        """Returns a SHA-256 of all that the layers depend on besides the photo, for evaluations,
        which store layers. By default, the model is loaded, and its separator must have one.

        Args:
            device: the device for `load`.

        Raises:
            ModelError: there is none.
        """
        digest = self.load(device).sha256
        if digest is None:
            raise ModelError(
                f"the model {self.name} has no SHA-256",
                "expected one, by which stored layers of an evaluation are found again",
                "let its load return Separator(..., sha256=...), or define its fingerprint",
            )
        return digest

    def expected_sha256(self) -> str | None:
        """Returns the SHA-256 that its file must have, or None if it is not known."""
        return None

    def seconds(self) -> float | None:
        """Returns the time for a photo of 12 megapixels, or None if it is not known."""
        return None

    def card(self) -> str:
        """Returns the model card, Markdown. Raises ModelError if there is none."""
        raise ModelError(
            f"{self.name} has no model card",
            "expected a model with a card, such as compact",
            "ask the authors of the model",
        )

    def describe(self) -> dict[str, Any]:
        """Returns what `brewster models list --json` prints: JSON values by name."""
        return {"name": self.name, "licence": self.licence}

    def listing(self, facts: dict[str, Any]) -> tuple[str, list[str]]:
        """Returns what `brewster models list` prints: a size of at most 10 characters, and lines.

        Args:
            facts: what `describe` returned.
        """
        return "", [facts["licence"]]


Add = Callable[[Model], None]
"""Adds a model to the table. Raises ModelError if its name is taken."""


class _Plugins(NamedTuple):
    models: dict[str, Model]
    errors: list[ModelError]


def find(source: str) -> Model:
    """Returns the model of a name, a file, a folder or a hub id. Nothing is loaded.

    Args:
        source: a name of the table, or else what one of brewster's own modules knows.

    Raises:
        ModelError: there is no such model, or it must be installed first.
    """
    model = _own().get(source) or _plugins().models.get(source)
    if model is None:
        modules = (resolve_name(f"{module}:find") for module in _OWN)
        model = next(filter(None, (find_source(source) for find_source in modules)), None)
    if model is None:
        raise _unknown(source)
    with plugin_errors(model.package):
        model.check()
    return model


def registered() -> dict[str, Model]:
    """Returns the table: name -> model, those of brewster first."""
    return _own() | _plugins().models


def installed() -> dict[str, Model]:
    """Returns the models of the table that need no installation and no download."""
    found = {}
    for name, model in registered().items():
        try:
            with plugin_errors(model.package):
                model.check()
        except ModelError:
            continue
        if not model.is_remote:
            found[name] = model
    return found


def broken_packages() -> list[ModelError]:
    """Returns an error for each package whose models could not be registered."""
    return _plugins().errors


@contextmanager
def plugin_errors(package: str | None) -> Iterator[None]:
    """Turns any exception of another package into a ModelError that names it.

    Args:
        package: the package whose code is called, or None for brewster, whose exceptions pass.

    Raises:
        ModelError: the code failed.
    """
    try:
        yield
    except BrewsterError:
        raise
    except Exception as error:
        if package is None:
            raise
        raise ModelError(
            f"the package {package} failed ({type(error).__name__}: {error})",
            f"expected that it registers and loads its models, see its entry point {GROUP}",
            f"update it, or remove it with: pip uninstall {package}",
        ) from error


def _own() -> dict[str, Model]:
    models: dict[str, Model] = {}
    for module in _OWN:
        resolve_name(f"{module}:register")(lambda model: models.update({model.name: model}))
    return models


@cache
def _plugins() -> _Plugins:
    """The models of other packages. Each package registers all of its models or none."""
    from importlib.metadata import entry_points  # noqa: PLC0415  (slow, and not needed by name)

    found = _Plugins({}, [])
    own = _own()
    for point in entry_points(group=GROUP):
        package = point.dist.name if point.dist else point.value
        models: dict[str, Model] = {}

        def add(model: Model, models: dict[str, Model] = models, package: str = package) -> None:
            if not isinstance(model, Model):
                raise TypeError(f"{model!r} is not a brewster.separation.Model")
            if model.name in own or model.name in found.models or model.name in models:
                raise ValueError(f"there is a model {model.name} already")
            object.__setattr__(model, "package", package)  # it may be a frozen dataclass
            models[model.name] = model

        try:
            with plugin_errors(package):
                point.load()(add)
        except ModelError as error:
            found.errors.append(error)
            continue
        found.models.update(models)
    return found


def _unknown(source: str) -> ModelError:
    names = [*registered()]
    close = difflib.get_close_matches(source, names, n=1) if Path(source).name == source else []
    broken = "".join(f" ({error.happened})" for error in broken_packages())
    return ModelError(
        f"there is no model {source!r}{broken}",
        f"expected one of {', '.join(names)}, an .onnx file, or the folder or hub id of a "
        "training run or LoRA",
        f"did you mean {close[0]}?"
        if close
        else "check the path, or print all models with: brewster models list",
    )
