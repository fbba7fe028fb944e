"""The HTTP API: a photo in, its layers out.

    POST /separate    a form with the photo and the options      GET /progress/{job}    how far it is
    GET /models       what can be asked for                      GET /health            whether the server is well

Nothing is fetched by URL, and nothing is written to the disk.
"""

from __future__ import annotations

import io
import time
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal, final
from urllib.parse import quote

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.responses import Response

import brewster
from brewster.image_formats import SUFFIXES
from brewster.inference.predictor import ProgressCallback
from brewster.photo import Photo
from brewster.web.job_queue import JobProgress, JobQueue
from brewster.web.model_cache import ModelCache, ModelRow
from brewster.web.preview import preview
from brewster.web.request_schema import SeparationRequest, form_schema, read_form

_EPOCH: Final = (1980, 1, 1, 0, 0, 0)  # zip has no earlier; the same layers make the same bytes


@final
class ErrorResponse(BaseModel):
    """What every refusal looks like."""

    error: str
    """What happened, what was expected, and what to do."""


@final
class HealthResponse(BaseModel):
    """Whether the server is well."""

    status: Literal["ok"] = "ok"
    version: str = brewster.__version__
    jobs: int
    """How many photos are waiting or being worked on."""
    places: int
    """How many there can be."""


Make = Callable[[ModelCache, SeparationRequest, ProgressCallback], Response]
_TROUBLE: Final[dict[str, Any]] = {"model": ErrorResponse}
_ANSWERS: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "One layer, or a zip of several.",
        "content": {"image/*": {}, "application/zip": {}},
    },
    **dict.fromkeys((400, 401, 403, 408, 409, 413, 415, 421, 422, 500, 501, 503, 504), _TROUBLE),
}
JobName = Annotated[
    str | None,
    Query(pattern="^[A-Za-z0-9-]{8,64}$", description="A name of your choice, for `GET /progress/{job}`."),
]


def separation(shelf: ModelCache, desk: JobQueue, *, max_pixels: int) -> APIRouter:
    """The routes of the API, and the page's own previews."""
    router = APIRouter()
    form = {"multipart/form-data": {"schema": form_schema(shelf.names)}}
    body = {"requestBody": {"required": True, "content": form}}

    async def work(request: Request, job: str | None, make: Make) -> Response:
        """Takes a place, then the bytes, and answers with what `make` makes of them."""
        with desk.place(job) as place:
            asked = await read_form(request, shelf.names, max_pixels)
            return await desk.do(place, partial(make, shelf, asked), request.receive)

    @router.post("/separate", responses=_ANSWERS, response_class=Response, openapi_extra=body)
    async def separate(request: Request, job: JobName = None) -> Response:
        """The layers of a photo: one is a picture, in the photo's own format and colours; several are a zip.

        A client that goes away stops the work. Files are named as the command line names them.
        """
        return await work(request, job, _separate)

    @router.post("/preview", include_in_schema=False)
    async def show(request: Request, job: JobName = None) -> Response:
        return await work(request, job, _preview)

    @router.get("/progress/{job}", responses={404: _TROUBLE})
    async def progress(job: str) -> JobProgress:
        """How far a job is that a client has named; 404 before it begins and after its end."""
        found = desk.progress(job)
        if found is None:
            raise HTTPException(404, "there is no such job now; it has ended, or has not arrived yet")
        return found

    @router.get("/models")
    def models() -> list[ModelRow]:
        """The models that can be asked for, the default first."""
        return shelf.rows()

    @router.get("/health")
    async def health() -> HealthResponse:
        """Whether the server is well, and how busy."""
        return HealthResponse(jobs=desk.jobs, places=desk.workers + desk.queue)

    return router


def _separate(shelf: ModelCache, asked: SeparationRequest, on_progress: ProgressCallback) -> Response:
    """The layers as files."""
    started = time.perf_counter()
    options = asked.options
    separation = shelf.separator(options.model)(
        asked.photo, on_progress=on_progress, **options.call_options()
    )
    files = {}
    for layer in options.layers:
        on_progress(1)  # encoding takes a while, too, and may not be wanted any more
        name = asked.target(layer, separation.photo.file_info.container)
        files[name] = getattr(separation, layer).encode(SUFFIXES[Path(name).suffix.lower()].name)
    name, data = (
        next(iter(files.items())) if len(files) == 1 else (f"{Path(asked.name).stem}.zip", _zip(files))
    )
    headers = {
        "Content-Disposition": _attachment(name),
        "Brewster-Model": quote(separation.model),
        "Brewster-SHA256": separation.sha256 or "",
        "Brewster-Device": separation.device,
        "Brewster-Residual": f"{separation.residual:.6f}",
        "Brewster-Seconds": f"{time.perf_counter() - started:.4f}",
    }
    if separation.reconstruction_error is not None:
        headers |= {
            "Brewster-Reconstruction-Error": f"{separation.reconstruction_error:.6f}",
            "Brewster-Doubtful": str(separation.doubtful).lower(),
        }
    return Response(data, headers=headers, media_type=_media(name))


def _preview(shelf: ModelCache, asked: SeparationRequest, on_progress: ProgressCallback) -> Response:
    photo = Photo.open(asked.photo, max_pixels=asked.options.max_pixels)
    maps = preview(shelf.separator(asked.options.model), photo, asked.options, on_progress)
    return Response(maps, media_type="application/octet-stream")


def _media(name: str) -> str:
    if name.endswith(".zip"):
        return "application/zip"
    return SUFFIXES[Path(name).suffix.lower()].mime_type


def _zip(files: Mapping[str, bytes]) -> bytes:
    """Files as one, not compressed: pictures are so already."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
    return whole.getvalue()


def _attachment(name: str) -> str:
    """A file's name as a header: plain for old clients, whole for the others (RFC 6266)."""
    plain = name.encode("ascii", "replace").decode().translate(str.maketrans('"\\?', "___"))
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"
