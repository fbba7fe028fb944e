"""Writes the tree of the package in CONTRIBUTING.md; `make docs` runs it.

    .venv/bin/python runs/write_tree.py

A line of the tree is the name of a module and the first sentence of its docstring. The order is
that of the layers in pyproject.toml, from the lowest to the highest.
"""

import ast
import re
import textwrap
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PACKAGE: Final = ROOT / "src" / "brewster"
PAGE: Final = ROOT / "CONTRIBUTING.md"
TREE: Final = re.compile(r"```\nsrc/brewster/\n.*?```\n", re.S)
WIDTH: Final = 100
INDENT: Final = 2


def page() -> str:
    """Returns CONTRIBUTING.md with the tree of the package as it is."""
    text = PAGE.read_text("utf-8")
    tree = "\n".join(["```", "src/brewster/", *package_lines(), "```\n"])
    written, count = TREE.subn(lambda _: tree, text)
    if count != 1:
        raise SystemExit(f"{PAGE} has {count} trees of src/brewster/; expected one")
    return written


def package_lines() -> Iterator[str]:
    """The lines of all modules, layer by layer."""
    for name in layered_names():
        path = PACKAGE / name
        yield from lines_of(path if path.is_dir() else path.with_suffix(".py"), INDENT)


def layered_names() -> list[str]:
    """The modules and packages directly in brewster, those that are imported first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    layers = next(each["layers"] for each in contracts if each["type"] == "layers")
    return [name.rpartition(".")[2] for layer in layers[::-1] for name in layer.split(" | ")]


def lines_of(path: Path, indent: int) -> Iterator[str]:
    """The lines of a module, or of a package with all its modules."""
    if not path.is_dir():
        yield from line_of(path.stem, path, indent)
        return
    yield from line_of(f"{path.name}/", path / "__init__.py", indent)
    for child in sorted(path.iterdir()):
        is_module = child.suffix == ".py" and not child.stem.startswith("__")
        if is_module or (child / "__init__.py").exists():
            yield from lines_of(child, indent + INDENT)


def line_of(name: str, module: Path, indent: int) -> list[str]:
    """The name with the first sentence of the docstring, wrapped."""
    return textwrap.wrap(
        f"{name}: {first_sentence(module)}",
        WIDTH,
        initial_indent=" " * indent,
        subsequent_indent=" " * (indent + 2 * INDENT),
        break_long_words=False,
        break_on_hyphens=False,
    )


def first_sentence(module: Path) -> str:
    """The first sentence of the docstring of a module, without its full stop."""
    docstring = ast.get_docstring(ast.parse(module.read_text("utf-8"))) or ""
    paragraph = " ".join(docstring.split("\n\n")[0].split())
    return re.split(r"(?<!et al)\.(?= [A-Z`]|$)", paragraph)[0]


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
