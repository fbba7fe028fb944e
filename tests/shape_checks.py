"""Checks array shapes against the jaxtyping annotations at run time, in all tests.

brewster imports jaxtyping only for type checkers (`if TYPE_CHECKING`), so that users need not
install it. This import hook executes those imports, and jaxtyping's loader makes beartype check
each call. Only arrays are checked. Functions validate other values themselves, and separate tests
check this validation.
"""

import sys
import typing
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader

from beartype import beartype
from jaxtyping import AbstractArray, _import_hook

_CHECKED = tuple(
    f"brewster.{package}."
    for package in ("diffusion", "evaluation", "render", "separation", "training")
)
_OWN_ERRORS = "brewster.evaluation.study."
"""The checked packages, and a part of one that raises its own errors for wrong shapes, as metrics
does.
"""

_JAXTYPING_IMPORT = b"from jaxtyping import"


def check_arrays(function):
    """Wraps a function so that arguments and results with an array annotation are checked."""
    hints = typing.get_type_hints(function, include_extras=True)
    function.__annotations__ = {name: hint for name, hint in hints.items() if _has_shape(hint)}
    return beartype(function)


def _has_shape(hint):
    is_array = isinstance(hint, type) and issubclass(hint, AbstractArray)
    return is_array or any(map(_has_shape, typing.get_args(hint)))


class _Loader(_import_hook._JaxtypingLoader):
    def get_data(self, path):
        data = super().get_data(path)
        return data.replace(b"\nif TYPE_CHECKING:", b"\nif True:") if path == self.path else data

    def set_data(self, path, data, **_):
        """Writes no bytecode cache, because the bytecode is not that of the original file."""


class _Finder(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if not name.startswith(_CHECKED) or name.startswith(_OWN_ERRORS):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec and isinstance(spec.loader, SourceFileLoader) and has_shapes(spec.loader):
            checker = _import_hook.Typechecker("shape_checks.check_arrays")
            spec.loader = _Loader(spec.loader.name, spec.loader.path, typechecker=checker)
            return spec
        return None


def has_shapes(loader):
    return _JAXTYPING_IMPORT in loader.get_data(loader.path)


def check_shapes():
    """Installs the import hook, before brewster is imported. mutmut runs pytest several times in
    one process.
    """
    if any(isinstance(finder, _Finder) for finder in sys.meta_path):
        return
    assert not any(name.startswith("brewster.") for name in sys.modules)
    sys.meta_path.insert(0, _Finder())
