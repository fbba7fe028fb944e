"""`Separation`: the layers of a photo, with the model, the device and the quality measures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np

from brewster.errors import BrewsterError
from brewster.photo import Photo
from brewster.photo.contact_sheet import side_by_side
from brewster.photo.open_raster import LayeredImage
from brewster.separation.assessment import Assessment
from brewster.separation.burst_report import BurstReport
from brewster.separation.guided_upsampling import Floats, upsample_rows
from brewster.separation.record import SeparationRecord


@final
@dataclass(frozen=True)
class Separation:
    """The layers of a photo, each of the size of the photo, with the model, the device and the
    quality measures.
    """

    photo: Photo
    """The input."""
    transmission: Photo
    """The scene behind the glass."""
    reflection: Photo
    """The scene mirrored in the glass."""
    confidence_map: Floats = field(compare=False)
    """Confidence in 0..1, (h, w, 1), at the size of the largest input of the network."""
    residual: float
    """Mean of |photo - transmission - reflection| in linear light."""
    reconstruction_error: float | None
    """Mean of |generated input - input|, sRGB-encoded, or None if the model does not generate the
    input.
    """
    assessment: Assessment
    """What the model found in the photo, what was removed, and how reliable the result is. If the
    strength or the mask is 0 everywhere, nothing is removed, and the verdict is "little found".
    """
    model: str
    """The name of the model."""
    sha256: str | None
    """The digest of the model file; None for a model without a file."""
    device: str
    """The device that ran the model, such as "cpu"."""
    seconds: dict[str, float] = field(compare=False)
    """Wall time of the steps `decode`, `network` and `upsampling`."""
    reflection_is_derived: bool = False
    """Whether the reflection is photo - transmission in linear light, because the model predicts no
    reflection.
    """
    next_step: str | None = None
    """What may help if little was removed, or which option shows the other result of a burst; or
    None.
    """
    burst: BurstReport | None = None
    """How a burst was separated; None for a single photo."""
    _exchange: Callable[[], Separation] | None = field(default=None, repr=False, compare=False)
    """Computes the layers of a burst with each other's names."""

    def __repr__(self) -> str:
        width, height = self.photo.size
        return f"Separation({width} x {height}, {self.model}, {self.assessment.verdict})"

    def __iter__(self) -> Iterator[Photo]:
        yield from (self.transmission, self.reflection)

    def _repr_png_(self) -> bytes:
        """For notebooks: photo, transmission and reflection side by side, as a PNG."""
        return Photo(side_by_side((self.photo, self.transmission, self.reflection))).encode("png")

    def swapped(self) -> Separation:
        """Returns the same photo of a burst with its measured layers exchanged: their names may be
        wrong.

        The layers are computed at full size again, but not measured again. Raises BrewsterError
        without these.
        """
        if self._exchange is None:
            raise BrewsterError(
                f"there are no measured layers to exchange in {self!r}",
                "expected the separation of a burst by its motion",
                'separate several photos with separate_burst, and method="motion" if the motion '
                "was not used",
            )
        return self._exchange()

    @property
    def record(self) -> SeparationRecord:
        """All but the pictures, as in a line of `--json`; its `as_dict` has the types of JSON."""
        info = self.photo.file_info
        return SeparationRecord(
            model=self.model,
            model_sha256=self.sha256,
            photo_sha256=info.sha256,
            device=self.device,
            seconds=dict(self.seconds),
            residual=self.residual,
            reconstruction_error=self.reconstruction_error,
            assessment=self.assessment,
            reflection_is_derived=self.reflection_is_derived,
            next_step=self.next_step,
            burst=self.burst,
            note=info.note,
        )

    @property
    def layered(self) -> LayeredImage:
        """Both layers as one OpenRaster file; its `encode` returns the bytes."""
        return LayeredImage(self.photo, self.transmission)

    @cached_property
    def confidence(self) -> Photo:
        """The confidence as a grey 8-bit image of the size of the photo: 255 is certain. Computed
        on first use.
        """
        width, height = self.photo.size
        canvas = np.empty((height, width, 1), np.uint8)
        for rows in self.photo.strips():
            enlarged = upsample_rows(
                self.confidence_map, rows.start, rows.stop - rows.start, (height, width)
            )
            canvas[rows] = np.rint(255 * enlarged)
        return Photo(canvas)
