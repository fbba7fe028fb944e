"""Generates the page of the Python API from the public names and their docstrings: `make docs` writes docs/api.md.

.venv/bin/python -m brewster.cli.api_reference > docs/api.md
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, final

import click

import brewster
from brewster import errors

_BEGINNING: Final = """# Python API

`make docs` generates this page from the docstrings; a test checks that it is up to date.

```python
import brewster

separation = brewster.separate("window.jpg")
separation.transmission.save("clear.jpg")
```

`import brewster` is fast: libvips and ONNX Runtime are imported only when they are needed.

The tables have one line for each name. To read the signature and the complete docstring of a name, such as `brewster.Photo`, run
`python -m pydoc brewster.Photo`, open its source file, or build the documentation site (`make docs-site`)."""

_DETAILS: Final = """## Signatures and docstrings

On the documentation site, the signatures and the docstrings of these names are here."""


@final
@dataclass(frozen=True)
class _Section:
    """A section of the page: classes and functions of one module, and where to read more."""

    title: str
    more: str
    module: str
    names: tuple[str, ...]
    constants: tuple[str, ...] = ()
    """Constants and types without a docstring at run time. Only the documentation site has their docstrings."""

    def rows(self) -> Iterator[str]:
        """Yields the rows of the table. A class of the package root has a row for each public method and property, too."""
        module = importlib.import_module(self.module)
        for name in self.names:
            definition = getattr(module, name)
            source = Path(inspect.getfile(definition)).relative_to(_SOURCE_FOLDER).as_posix()
            yield _row(f"{self.module}.{name}", definition, f"`src/{source}`")
            if inspect.isclass(definition) and module is brewster:
                for member, value in vars(definition).items():
                    if _is_public(member) and isinstance(value, _MEMBER_KINDS):
                        yield _row(f"{name}.{member}", getattr(definition, member), "")


_SOURCE_FOLDER: Final = Path(brewster.__file__).parents[1]
_MEMBER_KINDS: Final = (type(_Section.rows), classmethod, property, cached_property)

_SECTIONS: Final = (
    _Section(
        "Separate a photo",
        "How it works: [How a photo is separated into two layers](explanation.md). Other models: [Bring your own model](models.md)\n"
        "and [Diffusion models](diffusion-models.md).",
        "brewster",
        ("separate", "Separator", "Separation"),
    ),
    _Section(
        "Photos",
        "Formats, metadata and the names of layers: [Files and formats](files.md).",
        "brewster",
        ("Photo",),
    ),
    _Section(
        "Metadata, masks and EXR layers",
        "A mask scales the strength of the separation in each pixel.",
        "brewster.photo",
        ("FileInfo", "Mask", "read_size", "read_exr_layers", "write_exr_layers"),
    ),
    _Section(
        "Separate many files",
        "Several processes, clusters and object stores: [Separate an archive](archives.md).",
        "brewster.batch",
        ("separate_files", "plan_files", "separate_tasks", "SeparationTask", "FileResult"),
    ),
    _Section(
        "Options",
        "The fields of `Options` are the options of [brewster separate](reference.md#brewster-separate), with underscores.",
        "brewster.options",
        ("Options",),
    ),
    _Section(
        "Errors",
        "All errors are subclasses of `BrewsterError`. Their messages say what happened, what was expected, and what to do.",
        "brewster.errors",
        tuple(
            name
            for name, value in vars(errors).items()
            if inspect.isclass(value) and issubclass(value, Exception)
        ),
    ),
    _Section(
        "Metrics",
        "How to score methods with these metrics: [Evaluate methods](evaluation.md). `brewster.metrics.METRICS` is the table of all\nmetrics.",
        "brewster.metrics",
        (
            "psnr",
            "psnr_of_channels",
            "ssim",
            "linear_rmse",
            "lost_clipped",
            "lost_near_white",
            "near_white_cast",
            "lpips",
            "niqe",
            "reflection_region",
            "kept_reflection",
            "removed_content",
            "removed_white",
            "find_metric",
            "Metric",
            "Comparison",
        ),
        ("METRICS", "Region"),
    ),
)


def api_reference() -> str:
    """Returns the page in Markdown: a table for each section, and then the directives that mkdocstrings replaces."""
    parts = [_BEGINNING]
    for section in _SECTIONS:
        table = "\n".join(["| name | meaning | source |", "|---|---|---|", *section.rows()])
        parts += [f"## {section.title}", section.more, table]
    return "\n\n".join([*parts, _DETAILS, *map(_directive, _SECTIONS)]) + "\n"


def _directive(section: _Section) -> str:
    """Returns the lines that mkdocstrings replaces. It finds the lazily imported names of the package root only one by one."""
    if section.module == brewster.__name__:
        return "\n\n".join(f"::: {section.module}.{name}" for name in section.names)
    options = f"show_root_heading: false\n      members: [{', '.join(section.names + section.constants)}]"
    return f"::: {section.module}\n    options:\n      {options}"


def _is_public(member: str) -> bool:
    return member == "__call__" or not member.startswith("_")


def _row(name: str, definition: object, source: str) -> str:
    """Returns a row with the first sentence of a docstring."""
    paragraph = " ".join((inspect.getdoc(definition) or "").partition("\n\n")[0].split())
    meaning = re.split(r"(?<=\.) (?=[A-Z`])", paragraph)[0].replace("|", "\\|")
    return f"| `{name}{'' if _is_value(definition) else '()'}` | {meaning} | {source} |"


def _is_value(definition: object) -> bool:
    return inspect.isclass(definition) or isinstance(definition, property | cached_property)


if __name__ == "__main__":
    click.echo(api_reference(), nl=False)
