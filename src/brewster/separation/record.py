"""`SeparationRecord`: what is known about a separation, without its pictures.

Python, `--json`, `--report`, HTTP and the page report it with the same names.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from brewster.separation.assessment import Assessment
from brewster.separation.burst_report import BurstReport


@dataclass(kw_only=True)
class SeparationRecord:
    """What is known about a separation, without its pictures. None: not known, or not measured."""

    model: str | None = None
    """The name of the model."""
    model_sha256: str | None = None
    """The digest of the model file; None for a model without a file."""
    photo_sha256: str | None = None
    """The digest of the photo's file."""
    device: str | None = None
    """The device that ran the model, such as "cpu"."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of the steps, such as `decode`, `network`, `upsampling` and `encode`."""
    residual: float | None = None
    """Mean of |photo - transmission - reflection| in linear light."""
    reconstruction_error: float | None = None
    """Mean of |generated input - input|, sRGB-encoded; None if the model generates no input."""
    assessment: Assessment | None = None
    """What was found and removed, and how reliable the result is."""
    reflection_is_derived: bool = False
    """Whether the reflection is photo - transmission in linear light, because the model predicts no
    reflection.
    """
    next_step: str | None = None
    """What may help if little was removed, or which option shows the other result of a burst."""
    burst: BurstReport | None = None
    """How a burst was separated; None for a single photo."""
    note: str | None = None
    """What changed when the photo was read, such as a conversion of CMYK colours."""

    def enter(self, other: SeparationRecord) -> None:
        """Takes over the values of another record that are known.

        Args:
            other: the record with these values.
        """
        known = {name: value for name, value in vars(other).items() if value is not None}
        vars(self).update(known)

    def as_dict(self) -> dict[str, Any]:
        """Returns the values in the types of JSON; the seconds are rounded to 1/10,000."""
        seconds = {name: round(spent, 4) for name, spent in self.seconds.items()}
        return asdict(self) | {"seconds": seconds}
