"""What a client asks for: one multipart form, checked by `Options`, whose fields are written nowhere else."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from brewster.files import LAYERS, SeparationPaths
from brewster.image_formats import SUFFIXES
from brewster.options import Options

FIELDS: Final = ("layers", "strength", "quality", "format", "additive", "model")
"""The options that a client may choose; the others are the server's own."""
_OPTIONS: Final = TypeAdapter(Options)
_LONGEST_NAME: Final = 120
_PHOTO: Final = {
    "type": "string",
    "contentMediaType": "application/octet-stream",
    "description": "The file of the photo.",
}


@final
@dataclass(frozen=True)
class SeparationRequest:
    """A photo's file, and what to do with it."""

    photo: bytes
    name: str
    """The photo's name, safe to write to and never a path."""
    options: Options

    def target(self, layer: str, own: str) -> str:
        """The name of a layer's file as the command line gives it, for a photo whose own container is `own`."""
        source = Path(self.name)
        if source.suffix.lower() not in SUFFIXES:
            source = Path(f"{self.name}.{own}")
        return (
            SeparationPaths(source, Path(), source.stem)
            .target(layer, self.options.suffix(layer, source))
            .name
        )


async def read_form(request: Request, models: Sequence[str], max_pixels: int) -> SeparationRequest:
    """What a request asks for; its bytes stay in memory.

    Raises:
        HTTPException: 415, 400, 422: no form, a broken one, or values that are none of ours.
        BrewsterError: values that do not go together.
        ClientDisconnect: the upload was cut off.
    """
    if not request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
        raise HTTPException(415, "the photo is sent as multipart/form-data; its field is called photo")
    try:
        form = await _InMemoryParser(request.headers, request.stream(), max_fields=32, max_files=1).parse()
    except MultiPartException as error:
        raise HTTPException(
            400, f"the form cannot be read ({error.message.rstrip('.')}); send it again"
        ) from error
    except ValueError as error:  # Python knows charsets that it cannot read text by
        raise HTTPException(400, "the form's charset cannot be read; send it in UTF-8") from error
    try:
        return await _asked(form, _options(form, models, max_pixels))
    finally:
        await form.close()


async def _asked(form: FormData, options: Options) -> SeparationRequest:
    photo = form.get("photo")
    if not isinstance(photo, UploadFile):
        raise HTTPException(422, "there is no photo; send its file in the field photo")
    return SeparationRequest(await photo.read(), safe_name(photo.filename or ""), options)


@final
class _InMemoryParser(MultiPartParser):
    """Files stay in memory, whatever their size: the guard has limited it."""

    spool_max_size = 0


def form_schema(models: Sequence[str]) -> dict[str, Any]:
    """The JSON schema of the form, for OpenAPI."""
    known = _OPTIONS.json_schema()["properties"]
    fields = {"photo": _PHOTO, **{name: _as_field(known[name]) for name in FIELDS}}
    about = "The model to use, one of `GET /models`."
    fields["model"] = known["model"] | {"default": models[0], "enum": list(models), "description": about}
    return {"type": "object", "required": ["photo"], "properties": fields}


def _as_field(schema: dict[str, Any]) -> dict[str, Any]:
    """A form has no null: what may be null may be left out."""
    if "anyOf" not in schema:
        return schema
    (kind,) = (kind for kind in schema["anyOf"] if kind["type"] != "null")
    return {"description": schema["description"], **kind}


def safe_name(name: str) -> str:
    """The last part of a client's name for a file, as every disk and header takes it: no path, no control letters."""
    last = unicodedata.normalize("NFC", re.split(r"[/\\]", name)[-1])
    plain = "".join(letter if letter.isprintable() and letter not in '<>:"|?*' else "_" for letter in last)
    path = Path(plain.strip(". ") or "photo")
    suffix = path.suffix if path.suffix.lower() in SUFFIXES else ""
    stem = path.name.removesuffix(suffix).encode()[:_LONGEST_NAME].decode(errors="ignore")
    return stem.rstrip(". ") + suffix


def explain(errors: Iterable[Any]) -> str:
    """What pydantic found wrong, in one sentence."""
    found = (
        f"{'.'.join(map(str, error['loc']))} is {str(error['input'])[:40]!r}; {error['msg']}"
        for error in errors
    )
    return "; ".join(found)


def _options(form: FormData, models: Sequence[str], max_pixels: int) -> Options:
    words = {name: [str(value) for value in form.getlist(name)] for name in form if name != "photo"}
    unknown = [name for name in words if name not in FIELDS]
    if unknown:
        raise HTTPException(
            422, f"there is no field {unknown[0][:40]!r}; the fields are photo, {', '.join(FIELDS)}"
        )
    asked: dict[str, Any] = {name: values[-1] for name, values in words.items() if values[-1]}
    if "layers" in words:
        asked["layers"] = _in_order(",".join(words["layers"]).split(","))
    if asked.setdefault("model", models[0]) not in models:
        raise HTTPException(422, f"there is no model {asked['model'][:40]!r}; choose {' or '.join(models)}")
    try:
        return _OPTIONS.validate_python(asked | {"max_pixels": max_pixels})
    except ValidationError as error:
        raise HTTPException(422, explain(error.errors())) from error


def _in_order(layers: Sequence[str]) -> list[str]:
    """Each once, in the order of the command line; unknown ones last, to be refused."""
    return [layer for layer in dict.fromkeys((*LAYERS, *layers)) if layer in layers]
