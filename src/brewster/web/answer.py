"""What the server answers: the bodies, and for one version also the headers of a separation.

The JSON of a separation has the names of `SeparationRecord`, as a line of `--json` has.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Final, Literal, final
from urllib.parse import quote

from pydantic import BaseModel
from starlette.requests import Request

import brewster
from brewster.options import Layer
from brewster.separation.burst_report import BurstReport
from brewster.separation.record import SeparationRecord

_JSON: Final = "application/json"
_HEADERS: Final[dict[str, Callable[[SeparationRecord], str | None]]] = {
    "Brewster-Model": lambda record: record.model and quote(record.model),
    "Brewster-SHA256": lambda record: record.model_sha256 or "",
    "Brewster-Device": lambda record: record.device,
    "Brewster-Residual": lambda record: _decimal(record.residual, 6),
    "Brewster-Reconstruction-Error": lambda record: _decimal(record.reconstruction_error, 6),
    "Brewster-Reflection": lambda record: "derived" if record.reflection_is_derived else None,
    "Brewster-Verdict": lambda record: record.assessment and record.assessment.verdict,
    "Brewster-Note": lambda record: record.note and quote(record.note),
    "Brewster-Next-Step": lambda record: record.next_step,
}
_BURST_HEADERS: Final[dict[str, Callable[[BurstReport], str]]] = {
    "Brewster-Burst": lambda report: report.method,
    "Brewster-Burst-Message": lambda report: report.message,
    "Brewster-Burst-Measured": lambda report: "yes" if report.is_measured else "no",
    "Brewster-Burst-Doubtful": lambda report: f"{report.doubtful_area:.4f}",
    "Brewster-Burst-Names": lambda report: "certain" if report.are_names_certain else "unsure",
}


@final
class ErrorResponse(BaseModel):
    """The body of every error response."""

    error: str
    """What happened, what was expected, and what to do."""
    kind: str | None = None
    """The class of the error in `brewster.errors`, such as UnreadablePhoto, or None for other
    errors.
    """


@final
class HealthResponse(BaseModel):
    """The state of the server."""

    status: Literal["ok"] = "ok"
    version: str = brewster.__version__
    jobs: int
    """Number of photos that are waiting or being separated."""
    places: int
    """Maximum value of `jobs`."""
    takes_films: bool
    """Whether films and bursts can be separated: the extra burst is installed."""


@final
class RelatedResponse(BaseModel):
    """Whether photos belong together."""

    are_related: bool
    """Whether all photos show one scene, each the one of the photo before."""


@final
class UploadResponse(BaseModel):
    """The files that the server keeps."""

    key: str
    """What to send as the field `photo` of the next requests."""
    is_film: bool
    """Whether the file is a film."""


@final
class LayerFile(BaseModel):
    """A layer as a file."""

    name: str
    media_type: str
    data: str
    """The content of the file, in Base64."""

    @classmethod
    def of(cls, name: str, media_type: str, content: bytes) -> LayerFile:
        """Returns a layer as a part of JSON.

        Args:
            name: the name of the file.
            media_type: its type, such as image/png.
            content: its bytes.
        """
        return cls(name=name, media_type=media_type, data=base64.b64encode(content).decode())


@final
class Answer(BaseModel):
    """What `POST /separate` answers to a client that accepts application/json."""

    result: SeparationRecord
    """As in a line of `--json`."""
    layers: dict[Layer, LayerFile]


def accepts_json(request: Request) -> bool:
    """Returns whether the client names JSON as a type that it accepts.

    Args:
        request: that of the client.
    """
    accepted = request.headers.get("accept", "").lower().split(",")
    return _JSON in (kind.partition(";")[0].strip() for kind in accepted)


def headers_of(record: SeparationRecord) -> dict[str, str]:
    """Returns the headers with the values of a record.

    Args:
        record: that of the separation. The header `Brewster-Seconds` is the sum of its seconds.
    """
    headers = {name: value(record) for name, value in _HEADERS.items()}
    if record.seconds:
        headers["Brewster-Seconds"] = f"{sum(record.seconds.values()):.4f}"
    if record.burst:
        headers |= {name: value(record.burst) for name, value in _BURST_HEADERS.items()}
    if record.burst and record.burst.film:
        headers |= {
            "Brewster-Film": record.burst.film.layout,
            "Brewster-Film-Seconds": f"{record.burst.film.seconds:.1f}",
        }
    return {name: value for name, value in headers.items() if value is not None}


def _decimal(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value:.{digits}f}"
