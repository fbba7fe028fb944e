"""The sRGB transfer curve, for numpy arrays and torch tensors alike.

Everything in brewster is linear light unless its name ends in `_encoded`. The curve is IEC 61966-2-1,
extended past 1 by its own formula and below 0 by its straight part, so that it stays invertible.
"""

from __future__ import annotations

from typing import Any, TypeVar

Array = TypeVar("Array", bound=Any)

REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)


def to_linear(encoded: Array) -> Array:
    """sRGB-encoded values to linear light, any shape; 1.0 stays 1.0 (IEC 61966-2-1)."""
    dark = encoded <= 0.04045
    safe = encoded * ~dark + dark  # 1 where the straight part rules: no NaN, no infinite gradient
    linear: Array = encoded / 12.92 * dark + ((safe + 0.055) / 1.055) ** 2.4 * ~dark
    return linear


def to_encoded(linear: Array) -> Array:
    """Linear light to sRGB-encoded values, any shape; 1.0 stays 1.0 (IEC 61966-2-1)."""
    dark = linear <= 0.0031308
    safe = linear * ~dark + dark
    encoded: Array = linear * 12.92 * dark + (1.055 * safe ** (1 / 2.4) - 0.055) * ~dark
    return encoded
