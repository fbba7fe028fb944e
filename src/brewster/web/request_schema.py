"""The multipart form of a request. `Options` defines and validates its fields."""

import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from brewster.base.files import OUTPUT_LAYERS, SeparationPaths
from brewster.base.image_formats import (
    FORMATS,
    canonical_format,
    format_of,
)
from brewster.errors import invalid_value
from brewster.options import (
    FILM_AUTO,
    FILM_NO,
    MAX_BURST_PHOTOS,
    MAX_LIGHT_PHOTOS,
    Options,
    field_schemas,
)
from brewster.web.uploads import Upload

FIELDS: Final = (
    "reference",
    "method",
    "swap",
    "layers",
    "strength",
    "quality",
    "format",
    "additive",
    "model",
)
"""The options that a client may set as text. The server sets the other options."""
_FILES: Final = ("photo", "mask", "hints")
_KEY: Final = re.compile("[0-9a-f]{64}")
"""The key of an upload, see `Upload.key`."""
_MAX_FILES: Final = 64
"""Larger than the number of photos of a burst, which `brewster.film` checks with a better message.
"""
_OPTIONS: Final = TypeAdapter(Options)
_FILM: Final = "film"
"""A file, or a text: the path that the command line also accepts would be one of the server."""
_FILM_CHOICES: Final = (FILM_AUTO, FILM_NO)
_REQUEST_PARTS: Final = ("query", "path", "body")
_MAX_NAME_BYTES: Final = 255 - len(".transmission.jpeg")
"""Maximum length of a name without its suffix. The names of all layers then fit into the 255 bytes
of usual file systems.
"""
_DIRECTION_MARKS: Final = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
"""The classes of characters that change the direction of text (Unicode annex 9). They can hide the
real suffix of a name.
"""
_PHOTO_SCHEMA: Final = {
    "type": "string",
    "contentMediaType": "application/octet-stream",
    "description": "The photo as an image file.",
}
_PHOTOS_SCHEMA: Final = {
    "type": "array",
    "items": _PHOTO_SCHEMA,
    "minItems": 1,
    "maxItems": MAX_LIGHT_PHOTOS,
    "description": f"The photo, or a burst: 2 to {MAX_BURST_PHOTOS} photos of one window in the "
    f"order in which they were taken (up to {MAX_LIGHT_PHOTOS} for the method light), or a video "
    "of it.",
}

_FILM_SCHEMA: Final = {"type": "string", "contentMediaType": "application/octet-stream"}
UPLOAD_SCHEMA: Final = {
    "type": "object",
    "required": ["photo"],
    "properties": {
        "photo": _PHOTOS_SCHEMA,
        _FILM: _FILM_SCHEMA
        | {"description": "The film that a phone recorded around the photo, as a file."},
    },
}
"""The JSON schema of the form of `POST /photos`."""
COMPARISON_SCHEMA: Final = {
    "type": "object",
    "required": ["photo"],
    "properties": {
        "photo": _PHOTOS_SCHEMA
        | {
            "minItems": 2,
            "description": f"2 to {MAX_BURST_PHOTOS} thumbnails of one size, in the order in which "
            "their photos were taken.",
        }
    },
}
"""The JSON schema of the form of `POST /related`."""


@final
@dataclass(frozen=True)
class SeparationRequest:
    """The upload with the photo, the burst or the film, and the options."""

    upload: Upload
    options: Options
    """Its mask and its hints are those below; a film that was sent is in the upload."""
    mask: bytes | None = None
    hints: bytes | None = None

    @property
    def is_video(self) -> bool:
        """Whether the upload is a film."""
        return self.upload.is_video

    @property
    def _index(self) -> int:
        """The index of the file to separate: the reference photo of a burst, or the film."""
        return 0 if self.is_video else (self.options.reference or 1) - 1

    @property
    def photo(self) -> bytes:
        """The photo to separate: the reference photo of a burst, or the film."""
        return self.upload.contents[self._index]

    @property
    def name(self) -> str:
        """The file name of the photo."""
        return self.upload.names[self._index]

    @property
    def burst(self) -> tuple[bytes, ...]:
        """All photos of a burst, in the order of the form; the film; or empty for a single
        photo.
        """
        files = self.upload.contents
        return files if self.is_video or len(files) > 1 else ()

    @property
    def photo_digest(self) -> bytes:
        """The SHA-256 of the photo."""
        return self.upload.digests[self._index]

    def target(self, layer: str, format_name: str) -> str:
        """Returns the file name of a layer, the same as on the command line. `format_name` is the
        format of the photo.
        """
        paths = SeparationPaths(Path(self.name), Path(), FORMATS[format_name])
        return paths.target(layer, self.options.suffix(layer, paths.suffix)).name

    @property
    def zip_name(self) -> str:
        """The file name of a zip of several layers."""
        return f"{SeparationPaths(Path(self.name), Path()).stem}.zip"


async def read_form(
    request: Request,
    models: Sequence[str],
    max_pixels: int,
    find_upload: Callable[[str], Upload | None] = lambda _key: None,
) -> SeparationRequest:
    """Parses and validates the form of a request, in memory.

    Args:
        request: its form has the photos as files, or the key of an earlier upload.
        models: the names of the models, the default first.
        max_pixels: the maximum number of pixels of each photo.
        find_upload: returns the upload with this key, or None if it is not kept.

    Raises:
        HTTPException: with status 415, the body is not a form; 400: the form is damaged; 404: there
            is no upload with this key; 422: a field or a value is invalid.
        BrewsterError: two options contradict each other.
        ClientDisconnect: the upload is incomplete.
    """
    form = await _parsed(request)
    try:
        return await _build_request(form, _options(form, models, max_pixels), find_upload)
    finally:
        await form.close()


async def read_upload(request: Request) -> Upload:
    """Parses a form that has only files, as `read_form` does."""
    form = await _parsed(request)
    try:
        unknown = [name for name in form if name not in ("photo", _FILM)]
        if unknown:
            raise HTTPException(
                422,
                f"there is no field {unknown[0][:40]!r}; expected photo and {_FILM}; send options "
                "with the request that uses the photo",
            )
        return await _upload(form)
    finally:
        await form.close()


async def _parsed(request: Request) -> FormData:
    if not request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
        raise HTTPException(
            415,
            "the body is not a form; expected multipart/form-data; send the photo in the field "
            "photo of such a form",
        )
    try:
        return await _InMemoryParser(
            request.headers, request.stream(), max_fields=32, max_files=_MAX_FILES
        ).parse()
    except MultiPartException as error:
        raise HTTPException(
            400,
            f"the form cannot be read ({error.message.rstrip('.')}); expected a complete form; "
            "send it again",
        ) from error
    except ValueError as error:  # Python knows the charset, but cannot decode text with it
        raise HTTPException(
            400, "the charset of the form cannot be decoded; expected UTF-8; send the form in UTF-8"
        ) from error


async def _build_request(
    form: FormData, options: Options, find_upload: Callable[[str], Upload | None]
) -> SeparationRequest:
    for name in _FILES[1:]:
        if len(form.getlist(name)) > 1:
            raise HTTPException(
                400, f"the form contains several files {name}; expected one; send only one file"
            )
    painted: dict[str, Any] = {}
    for name in _FILES[1:]:
        file = form.get(name)
        if file is not None and not isinstance(file, UploadFile):
            raise HTTPException(
                422,
                f"the field {name} contains no file; expected an image file; send the {name} as "
                "a file",
            )
        painted[name] = await file.read() if file else None
    keys = form.getlist("photo")
    if len(keys) == 1 and isinstance(keys[0], str) and _KEY.fullmatch(keys[0]):
        upload = find_upload(keys[0])
        if upload is None:
            raise HTTPException(
                404,
                "the server does not keep a photo with this key, or no longer; expected the key of "
                "a recent POST /photos; send the photo again",
            )
    else:
        upload = await _upload(form)
    if not upload.is_video:
        count = len(upload.contents)
        number = options.reference or count // 2 + 1
        if number > count:
            raise HTTPException(
                422,
                f"reference is {number}; expected the number of a photo, 1 to {count}; correct "
                "reference",
            )
        options = replace(options, reference=number)
    return SeparationRequest(upload, options, **painted)


async def _upload(form: FormData) -> Upload:
    """Returns the files of a form: its photos, and the film of a photo."""
    photos = [photo for photo in form.getlist("photo") if isinstance(photo, UploadFile)]
    if any(form.getlist("photo")) and not photos:
        raise HTTPException(
            422,
            "the field photo is a text that is no key; expected an image file, or the key of a "
            "POST /photos (64 digits, 0 to f); send a file (with curl -F photo=@FILE)",
        )
    if not photos or len(photos) < len(form.getlist("photo")):
        raise HTTPException(
            422, "the form contains no photo; expected an image file; send it in the field photo"
        )
    sent = form.getlist(_FILM)
    if len(sent) > 1:
        raise HTTPException(
            400, f"the form contains {len(sent)} films; expected one; send only one film"
        )
    names = tuple(safe_name(photo.filename or "") for photo in photos)
    contents = [await photo.read() for photo in photos]
    films = [film for film in sent if isinstance(film, UploadFile)]
    upload = Upload(names, tuple(contents), await films[0].read() if films else None)
    if upload.is_video and len(photos) > 1:
        raise HTTPException(
            422,
            f"the form contains a video among {len(photos)} files; expected one video, or "
            "photos; send the video alone",
        )
    return upload


def _film_choice(form: FormData) -> str:
    """Returns the choice of a film, which is `auto` if the film is sent."""
    film = form.get(_FILM, FILM_AUTO)
    if isinstance(film, UploadFile):
        return FILM_AUTO
    if film not in _FILM_CHOICES:
        raise HTTPException(
            422,
            f"film is {film[:40]!r}; expected a file, or one of {', '.join(_FILM_CHOICES)}; send "
            "the film as a file",
        )
    return film


@final
class _InMemoryParser(MultiPartParser):
    """Stores files of any size in memory. AccessMiddleware limits their size."""

    spool_max_size = 0


def form_schema(models: Sequence[str]) -> dict[str, Any]:
    """Returns the JSON schema of the form, for the OpenAPI document."""
    known = field_schemas(Options)
    painted = {
        name: {**_PHOTO_SCHEMA, "description": known[name]["description"]} for name in _FILES[1:]
    }
    fields = {
        "photo": {
            "oneOf": [
                _PHOTOS_SCHEMA,
                {
                    "type": "string",
                    "pattern": f"^{_KEY.pattern}$",
                    "description": "The key of an earlier `POST /photos`.",
                },
            ]
        },
        **painted,
        _FILM: {
            "anyOf": [
                {"type": "string", "enum": [*_FILM_CHOICES]},
                _FILM_SCHEMA,
            ],
            "description": "The film that a phone recorded around the photo: auto uses the one in "
            "the file of the photo, no does not; or the film as a file, as of a Live Photo.",
        },
        **{name: dict(known[name]) for name in FIELDS},
    }
    for name in FIELDS:
        if "anyOf" in known[name]:  # a form has no null: an optional field is left out instead
            (not_null,) = (choice for choice in known[name]["anyOf"] if choice["type"] != "null")
            fields[name] = {"description": known[name]["description"], **not_null}
    description = "The model to use, one of `GET /models`."
    fields["model"] |= {"default": models[0], "enum": list(models), "description": description}
    return {"type": "object", "required": ["photo"], "properties": fields}


def safe_name(name: str) -> str:
    """Returns the last component of a file name, with at most `_MAX_NAME_BYTES` bytes before the
    suffix.

    The name stays unchanged wherever possible, because the command line names the layers after the
    unchanged name. Only characters that Windows forbids, control characters and marks that change
    the direction of text are replaced by underscores.
    """
    plain = "".join(
        "_"
        if unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp")
        or letter in '<>:"|?*'
        or unicodedata.bidirectional(letter) in _DIRECTION_MARKS
        else letter
        for letter in re.split(r"[/\\]", name)[-1]
    )
    path = Path(plain if plain.strip(". ") else "photo")
    suffix = path.suffix if format_of(path) else ""
    return (
        path.name.removesuffix(suffix).encode()[:_MAX_NAME_BYTES].decode(errors="ignore") + suffix
    )


def validation_message(errors: Iterable[Any]) -> str:
    """Returns the validation errors of pydantic as one message, with three parts for each error.

    The location of a value has the names that the client has sent: `job` for `("query", "job")`,
    without the index in a list.
    """
    messages = []
    for error in errors:
        names = tuple(part for part in error["loc"] if isinstance(part, str))
        sent = names[1:] if len(names) > 1 and names[0] in _REQUEST_PARTS else names
        messages.append(str(invalid_value({**error, "loc": sent})))
    return " ".join(messages)


def _options(form: FormData, models: Sequence[str], max_pixels: int) -> Options:
    texts = {
        name: [str(value) for value in form.getlist(name)]
        for name in form
        if name not in (*_FILES, _FILM)
    }
    unknown = [name for name in texts if name not in FIELDS]
    if unknown:
        raise HTTPException(
            422,
            f"there is no field {unknown[0][:40]!r}; expected "
            f"{', '.join((*_FILES, _FILM, *FIELDS))}; correct the name",
        )
    values_by_name: dict[str, Any] = {
        name: values[-1] for name, values in texts.items() if values[-1]
    }
    if "format" in values_by_name:
        values_by_name["format"] = canonical_format(values_by_name["format"])
    if "layers" in values_by_name:
        # Each layer once, in the order of the command line. Unknown names come last, and the
        # validation refuses them.
        layers = ",".join(texts["layers"]).split(",")
        values_by_name["layers"] = [
            layer for layer in dict.fromkeys((*OUTPUT_LAYERS, *layers)) if layer in layers
        ]
    if values_by_name.setdefault("model", models[0]) not in models:
        raise HTTPException(
            422,
            f"there is no model {values_by_name['model'][:40]!r}; expected a model of this server; "
            f"choose {' or '.join(models)}",
        )
    try:
        return _OPTIONS.validate_python(
            values_by_name | {"film": _film_choice(form), "max_pixels": max_pixels}
        )
    except ValidationError as error:
        raise HTTPException(422, validation_message(error.errors())) from error
