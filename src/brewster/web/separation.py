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
from brewster.files import SUFFIXES
from brewster.inference.predictor import ProgressCallback
from brewster.photo import Photo
from brewster.web.job_queue import JobProgress, JobQueue
from brewster.web.model_cache import ModelCache, ModelRow
from brewster.web.preview import preview
from brewster.web.request_schema import SeparationRequest, form_schema, read_form

_MEDIA: Final = {
    "exr": "image/x-exr",
    "hdr": "image/vnd.radiance",
}  # the others are image/ and their own name
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


Handler = Callable[[ModelCache, SeparationRequest, ProgressCallback], Response]
_ERROR: Final[dict[str, Any]] = {"model": ErrorResponse}
_RESPONSES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "One layer, or a zip of several.",
        "content": {"image/*": {}, "application/zip": {}},
    },
    **dict.fromkeys((400, 401, 403, 408, 409, 413, 415, 421, 422, 500, 501, 503, 504), _ERROR),
}
JobName = Annotated[
    str | None,
    Query(pattern="^[A-Za-z0-9-]{8,64}$", description="A name of your choice, for `GET /progress/{job}`."),
]


def separation_router(model_cache: ModelCache, job_queue: JobQueue, *, max_pixels: int) -> APIRouter:
    """The routes of the API, and the page's own previews."""
    router = APIRouter()
    content = {"multipart/form-data": {"schema": form_schema(model_cache.names)}}
    body = {"requestBody": {"required": True, "content": content}}

    async def run(request: Request, job: str | None, handler: Handler) -> Response:
        """Takes a place, then the bytes, and answers with what `make` makes of them."""
        with job_queue.reserve(job) as reserved_job:
            form = await read_form(request, model_cache.names, max_pixels)
            return await job_queue.run_job(reserved_job, partial(handler, model_cache, form), request.receive)

    @router.post("/separate", responses=_RESPONSES, response_class=Response, openapi_extra=body)
    async def separate(request: Request, job: JobName = None) -> Response:
        """The layers of a photo: one is a picture, in the photo's own format and colours; several are a zip.

        A client that goes away stops the work. Files are named as the command line names them.
        """
        return await run(request, job, _separate)

    @router.post("/preview", include_in_schema=False)
    async def preview_maps(request: Request, job: JobName = None) -> Response:
        return await run(request, job, _preview)

    @router.get("/progress/{job}", responses={404: _ERROR})
    async def progress(job: str) -> JobProgress:
        """How far a job is that a client has named; 404 before it begins and after its end."""
        found = job_queue.progress(job)
        if found is None:
            raise HTTPException(404, "there is no such job now; it has ended, or has not arrived yet")
        return found

    @router.get("/models")
    def models() -> list[ModelRow]:
        """The models that can be asked for, the default first."""
        return model_cache.rows()

    @router.get("/health")
    async def health() -> HealthResponse:
        """Whether the server is well, and how busy."""
        return HealthResponse(jobs=job_queue.jobs, places=job_queue.workers + job_queue.max_waiting)

    return router


def _separate(model_cache: ModelCache, form: SeparationRequest, on_progress: ProgressCallback) -> Response:
    """The layers as files."""
    started = time.perf_counter()
    options = form.options
    separation = model_cache.separator(options.model)(form.photo, on_progress=on_progress, **options.call())
    files = {}
    for layer in options.layers:
        on_progress(1)  # encoding takes a while, too, and may not be wanted any more
        name = form.target(layer, separation.photo.file_info.container)
        files[name] = getattr(separation, layer).encode(SUFFIXES[Path(name).suffix.lower()])
    name, data = (
        next(iter(files.items())) if len(files) == 1 else (f"{Path(form.name).stem}.zip", _zip(files))
    )
    headers = {
        "Content-Disposition": _content_disposition(name),
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
    return Response(data, headers=headers, media_type=_media_type(name))


def _preview(model_cache: ModelCache, form: SeparationRequest, on_progress: ProgressCallback) -> Response:
    photo = Photo.open(form.photo, max_pixels=form.options.max_pixels)
    maps = preview(model_cache.separator(form.options.model), photo, form.options, on_progress)
    return Response(maps, media_type="application/octet-stream")


def _media_type(name: str) -> str:
    if name.endswith(".zip"):
        return "application/zip"
    container = SUFFIXES[Path(name).suffix.lower()]
    return _MEDIA.get(container, f"image/{container}")


def _zip(files: Mapping[str, bytes]) -> bytes:
    """Files as one, not compressed: pictures are so already."""
    archive_file = io.BytesIO()
    with zipfile.ZipFile(archive_file, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
    return archive_file.getvalue()


def _content_disposition(name: str) -> str:
    """A file's name as a header: plain for old clients, whole for the others (RFC 6266)."""
    ascii_name = name.encode("ascii", "replace").decode().translate(str.maketrans('"\\?', "___"))
    return f"attachment; filename=\"{ascii_name}\"; filename*=UTF-8''{quote(name, safe='')}"
