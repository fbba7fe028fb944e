"""What EXIF says about how a photo was taken: the flash and the exposure (CIPA DC-008, 4.6.5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

from brewster.photo.blocks.tiff_tags import EXIF_POINTER, number_of, rationals, read_tags

_EXPOSURE_TIME: Final = 33434
_F_NUMBER: Final = 33437
_SENSITIVITY: Final = 34855
_FLASH: Final = 37385
_FIRED: Final = 1


@final
@dataclass(frozen=True)
class CameraSettings:
    """How a photo was taken."""

    has_flash: bool | None
    """Whether the flash fired; None: unknown."""
    exposure: float | None
    """Seconds times ISO, divided by the square of the f-number; None: unknown."""


def camera_settings(exif: bytes | None) -> CameraSettings:
    """Returns the settings of an EXIF block, see `FileInfo`.

    Args:
        exif: the block without the leading `Exif\\0\\0`; None: there is none.
    """
    tags = read_tags(exif or b"").get(EXIF_POINTER)
    if not isinstance(tags, dict):
        return CameraSettings(None, None)
    flash = number_of(tags, _FLASH, -1)
    values = [*rationals(tags, _EXPOSURE_TIME)[:1], *rationals(tags, _F_NUMBER)[:1]]
    values.append(number_of(tags, _SENSITIVITY, 0))
    is_known = len(values) == 3 and min(values) > 0
    return CameraSettings(
        has_flash=bool(flash & _FIRED) if flash >= 0 else None,
        exposure=values[0] * values[2] / values[1] ** 2 if is_known else None,
    )
