"""Checks the array shapes that annotations state, in every module that states some, while the tests run.

brewster imports jaxtyping for type checkers only (`if TYPE_CHECKING`), so that users pay nothing. Here those imports are
made, and jaxtyping's own loader has beartype check each call of the modules' functions. Only arrays are checked: what is
wrong with other values, functions say themselves, and tests try that.
"""

import sys
import typing
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader

from beartype import beartype
from jaxtyping import AbstractArray, _import_hook

_CHECKED = tuple(
    f"brewster.{package}."
    for package in ("evaluate", "inference", "models", "render", "rendered", "training")
)
"""Metrics and studies are left out: they refuse arrays of other shapes themselves, which their tests try."""

_STATES_SHAPES = b"from jaxtyping import"


def check_arrays(function):
    """The function, with those of its arguments and results checked that are arrays of a stated shape."""
    hints = typing.get_type_hints(function, include_extras=True)
    function.__annotations__ = {name: hint for name, hint in hints.items() if _states_a_shape(hint)}
    return beartype(function)


def _states_a_shape(hint):
    is_array = isinstance(hint, type) and issubclass(hint, AbstractArray)
    return is_array or any(map(_states_a_shape, typing.get_args(hint)))


class _Loader(_import_hook._JaxtypingLoader):
    def get_data(self, path):
        data = super().get_data(path)
        return data.replace(b"\nif TYPE_CHECKING:", b"\nif True:") if path == self.path else data

    def set_data(self, path, data, **_):
        """Keeps no bytecode: it is not that of the file."""


class _Finder(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if not name.startswith(_CHECKED):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec and isinstance(spec.loader, SourceFileLoader) and states_shapes(spec.loader):
            checker = _import_hook.Typechecker("shape_checks.check_arrays")
            spec.loader = _Loader(spec.loader.name, spec.loader.path, typechecker=checker)
            return spec
        return None


def states_shapes(loader):
    return _STATES_SHAPES in loader.get_data(loader.path)


def check_shapes():
    """Call it before brewster is imported."""
    assert not any(name.startswith("brewster.") for name in sys.modules)
    sys.meta_path.insert(0, _Finder())
