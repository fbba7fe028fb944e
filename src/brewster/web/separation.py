"""The HTTP API that separates photos.

    POST /photos                    keeps a photo, a burst or a film for the next requests
    POST /separate                  a form with the photo, or its key, and the options
    GET  /progress/{job}            the progress of a request
    POST /related                   whether thumbnails show one scene
    GET  /models                    the available models
    GET  /health                    the state of the server

Routes of the page:

    POST /preview                   maps from which the page computes the layers (see preview.py)
    POST /photo                     decodes a photo for its tiles; for clients before POST /photos
    GET  /tile/{key}/{level}/...    a tile of a kept photo
    GET  /progress/{job}/layers     the measured layers so far of a burst

The server fetches nothing by URL and writes nothing to the disk.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Annotated, Any, Final, final
from urllib.parse import quote

import numpy as np
from fastapi import APIRouter, Query, Request
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from brewster.base.cache import ByteLimitedCache
from brewster.base.image_formats import SUFFIXES
from brewster.options import DEFAULT_FRAMES, FILM_NO, BurstMethod, Options
from brewster.photo import Photo, Source
from brewster.photo.file_info import with_notes
from brewster.photo.open_raster import zip_images
from brewster.photo.phone_films.motion_photo import PhotoFilm
from brewster.photo.photo import misleading_suffix
from brewster.separation import Separator
from brewster.separation.assessment import next_step
from brewster.separation.predictor import ProgressCallback
from brewster.separation.record import SeparationRecord
from brewster.separation.used_film import FoundFilm, find_used_film
from brewster.web.answer import (
    Answer,
    ErrorResponse,
    HealthResponse,
    LayerFile,
    RelatedResponse,
    UploadResponse,
    accepts_json,
    headers_of,
)
from brewster.web.film_preparation import FilmPreparation
from brewster.web.job_queue import JobProgress, JobQueue, SeparationJob
from brewster.web.model_cache import ModelCache, ModelRow
from brewster.web.preview import photo_tile, preview
from brewster.web.request_schema import (
    COMPARISON_SCHEMA,
    UPLOAD_SCHEMA,
    SeparationRequest,
    form_schema,
    read_form,
    read_upload,
)
from brewster.web.uploads import Upload

if TYPE_CHECKING:
    from brewster.film.fitted_burst import FittedBurst

_GZIP_LEVEL: Final = 1  # higher levels save little more and take several times longer
_TILE_HEADERS: Final = {"Cache-Control": "private, max-age=3600"}
_MAX_UPLOAD_BYTES: Final = 200_000_000  # of the files of the last uploads
_MAX_PHOTO_BYTES: Final = 200_000_000  # of the decoded photos of the last requests, for the tiles
_MAX_BURST_BYTES: Final = 200_000_000  # of the last measured bursts
_VIDEO_SHARE: Final = 0.1
"""Estimated time of reading a video divided by that of its measurement, for the progress."""
_FIT_SHARE: Final = 0.9
"""Estimated time of the measurement of a burst divided by that of its separation."""
_FILM_PACKAGES: Final = ("av", "cv2", "numba")


Handler = Callable[[SeparationRequest, SeparationJob, ProgressCallback], Response]
_ERROR: Final[dict[str, Any]] = {"model": ErrorResponse}
_RESPONSES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "model": Answer,
        "description": "One layer, or a zip of several layers; or JSON, if the client accepts it.",
        "content": {"image/*": {}, "application/zip": {}},
    },
    **dict.fromkeys((400, 401, 403, 408, 409, 413, 415, 421, 422, 500, 501, 502, 503, 504), _ERROR),
}
JobName = Annotated[
    str | None,
    Query(
        pattern="^[A-Za-z0-9-]{8,64}$",
        description="A name for this request, chosen by the client, for `GET /progress/{job}`: 8 "
        "to 64 ASCII letters, digits and hyphens.",
    ),
]


def separation_router(
    model_cache: ModelCache,
    job_queue: JobQueue,
    *,
    max_pixels: int,
    preparation: FilmPreparation | None = None,
) -> APIRouter:
    """Returns the routes of the API, and the previews and tiles for the page.

    Args:
        model_cache: the models that clients can choose.
        job_queue: runs the separations, and is closed when the application stops.
        max_pixels: the maximum number of pixels of each photo.
        preparation: what is compiled for films meanwhile, for the progress of jobs.
    """
    preparation = preparation or FilmPreparation()
    routes = _SeparationRoutes(model_cache, job_queue, max_pixels, preparation)
    router = APIRouter(lifespan=routes.lifespan)
    body, comparison, upload = (
        {"requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}}
        for schema in (form_schema(model_cache.names), COMPARISON_SCHEMA, UPLOAD_SCHEMA)
    )
    router.post("/separate", responses=_RESPONSES, response_class=Response, openapi_extra=body)(
        routes.separate
    )
    router.get("/progress/{job}", responses={404: _ERROR})(routes.progress)
    router.get("/progress/{job}/layers", include_in_schema=False)(routes.layers)
    router.get("/models")(routes.models)
    router.get("/health")(routes.health)
    errors = {status: response for status, response in _RESPONSES.items() if status != 200}
    router.post("/related", responses=errors, openapi_extra=comparison)(routes.related)
    router.post("/photos", responses=errors, openapi_extra=upload)(routes.keep_upload)
    # only for the page
    router.post("/preview", include_in_schema=False)(routes.preview)
    router.post("/photo", include_in_schema=False)(routes.keep_photo)
    router.get("/tile/{key}/{level}/{column}/{row}", include_in_schema=False)(routes.tile)
    return router


@final
class _SeparationRoutes:
    """The handlers of the routes, the last uploads, the photos of the last previews, and the layers
    of the last bursts.
    """

    def __init__(
        self,
        model_cache: ModelCache,
        job_queue: JobQueue,
        max_pixels: int,
        preparation: FilmPreparation,
    ) -> None:
        self._model_cache = model_cache
        self._job_queue = job_queue
        self._max_pixels = max_pixels
        self._preparation = preparation
        self._uploads = ByteLimitedCache[Upload](_MAX_UPLOAD_BYTES)
        self._photos = ByteLimitedCache[Photo](_MAX_PHOTO_BYTES, lambda photo: photo.pixels.nbytes)
        self._decoding = Lock()
        self._bursts: ByteLimitedCache[FittedBurst] = ByteLimitedCache(_MAX_BURST_BYTES)
        # Of its own, because the page asks before a separation, and jobs may take a minute.
        self._quick_queue = JobQueue(
            max_waiting=job_queue.max_waiting, timeout_seconds=job_queue.timeout_seconds
        )

    @asynccontextmanager
    async def lifespan(self, _app: object) -> AsyncIterator[None]:
        """Closes the queues when the application stops, so that no thread of them remains."""
        try:
            yield
        finally:
            self._job_queue.close()
            self._quick_queue.close()

    async def _run(self, request: Request, job: str | None, handler: Handler) -> Response:
        with self._job_queue.reserve(job) as reserved_job:
            form = await read_form(
                request, self._model_cache.names, self._max_pixels, self._uploads.get
            )
            return await self._job_queue.run_job(
                reserved_job, partial(handler, form, reserved_job), request.receive
            )

    async def separate(self, request: Request, job: JobName = None) -> Response:
        """Separates a photo, or a burst: several photos of one window. A single layer is returned
        as an image in the format and colour space of the photo, several layers as a zip.

        The names of the files are those of the command line. The separation stops if the client
        disconnects.
        """
        as_json = accepts_json(request)
        return await self._run(request, job, partial(self._separate, as_json=as_json))

    async def keep_upload(self, request: Request) -> UploadResponse:
        """Keeps a photo, a burst or a film in memory for the next requests, which send its key as
        the field `photo`. The oldest uploads are dropped if they need too much memory. A film that
        cannot be decoded is refused.
        """
        with self._quick_queue.reserve() as job:
            upload = await read_upload(request)
            if upload.is_video:
                check = partial(_check_film, upload.contents[0], self._max_pixels)
                await self._quick_queue.run_job(job, check, request.receive)
        kept = self._uploads.get_or_create(upload.key, lambda: upload)
        return UploadResponse(key=kept.key, is_film=kept.is_video)

    async def progress(self, job: str) -> JobProgress:
        """Returns the progress of the job with this name. The status is 404 before the job begins
        and after its end.
        """
        found = self._job_queue.progress(job)
        if found is None:
            raise HTTPException(
                404,
                "there is no job with this name; expected a job that is waiting or running; "
                "it may have ended, or not have arrived yet: try again later",
            )
        return replace(found, preparing=self._preparation.share if found.is_measuring else None)

    def layers(self, job: str) -> Response:
        """Returns the measured layers so far of the job with this name."""
        found = self._job_queue.layers(job)
        if found is None:
            raise HTTPException(
                404, "there are no layers yet; expected a burst that is measured; try again later"
            )
        return Response(found, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    def models(self) -> list[ModelRow]:
        """Returns the available models, the default first."""
        return self._model_cache.rows()

    async def health(self) -> HealthResponse:
        """Returns the version of the server and the number of its jobs."""
        queue = self._job_queue
        return HealthResponse(
            jobs=queue.job_count,
            places=queue.workers + queue.max_waiting,
            takes_films=takes_films(),
        )

    async def preview(self, request: Request, job: JobName = None) -> Response:
        """Returns the preview of a photo, which the server keeps for the tiles."""
        return await self._run(request, job, self._preview)

    async def keep_photo(self, request: Request, job: JobName = None) -> Response:
        """Keeps a photo for the tiles."""
        return await self._run(
            request,
            job,
            lambda form, _job, _progress: Response(headers=self._open_photo(form)[1]),
        )

    async def related(self, request: Request) -> RelatedResponse:
        """Returns whether all photos of the form, which are thumbnails of one size, show one
        scene.
        """
        with self._quick_queue.reserve() as job:
            form = await read_form(request, self._model_cache.names, self._max_pixels)
            work = partial(_show_one_scene, form)
            return await self._quick_queue.run_job(job, work, request.receive)

    def tile(self, key: str, level: int, column: int, row: int) -> Response:
        """Returns a tile of a photo that the server keeps, by the key of its upload or its own."""
        photo = self._photos.get(key)
        photo = self._uploaded_photo(key) if photo is None else photo
        found = None if photo is None else photo_tile(photo, level, column, row)
        if found is None:
            raise HTTPException(
                404,
                "the server has dropped this photo, or the photo has no such tile; expected a tile "
                "of a kept photo; send the photo again",
            )
        return Response(found.encode("png"), media_type="image/png", headers=_TILE_HEADERS)

    def _uploaded_photo(self, key: str) -> Photo | None:
        """Returns the photo of an upload, or None if it is not kept."""
        upload = self._uploads.get(key)
        if upload is None:
            return None
        number = None if upload.is_video else len(upload.contents) // 2 + 1
        form = SeparationRequest(upload, Options(max_pixels=self._max_pixels, reference=number))
        with self._decoding:  # all tiles wait for one decoding
            return self._open_photo(form)[0]

    def _separate(
        self,
        form: SeparationRequest,
        job: SeparationJob,
        on_progress: ProgressCallback,
        *,
        as_json: bool,
    ) -> Response:
        options = form.options
        separator = self._model_cache.separator(options.model)
        call = options.call_options() | {"mask": form.mask, "hints": form.hints}
        fitted, notes = self._fitted(form, separator, job, on_progress)
        if fitted:
            separation = fitted.separate(partial(_after_fit, on_progress), **call)
        else:
            separation = separator(form.photo, on_progress=on_progress, **call)
        started = time.perf_counter()
        files = {}
        for layer in options.layers:
            on_progress(
                1
            )  # raises JobCancelled if the job is cancelled, because encoding also takes time
            name = form.target(layer, separation.photo.file_info.format_name)
            content = getattr(separation, layer).encode(SUFFIXES[Path(name).suffix.lower()].name)
            files[layer] = name, content
        record = separation.record
        record.seconds["encode"] = time.perf_counter() - started
        record.note = _note(form, separation.photo, notes)
        if as_json:
            layers = {
                layer: LayerFile.of(name, _media_type(name), content).model_dump()
                for layer, (name, content) in files.items()
            }
            body = {"result": record.as_dict(), "layers": layers}
            return JSONResponse(body, headers=headers_of(record))
        if len(files) == 1:
            ((name, content),) = files.values()
            media_type = _media_type(name)
        else:
            name = form.zip_name
            content = zip_images(files.values())
            media_type = "application/zip"
        headers = {"Content-Disposition": _content_disposition(name)} | headers_of(record)
        return Response(content, headers=headers, media_type=media_type)

    def _preview(
        self, form: SeparationRequest, job: SeparationJob, on_progress: ProgressCallback
    ) -> Response:
        separator = self._model_cache.separator(form.options.model)
        hints: Source | None = form.hints
        takes_hints = separator.takes_hints
        report = None
        fitted, notes = self._fitted(form, separator, job, on_progress)
        if fitted:
            separator = fitted.separator
            hints = fitted.hints
            report = fitted.report
            on_progress = partial(_after_fit, on_progress)
        photo, headers = self._open_photo(form)
        maps, assessment = preview(separator, photo, form.options, on_progress, hints)
        assessment = fitted.assessed(assessment) if fitted else assessment
        step = next_step(
            assessment.verdict,
            takes_hints=takes_hints and hints is None,
            where="see Marks",
            takes_films=takes_films(),
        )
        record = SeparationRecord(
            model=separator.name,
            model_sha256=separator.sha256,
            photo_sha256=form.photo_digest.hex(),
            device=separator.device,
            assessment=assessment,
            next_step=report.next_step if report else step,
            burst=report,
            note=_note(form, photo, notes),
        )
        head = {"result": record.as_dict(), "size": photo.size, "takes_hints": takes_hints}
        headers |= {"Brewster-Takes-Hints": "yes"} if takes_hints else {}
        headers |= headers_of(record)
        lines = json.dumps(head).encode(), b"\n", maps
        data = gzip.compress(b"".join(lines), _GZIP_LEVEL, mtime=0)
        return Response(data, headers=headers, media_type="application/gzip")

    def _fitted(
        self,
        form: SeparationRequest,
        separator: Separator,
        job: SeparationJob,
        on_progress: ProgressCallback,
    ) -> tuple[FittedBurst | None, tuple[str, ...]]:
        """Returns the measured layers of a burst, or of a photo with a film; None for a photo that
        is separated alone. The notes tell why a film was not used.
        """
        if form.burst:
            return self._fit_burst(form, separator, job, on_progress), ()
        if form.options.strength == 0:
            return None, ()
        if form.upload.film is None or form.options.film == FILM_NO:
            found = find_used_film(form.photo, form.options.film)
        else:
            found = FoundFilm(PhotoFilm.of_bytes(form.upload.film))
        return found.fitted(lambda film: self._fit_film(form, film, separator, job, on_progress))

    def _fit_film(
        self,
        form: SeparationRequest,
        film: PhotoFilm,
        separator: Separator,
        job: SeparationJob,
        on_progress: ProgressCallback,
    ) -> FittedBurst:
        """Keeps the last photos with their measured layers, as `_fit_burst` does."""
        from brewster.film.photo_film import fit_photo_film  # noqa: PLC0415  (imports numba)

        job.is_measuring = True
        photo, _ = self._open_photo(form)

        def fit() -> FittedBurst:
            return fit_photo_film(
                photo,
                film,
                separator=separator,
                hints=form.hints,
                max_pixels=form.options.max_pixels,
                on_progress=lambda done: on_progress(_FIT_SHARE * done),
                on_layers=job.on_layers,
            )

        digests = form.photo_digest, form.upload.film_digest, _digest(form.hints)
        key = digests, None, separator
        fitted = self._bursts.get_or_create(key, fit)
        return fitted.chosen(form.options.method, swap=form.options.swap)

    def _fit_burst(
        self,
        form: SeparationRequest,
        separator: Separator,
        job: SeparationJob,
        on_progress: ProgressCallback,
    ) -> FittedBurst:
        """Keeps the last bursts, so that a download or an exchange of the layers after a preview
        does not measure again.
        """
        from brewster.film import fit_burst  # noqa: PLC0415  (imports numba)

        job.is_measuring = True
        requested = form.options.method

        def fit(method: BurstMethod) -> FittedBurst:
            start = _VIDEO_SHARE if form.is_video else 0.0
            return fit_burst(
                _photos(form, lambda done: on_progress(_FIT_SHARE * start * done)),
                reference=form.options.reference_index,
                separator=separator,
                hints=form.hints,
                max_pixels=form.options.max_pixels,
                method=method,
                on_progress=lambda done: on_progress(_FIT_SHARE * (start + (1 - start) * done)),
                on_layers=job.on_layers,
            ).without_model()

        digests = *form.upload.digests, _digest(form.hints)
        measured: BurstMethod = "light" if requested == "light" else "auto"
        key = digests, form.options.reference_index, separator
        fitted = self._bursts.get_or_create((*key, measured), lambda: fit(measured))
        if requested == "motion" and fitted.is_by_light:
            fitted = self._bursts.get_or_create((*key, requested), lambda: fit(requested))
        self._photos.get_or_create(_photo_key(form), lambda: fitted.photo)
        return fitted.chosen(form.options.method, swap=form.options.swap)

    def _open_photo(self, form: SeparationRequest) -> tuple[Photo, dict[str, str]]:
        """Returns the decoded photo, and the headers with its key and its size. The photo is stored
        in the cache for the tiles.
        """

        def decode() -> Photo:
            if not form.is_video:
                return Photo.open(form.photo, max_pixels=form.options.max_pixels)
            from brewster.film.working_frames import (  # noqa: PLC0415  (imports numba)
                checked_reference,
            )

            photos = _photos(form)
            frame = checked_reference(len(photos), form.options.reference_index)
            return Photo.open(photos[frame])

        key = _photo_key(form)
        photo = self._photos.get_or_create(key, decode)
        return photo, {"Brewster-Photo": key, "Brewster-Size": "{}x{}".format(*photo.size)}


def takes_films() -> bool:
    """Whether the packages of the extra burst are installed; imports none of them."""
    return all(map(_is_installed, _FILM_PACKAGES))


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ValueError:  # OpenCV has no spec while another thread imports it
        return True


def _after_fit(on_progress: ProgressCallback, done: float) -> None:
    """Reports the progress of the work after the measurement of a burst."""
    on_progress(_FIT_SHARE + (1 - _FIT_SHARE) * done)


def _check_film(film: bytes, max_pixels: int, _on_progress: ProgressCallback) -> None:
    from brewster.film.video.decoding import (  # noqa: PLC0415  (imports numba)
        check_readable_film,
    )

    check_readable_film(film, max_pixels)


def _show_one_scene(form: SeparationRequest, on_progress: ProgressCallback) -> RelatedResponse:
    """Compares the thumbnails. Raises HTTPException 422 if there are fewer than two, or if they
    have several sizes.
    """
    if form.is_video or len(form.burst) < 2:
        raise HTTPException(
            422,
            "the form has no two photos to compare; expected thumbnails of one size; send "
            "two or more photos",
        )
    from brewster.film.video.choosing import show_one_scene  # noqa: PLC0415  (imports OpenCV)

    thumbnails = []
    for number, file in enumerate(form.burst, 1):
        photo = Photo.open(file, max_pixels=form.options.max_pixels)
        thumbnails.append(photo.srgb_8bit().mean(axis=2).astype(np.uint8))
        if thumbnails[-1].shape != thumbnails[0].shape:
            raise HTTPException(
                422,
                f"photo {number} has other sides than photo 1; expected thumbnails of one size; "
                "reduce all of them to the same width and height",
            )
        on_progress(number / len(form.burst))
    return RelatedResponse(are_related=show_one_scene(thumbnails))


def _photo_key(form: SeparationRequest) -> str:
    """Returns the name of the photo in the addresses of its tiles."""
    digest = form.photo_digest.hex()
    return f"{digest}-{form.options.reference_index}" if form.is_video else digest


def _digest(file: bytes | None) -> bytes | None:
    return None if file is None else hashlib.sha256(file).digest()


def _media_type(name: str) -> str:
    return SUFFIXES[Path(name).suffix.lower()].mime_type


def _photos(
    form: SeparationRequest, on_progress: ProgressCallback = lambda _fraction: None
) -> Sequence[Source]:
    """Returns the photos of a burst: those of the form, or frames of its video."""
    if not form.is_video:
        return form.burst
    from brewster.film import read_video  # noqa: PLC0415  (imports numba)

    return read_video(
        form.photo, DEFAULT_FRAMES, max_pixels=form.options.max_pixels, on_progress=on_progress
    )


def _note(form: SeparationRequest, photo: Photo, notes: Sequence[str]) -> str | None:
    """Returns what changed when the photo was read, and why its film was not used, or None."""
    misleading = () if form.is_video else misleading_suffix(Path(form.name), form.photo)
    return with_notes(photo.file_info, *misleading, *notes).note


def _content_disposition(name: str) -> str:
    """Returns the Content-Disposition header of a download: an ASCII name for old clients and the
    full name (RFC 6266).
    """
    ascii_name = name.encode("ascii", "replace").decode().translate(str.maketrans('"\\?', "___"))
    return f"attachment; filename=\"{ascii_name}\"; filename*=UTF-8''{quote(name, safe='')}"
