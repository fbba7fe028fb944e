"""The HTTP API that separates photos.

    POST /separate                  a form with the photo, or a burst, and the options
    GET  /progress/{job}            the progress of a request
    POST /related                   whether thumbnails show one scene
    GET  /models                    the available models
    GET  /health                    the state of the server

Routes of the page:

    POST /preview                   maps from which the page computes the layers (see preview.py)
    POST /photo                     keeps a photo for its tiles
    GET  /tile/{key}/{level}/...    a tile of a kept photo
    GET  /progress/{job}/layers     the measured layers so far of a burst

The server fetches nothing by URL and writes nothing to the disk.
"""

from __future__ import annotations

import gzip
import hashlib
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, final
from urllib.parse import quote

import numpy as np
from fastapi import APIRouter, Query, Request
from numpy.typing import NDArray
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.responses import Response

import brewster
from brewster.base.cache import ByteLimitedCache
from brewster.base.image_formats import SUFFIXES
from brewster.errors import MissingExtra, PhotoError
from brewster.options import DEFAULT_FRAMES, BurstMethod
from brewster.photo import Photo, Source
from brewster.photo.file_info import with_notes
from brewster.photo.motion_photo import PhotoFilm
from brewster.photo.open_raster import zip_images
from brewster.photo.photo import misleading_suffix
from brewster.separation import Separator
from brewster.separation.assessment import Assessment, next_step
from brewster.separation.burst_report import BurstReport
from brewster.separation.predictor import ProgressCallback
from brewster.separation.used_film import FoundFilm, find_used_film, unused_note
from brewster.web.job_queue import JobProgress, JobQueue
from brewster.web.model_cache import ModelCache, ModelRow
from brewster.web.preview import photo_tile, preview
from brewster.web.request_schema import COMPARISON_SCHEMA, SeparationRequest, form_schema, read_form

if TYPE_CHECKING:
    from brewster.film.fitted_burst import FittedBurst

_GZIP_LEVEL: Final = 1  # higher levels save little more and take several times longer
_TILE_HEADERS: Final = {"Cache-Control": "private, max-age=3600"}
_MAX_CACHE_BYTES: Final = 400_000_000  # of the decoded photos of the last requests, for the tiles
_MAX_BURST_BYTES: Final = 200_000_000  # of the last measured bursts
_VIDEO_SHARE: Final = 0.1
"""Estimated time of reading a video divided by that of its measurement, for the progress."""
_FIT_SHARE: Final = 0.9
"""Estimated time of the measurement of a burst divided by that of its separation."""
_FILM_PACKAGES: Final = ("av", "cv2", "numba")


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


LayersCallback = Callable[[NDArray[np.float32]], None]
Handler = Callable[[SeparationRequest, LayersCallback, ProgressCallback], Response]
_ERROR: Final[dict[str, Any]] = {"model": ErrorResponse}
_RESPONSES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "One layer, or a zip of several layers.",
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
    model_cache: ModelCache, job_queue: JobQueue, *, max_pixels: int
) -> APIRouter:
    """Returns the routes of the API, and the previews and tiles for the page. Clients choose a
    model of `model_cache`.
    """
    router = APIRouter()
    routes = _SeparationRoutes(model_cache, job_queue, max_pixels)
    body, comparison = (
        {"requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}}
        for schema in (form_schema(model_cache.names), COMPARISON_SCHEMA)
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
    # only for the page
    router.post("/preview", include_in_schema=False)(routes.preview)
    router.post("/photo", include_in_schema=False)(routes.keep_photo)
    router.get("/tile/{key}/{level}/{column}/{row}", include_in_schema=False)(routes.tile)
    return router


@final
class _SeparationRoutes:
    """The handlers of the routes, the photos of the last previews, and the layers of the last
    bursts.
    """

    def __init__(self, model_cache: ModelCache, job_queue: JobQueue, max_pixels: int) -> None:
        self._model_cache = model_cache
        self._job_queue = job_queue
        self._max_pixels = max_pixels
        self._photos = ByteLimitedCache[Photo](_MAX_CACHE_BYTES, lambda photo: photo.pixels.nbytes)
        self._bursts: ByteLimitedCache[FittedBurst] = ByteLimitedCache(_MAX_BURST_BYTES)
        # Of their own, because the page asks before a separation, and jobs may take a minute.
        self._comparisons = JobQueue(
            max_waiting=job_queue.max_waiting, timeout_seconds=job_queue.timeout_seconds
        )

    async def _run(self, request: Request, job: str | None, handler: Handler) -> Response:
        with self._job_queue.reserve(job) as reserved_job:
            form = await read_form(request, self._model_cache.names, self._max_pixels)
            return await self._job_queue.run_job(
                reserved_job, partial(handler, form, reserved_job.on_layers), request.receive
            )

    async def separate(self, request: Request, job: JobName = None) -> Response:
        """Separates a photo, or a burst: several photos of one window. A single layer is returned
        as an image in the format and colour space of the photo, several layers as a zip.

        The names of the files are those of the command line. The separation stops if the client
        disconnects.
        """
        return await self._run(request, job, self._separate)

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
        return found

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
            lambda form, _layers, _progress: Response(headers=self._open_photo(form)[1]),
        )

    async def related(self, request: Request) -> RelatedResponse:
        """Returns whether all photos of the form, which are thumbnails of one size, show one
        scene.
        """
        with self._comparisons.reserve() as job:
            form = await read_form(request, self._model_cache.names, self._max_pixels)
            work = partial(_show_one_scene, form)
            return await self._comparisons.run_job(job, work, request.receive)

    def tile(self, key: str, level: int, column: int, row: int) -> Response:
        """Returns a tile of a photo that the server keeps."""
        photo = self._photos.get(key)
        found = None if photo is None else photo_tile(photo, level, column, row)
        if found is None:
            raise HTTPException(
                404,
                "the server has dropped this photo, or the photo has no such tile; expected a tile "
                "of a kept photo; send the photo again",
            )
        return Response(found.encode("png"), media_type="image/png", headers=_TILE_HEADERS)

    def _separate(
        self, form: SeparationRequest, on_layers: LayersCallback, on_progress: ProgressCallback
    ) -> Response:
        started = time.perf_counter()
        options = form.options
        separator = self._model_cache.separator(options.model)
        call = options.call_options()
        fitted, notes = self._fitted(form, separator, on_layers, on_progress)
        if fitted:
            call = {name: call[name] for name in ("strength", "quality", "additive")} | {
                "mask": form.mask
            }
            separation = fitted.separate(partial(_after_fit, on_progress), **call)
        else:
            call |= {"mask": form.mask, "hints": form.hints}
            separation = separator(form.photo, on_progress=on_progress, **call)
        files = {}
        for layer in options.layers:
            on_progress(
                1
            )  # raises JobCancelled if the job is cancelled, because encoding also takes time
            name = form.target(layer, separation.photo.file_info.format_name)
            files[name] = getattr(separation, layer).encode(
                SUFFIXES[Path(name).suffix.lower()].name
            )
        name, data = (
            next(iter(files.items()))
            if len(files) == 1
            else (form.zip_name, zip_images(files.items()))
        )
        headers = {
            "Content-Disposition": _content_disposition(name),
            "Brewster-Model": quote(separation.model),
            "Brewster-SHA256": separation.sha256 or "",
            "Brewster-Device": separation.device,
            "Brewster-Residual": f"{separation.residual:.6f}",
            "Brewster-Seconds": f"{time.perf_counter() - started:.4f}",
        }
        headers |= _result_headers(
            _note(form, separation.photo, notes),
            separation.assessment,
            separation.next_step,
            separation.burst,
        )
        if separation.reflection_is_derived:
            headers["Brewster-Reflection"] = "derived"
        if separation.reconstruction_error is not None:
            headers["Brewster-Reconstruction-Error"] = f"{separation.reconstruction_error:.6f}"
        media_type = (
            SUFFIXES[Path(name).suffix.lower()].mime_type if len(files) == 1 else "application/zip"
        )
        return Response(data, headers=headers, media_type=media_type)

    def _preview(
        self, form: SeparationRequest, on_layers: LayersCallback, on_progress: ProgressCallback
    ) -> Response:
        separator = self._model_cache.separator(form.options.model)
        hints: Source | None = form.hints
        takes_hints = separator.takes_hints
        report = None
        fitted, notes = self._fitted(form, separator, on_layers, on_progress)
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
        headers |= {"Brewster-Takes-Hints": "yes"} if takes_hints else {}
        headers |= _result_headers(
            _note(form, photo, notes),
            assessment,
            report.next_step if report else step,
            report,
        )
        data = gzip.compress(maps, _GZIP_LEVEL, mtime=0)
        return Response(data, headers=headers, media_type="application/gzip")

    def _fitted(
        self,
        form: SeparationRequest,
        separator: Separator,
        on_layers: LayersCallback,
        on_progress: ProgressCallback,
    ) -> tuple[FittedBurst | None, tuple[str, ...]]:
        """Returns the measured layers of a burst, or of a photo with a film; None for a photo that
        is separated alone. The notes tell why a film was not used.
        """
        if form.burst:
            return self._fit_burst(form, separator, on_layers, on_progress), ()
        if form.options.strength == 0:
            return None, ()
        is_sent = isinstance(form.film, bytes)
        found = (
            FoundFilm(PhotoFilm.of_bytes(form.film))
            if isinstance(form.film, bytes)
            else find_used_film(form.photo, form.film)
        )
        if found.film is None:
            return None, found.notes
        try:
            fitted = self._fit_film(form, found.film, separator, on_layers, on_progress)
        except (MissingExtra, PhotoError) as error:
            if is_sent:
                raise
            return None, (*found.notes, unused_note(found.film, error))
        return fitted, found.notes

    def _fit_film(
        self,
        form: SeparationRequest,
        film: PhotoFilm,
        separator: Separator,
        on_layers: LayersCallback,
        on_progress: ProgressCallback,
    ) -> FittedBurst:
        """Keeps the last photos with their measured layers, as `_fit_burst` does."""
        from brewster.film.photo_film import fit_photo_film  # noqa: PLC0415  (imports numba)

        photo, _ = self._open_photo(form)

        def fit() -> FittedBurst:
            return fit_photo_film(
                photo,
                film,
                separator=separator,
                hints=form.hints,
                max_pixels=form.options.max_pixels,
                on_progress=lambda done: on_progress(_FIT_SHARE * done),
                on_layers=on_layers,
            )

        files = form.photo, film.content or b"", form.hints or b""
        key = tuple(hashlib.sha256(file).digest() for file in files), None, separator
        fitted = self._bursts.get_or_create(key, fit)
        return fitted.chosen(form.burst_options.method, swap=form.burst_options.swap)

    def _fit_burst(
        self,
        form: SeparationRequest,
        separator: Separator,
        on_layers: LayersCallback,
        on_progress: ProgressCallback,
    ) -> FittedBurst:
        """Keeps the last bursts, so that a download or an exchange of the layers after a preview
        does not measure again.
        """
        from brewster.film import fit_burst  # noqa: PLC0415  (imports numba)

        requested = form.burst_options.method

        def fit(method: BurstMethod) -> FittedBurst:
            start = _VIDEO_SHARE if form.is_video else 0.0
            return fit_burst(
                _photos(form, lambda done: on_progress(_FIT_SHARE * start * done)),
                reference=form.burst_options.reference_index,
                separator=separator,
                hints=form.hints,
                max_pixels=form.options.max_pixels,
                method=method,
                on_progress=lambda done: on_progress(_FIT_SHARE * (start + (1 - start) * done)),
                on_layers=on_layers,
            )

        digests = tuple(hashlib.sha256(file).digest() for file in (*form.burst, form.hints or b""))
        measured: BurstMethod = "light" if requested == "light" else "auto"
        key = digests, form.burst_options.reference_index, separator
        fitted = self._bursts.get_or_create((*key, measured), lambda: fit(measured))
        if requested == "motion" and fitted.is_by_light:
            fitted = self._bursts.get_or_create((*key, requested), lambda: fit(requested))
        self._photos.get_or_create(_photo_key(form), lambda: fitted.photo)
        return fitted.chosen(form.burst_options.method, swap=form.burst_options.swap)

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
            frame = checked_reference(len(photos), form.burst_options.reference_index)
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
    from brewster.film.film import show_one_scene  # noqa: PLC0415  (imports OpenCV)

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
    frame = f"frame {form.burst_options.reference_index}".encode() if form.is_video else b""
    return hashlib.sha256(form.photo + frame).hexdigest()


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


def _result_headers(
    note: str | None,
    assessment: Assessment,
    next_step: str | None,
    report: BurstReport | None,
) -> dict[str, str]:
    headers: dict[str, str] = {"Brewster-Verdict": assessment.verdict}
    if note:
        headers["Brewster-Note"] = quote(note)
    if next_step:
        headers["Brewster-Next-Step"] = next_step
    if report:
        headers |= {
            "Brewster-Burst": report.method,
            "Brewster-Burst-Message": report.message,
            "Brewster-Burst-Measured": "yes" if report.is_measured else "no",
            "Brewster-Burst-Doubtful": f"{report.doubtful_area:.4f}",
            "Brewster-Burst-Names": "certain" if report.are_names_certain else "unsure",
        }
    if report and report.film:
        headers |= {
            "Brewster-Film": report.film.layout,
            "Brewster-Film-Seconds": f"{report.film.seconds:.1f}",
        }
    return headers


def _content_disposition(name: str) -> str:
    """Returns the Content-Disposition header of a download: an ASCII name for old clients and the
    full name (RFC 6266).
    """
    ascii_name = name.encode("ascii", "replace").decode().translate(str.maketrans('"\\?', "___"))
    return f"attachment; filename=\"{ascii_name}\"; filename*=UTF-8''{quote(name, safe='')}"
