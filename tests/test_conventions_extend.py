"""The examples of docs/how-to-extend.md and extend-backbone.md work in a copy of the package."""

import ast
import os
import re
import shutil
import sys
import textwrap
from pathlib import Path

import pytest

from other_processes import finished

ROOT = Path(__file__).parents[1]
FIRST_LINE = re.compile(r"# (?:new file )?(\S+)(?:, (among the imports|(?:in|before) [\w.]+))?\n")


def sections():
    """The code blocks of each section, by its heading."""
    pages = [
        (ROOT / "docs" / name).read_text() for name in ("how-to-extend.md", "extend-backbone.md")
    ]
    parts = [part for page in pages for part in re.split(r"^## ", page, flags=re.M)[1:]]
    return {
        part.partition("\n")[0]: re.findall(r"^```\w+\n(.*?)^```", part, re.M | re.S)
        for part in parts
    }


@pytest.fixture
def checkout(tmp_path):
    """A copy of the files that the examples change, with links to the files that they only read."""
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("weights"))
    (tmp_path / "src/brewster/separation/models/weights").symlink_to(
        ROOT / "src/brewster/separation/models/weights"
    )
    shutil.copytree(ROOT / "recipes", tmp_path / "recipes")
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    return tmp_path


def apply(block, root):
    """Inserts a block at the position that its first line gives."""
    path, position = FIRST_LINE.match(block).groups()
    body = block.partition("\n")[2]
    path = root / path
    if block.startswith("# new file"):
        assert not path.exists(), f"{path} exists already"
        path.write_text(body)
        return
    lines = path.read_text().splitlines(keepends=True)
    line, indent = find(ast.parse("".join(lines)), position)
    path.write_text("".join([*lines[:line], textwrap.indent(body, " " * indent), *lines[line:]]))


def find(tree, position):
    """Returns the number of lines before the position, and the indentation there."""
    if position == "among the imports":
        return max(
            node.end_lineno for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)
        ), 0
    relation, name = position.split(" ")
    node = tree
    for attribute in name.split("."):
        node = next(child for child in node.body if attribute in names(child))
    if relation == "before":
        return node.lineno - 1, 0
    if isinstance(node, ast.ClassDef):
        return node.end_lineno, 4
    if isinstance(node, ast.FunctionDef):  # before its last statement, the return
        return node.body[-1].lineno - 1, node.body[-1].col_offset
    return node.end_lineno - 1, 4  # before the bracket that ends a table


def names(node):
    """The names that a statement defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {target.id for target in targets if isinstance(target, ast.Name)}


@pytest.mark.parametrize("section", list(sections()))
def test_the_example_of_each_section_works(section, checkout):
    *changes, check = sections()[section]
    for block in changes:
        apply(block, checkout)
    kind, _, code = check.partition("\n")
    assert kind == "# try it"
    variables = os.environ | {"PYTHONPATH": str(checkout / "src"), "HF_HUB_OFFLINE": "1"}
    process = finished([sys.executable, "-c", code], cwd=checkout, env=variables)
    assert process.returncode == 0, process.stderr
