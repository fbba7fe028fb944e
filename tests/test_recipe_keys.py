"""Descriptions of recipe keys: complete, and in words that state the constraints."""

from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field

from brewster.cli.recipe_reference import RECIPE_KINDS, recipe_reference
from brewster.scene.recipe_keys import REQUIRED, recipe_tables
from brewster.scene.values import FrozenModel, KeyNote, LogRange, Pixels, Share

DOCS = Path(__file__).parents[1] / "docs"


class Inner(FrozenModel):
    """An inner table."""

    width_px: Pixels = 64
    """A width."""
    mode: Literal["fast", "slow"] | None = None
    """A mode."""


class Outer(FrozenModel):
    """A recipe."""

    length_mm: LogRange = (1.0, 2.0)
    """A length,
    over two lines."""
    shares: Annotated[list[Share], Field(min_length=1), KeyNote(allowed="all different")]
    """Some shares."""
    inner: Inner | None = None
    """An optional table."""


def keys(model):
    return {key.path: key for table in recipe_tables(model) for key in table.keys}


def test_a_key_has_type_allowed_values_unit_default_and_meaning():
    found = keys(Outer)
    assert list(found) == ["length_mm", "shares", "inner.width_px", "inner.mode"]
    length = found["length_mm"]
    assert (length.kind, length.unit, length.default) == ("range [low, high]", "mm", [1.0, 2.0])
    assert length.allowed == "each above 0, sampled log-uniformly"
    assert length.meaning == "A length, over two lines."
    shares = found["shares"]
    assert (shares.kind, shares.default) == ("list of numbers", REQUIRED)
    assert shares.allowed == "each from 0 to 1, at least 1 entry, all different"
    assert (found["inner.width_px"].allowed, found["inner.width_px"].unit) == ("at least 16", "px")
    assert found["inner.mode"].allowed == 'one of "fast", "slow"'


@pytest.mark.parametrize("title", RECIPE_KINDS)
def test_every_key_of_every_recipe_is_explained_in_a_sentence(title):
    model, _ = RECIPE_KINDS[title]
    for key in keys(model).values():
        assert key.meaning[:1].isupper() or key.meaning.partition(":")[0].isalnum(), key.path
        assert key.meaning.endswith("."), key.path
    assert all(table.meaning.endswith(".") for table in recipe_tables(model))


def test_the_reference_in_the_docs_is_up_to_date():
    assert (DOCS / "recipes.md").read_text() == recipe_reference(), "run make docs"
