"""Imports diffusers, transformers, peft and huggingface_hub at their first use, and converts their
errors.
"""

import contextlib
import importlib
import logging
import sys
from collections.abc import Iterator
from typing import Any

from brewster.errors import MissingExtra


def import_library(name: str) -> Any:  # noqa: ANN401 - a module of a library that may be missing
    """Imports a module of a third-party library and returns it."""
    try:
        with suppress_log_messages():
            return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtra.for_extra(
            "diffusion",
            f"{error.name or name} cannot be imported ({error})",
            "expected it to be installed, because the diffusion models need it",
        ) from error


def import_bitsandbytes() -> None:
    """Imports bitsandbytes, which stores weights in nf4. The extra `diffusion` does not install
    it.
    """
    try:
        import_library("bitsandbytes")
    except MissingExtra as error:
        raise MissingExtra(
            error.happened,
            "expected it to be installed, because it stores the weights in nf4",
            "run: pip install bitsandbytes, or choose the quantization int8",
        ) from error


def diffusers_class(name: str) -> Any:  # noqa: ANN401 - diffusers has no types that mypy reads
    """A class of diffusers by its name. Raises MissingExtra if it, or a library that it needs, is
    missing.
    """
    diffusers = import_library("diffusers")
    try:
        with suppress_log_messages():
            return getattr(diffusers, name)
    except (
        AttributeError,
        RuntimeError,
    ) as error:  # diffusers converts errors of the import to RuntimeError
        raise MissingExtra.for_extra(
            "diffusion",
            f"the class {name} cannot be imported from diffusers ({error.__cause__ or error})",
            "expected a version of diffusers that has the class, and the libraries that the "
            "class needs",
        ) from error


@contextlib.contextmanager
def suppress_log_messages() -> Iterator[None]:
    """Disables log messages up to WARNING: on import, diffusers and transformers warn about
    optional packages.
    """
    previous_level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(previous_level)


def disable_progress_bars_in_pipes() -> None:
    """Disables the progress bars of third-party libraries unless stderr is a terminal: they also
    write to pipes.
    """
    if sys.stderr.isatty():
        return
    import_library("huggingface_hub.utils").disable_progress_bars()
    import_library("diffusers.utils.logging").disable_progress_bar()
    import_library("transformers.utils.logging").disable_progress_bar()
