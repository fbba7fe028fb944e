"""Every argument of the public functions has an entry of its own in their docstrings."""

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import griffe
import pytest

ROOT = Path(__file__).parents[1]
API_ROW = re.compile(r"^\| `(brewster\.[\w.]+)(?:\(\))?` \|", re.M)
IMPLICIT = {"self", "cls"}


@pytest.fixture(scope="module")
def package():
    """The package as griffe reads it, without importing it."""
    logging.getLogger("griffe").setLevel(logging.CRITICAL)  # annotations of unread libraries
    return griffe.load(
        "brewster",
        search_paths=[ROOT / "src"],
        docstring_parser=griffe.Parser.google,
        resolve_aliases=True,
        resolve_external=False,
    )


def members(parent: griffe.Object) -> Iterator[griffe.Object]:
    """All modules, classes and functions below, without imported names."""
    for member in parent.members.values():
        if not member.is_alias:
            yield member
            if member.is_module or member.is_class:
                yield from members(member)


def entries(documented: griffe.Object) -> list[str]:
    """The names that the docstring describes, each in an entry of its own, without stars."""
    if documented.docstring is None:
        return []
    kinds = {griffe.DocstringSectionKind.parameters, griffe.DocstringSectionKind.attributes}
    sections = documented.docstring.parse(griffe.Parser.google, warnings=False)
    found = [entry for section in sections if section.kind in kinds for entry in section.value]
    return [entry.name.lstrip("*") for entry in found]


def arguments(function: griffe.Function) -> list[str]:
    names = [parameter.name.lstrip("*") for parameter in function.parameters]
    return [name for name in names if name not in IMPLICIT and not name.startswith("_")]


def public_callables(listed: griffe.Object) -> Iterator[griffe.Function]:
    """The function itself; of a class, its constructor, its call and its public methods."""
    if listed.is_function:
        yield listed
    elif listed.is_class:
        for member in listed.members.values():
            is_public = not member.name.startswith("_") or member.name in ("__init__", "__call__")
            if member.is_function and is_public:
                yield member


def undocumented(function: griffe.Function) -> list[str]:
    """The arguments without an entry. A constructor's are described in the docstring of the class,
    or in the docstrings of its fields and of the inherited ones.
    """
    described = entries(function)
    if function.name == "__init__":
        owner = function.parent
        described += entries(owner)
        described += [name for name, field in owner.all_members.items() if field.docstring]
    return [name for name in arguments(function) if name not in described]


def test_the_argument_checker_finds_swallowed_and_joined_arguments(package):
    code = '''
def swallowed(photo, swap):
    """Separates.

    Args:
        photo: the photo. swap: whether the layers
            are exchanged.
    """

def joined(begin, end):
    """Separates.

    Args:
        begin, end: rows.
    """

def whole(photo, *rest, swap=False, **options):
    """Separates.

    Args:
        photo: the photo.
        *rest: more photos.
        swap: whether the layers are exchanged.
        **options: others.
    """
'''
    with griffe.temporary_visited_module(code) as module:
        assert undocumented(module["swallowed"]) == ["swap"]
        assert undocumented(module["joined"]) == ["begin", "end"]
        assert undocumented(module["whole"]) == []


def test_every_argument_of_the_public_names_has_an_entry(package):
    pages = "".join(page.read_text() for page in ROOT.glob("docs/api*.md"))
    names = sorted(set(API_ROW.findall(pages)))
    assert len(names) > 40
    missing = {}
    for name in names:
        listed = package[name.removeprefix("brewster.")]
        listed = listed.final_target if listed.is_alias else listed
        for function in public_callables(listed):
            if lacks := undocumented(function):
                missing[function.path] = lacks
    assert missing == {}


def test_a_list_of_arguments_has_exactly_those_of_the_signature(package):
    checked = 0
    wrong = {}
    for documented in members(package):
        has_list = documented.docstring and "\nArgs:\n" in documented.docstring.value
        if not has_list:
            continue
        checked += 1
        function = documented.members["__init__"] if documented.is_class else documented
        if entries(documented) != arguments(function):
            wrong[documented.path] = entries(documented)
    assert wrong == {}
    assert checked > 40
