"""Import paths of an older version, which work for one version more."""

from collections.abc import Callable
from importlib import import_module
from warnings import warn


def moved(old: str, new: str) -> Callable[[str], object]:
    """Returns the function `__getattr__` of a module whose public names are in another one now.

    Each use of a name raises a DeprecationWarning with the new path.

    Args:
        old: the name of the module.
        new: that of the module that has the names now, which is imported at the first use.
    """

    def __getattr__(name: str) -> object:  # noqa: N807  (PEP 562)
        if name.startswith("_"):
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        found: object = getattr(import_module(new), name)
        message = f"{old}.{name} is {new}.{name} now; the old path ends with the next version"
        warn(message, DeprecationWarning, stacklevel=2)
        return found

    return __getattr__
