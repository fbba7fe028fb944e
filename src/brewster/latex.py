"""Names as LaTeX takes them."""

from __future__ import annotations

from typing import Final

_SPECIAL: Final = str.maketrans(
    {letter: f"\\{letter}" for letter in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\^{}"}
)


def escaped(text: str) -> str:
    """The text with each letter that LaTeX reads as a command written so that it prints."""
    return text.translate(_SPECIAL)
