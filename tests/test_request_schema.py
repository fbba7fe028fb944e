"""The form of a request: its fields, errors, schema and file names."""

import asyncio
import re
import unicodedata
from pathlib import Path, PurePosixPath, PureWindowsPath

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from starlette.exceptions import HTTPException
from starlette.requests import Request

from brewster.base.files import OUTPUT_LAYERS
from brewster.batch.layer_names import name_layers
from brewster.cli.separate import separate as separate_command
from brewster.errors import BrewsterError
from brewster.options import Options, field_schemas
from brewster.web.request_schema import FIELDS, SeparationRequest, form_schema, read_form, safe_name
from brewster.web.uploads import Upload

MODELS = ("compact", "mine")
HEAD = b'--x\r\nContent-Disposition: form-data; name="%b"%b\r\n\r\n'


def body(*parts):
    """The body of a form with parts (name, value) or (name, value, file name)."""
    rows = [
        HEAD % (name.encode(), b'; filename="%b"' % more[0].encode() if more else b"")
        + value
        + b"\r\n"
        for name, value, *more in parts
    ]
    return b"".join([*rows, b"--x--\r\n"])


def read(data, kind=b"multipart/form-data; boundary=x", cut=False):
    messages = [
        {"type": "http.request", "body": data, "more_body": cut},
        {"type": "http.disconnect"},
    ]

    async def receive():
        return messages.pop(0)

    request = Request(
        {"type": "http", "method": "POST", "headers": [(b"content-type", kind)]}, receive
    )
    return asyncio.run(read_form(request, MODELS, 1000))


def parse(**fields):
    return read(
        body(
            ("photo", b"bytes", "a.jpg"),
            *((name, value.encode()) for name, value in fields.items()),
        )
    )


def refused(data, **kwargs):
    with pytest.raises(HTTPException) as error:
        read(data, **kwargs)
    return error.value.status_code, error.value.detail


@pytest.mark.parametrize("charset", [b"undefined", b"punycode"])
def test_an_unusable_charset_is_a_damaged_form(charset):
    status, message = refused(
        body(("photo", b"", "a.jpg"), ("strength", b"\xff-1")),
        kind=b"multipart/form-data; boundary=x; charset=" + charset,
    )
    assert status == 400
    assert "UTF-8" in message


def test_a_photo_alone_or_with_empty_fields_gets_the_default_options():
    for request in (parse(), parse(format="", strength="", model="", layers="")):
        assert (request.photo, request.name) == (b"bytes", "a.jpg")
        assert request.options == Options(max_pixels=1000, reference=1)


def test_every_client_option_is_read():
    texts = {"quality": "draft", "format": "tiff", "model": "mine"}
    request = parse(**texts, strength="0.5", additive="true", layers="reflection")
    values = {"strength": 0.5, "additive": True, "layers": ("reflection",), "max_pixels": 1000}
    values["reference"] = 1  # of the photos that were sent
    assert request.options == Options(**texts, **values)


@pytest.mark.parametrize(
    ("text", "name"),
    [("jpg", "jpeg"), ("JPG", "jpeg"), (".jpe", "jpeg"), ("tif", "tiff"), ("heif", "heic")],
)
def test_a_format_may_be_named_by_its_suffix_as_on_the_command_line(text, name):
    assert parse(format=text).options.format == name
    option = next(option for option in separate_command.params if option.name == "format")
    assert option.type.convert(text, option, None) == name


@pytest.mark.parametrize(("fields", "part"), [
    ({"strength": "nan"}, "strength is 'nan'; expected a finite number; correct strength"),
    ({"layers": "transmission,glass"}, "layers is 'glass'"),
    ({"additive": "perhaps"}, "additive is 'perhaps'"),
    ({"model": "../../etc/passwd"}, "choose compact or mine"),
    ({"device": "cuda"}, "there is no field 'device'"),
    ({"max_pixels": "1"}, "there is no field 'max_pixels'"),
    ({"quality": "x" * 500}, "'" + "x" * 40 + "'"),
])  # fmt: skip
def test_a_wrong_value_is_named_in_the_message(fields, part):
    data = body(
        ("photo", b"bytes", "a.jpg"), *((name, value.encode()) for name, value in fields.items())
    )
    status, message = refused(data)
    assert status == 422
    assert part in message
    assert len(message) < 300
    assert re.fullmatch(r"[^;]+; (expected|choose) [^;]+; [^;]+", message), message
    assert "Input should" not in message


def test_contradicting_options_raise_the_error_of_options():
    with pytest.raises(BrewsterError, match="only these store 32-bit floats"):
        parse(additive="true", format="png")


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (body(("strength", b"1")), 422),
        (body(("photo", b"one", "a.jpg"), ("photo", b"not a file")), 422),
        (body(("photo", b"one", "a.jpg"), ("mask", b"1", "m.png"), ("mask", b"2", "n.png")), 400),
        (body(*[("photo", b"", "a.jpg")] * 90), 400),
        (body(("photo", b"", "a.jpg"), *[("strength", b"1")] * 40), 400),
        (body(("photo", b"", "a.jpg"), ("model", b"x" * 2_000_000)), 400),
        (b"", 422),
        (b"--x\r\nContent-Disposition: form-data\r\n\r\n\r\n--x--", 400),
        (b"no form at all", 400),
    ],
)
def test_an_invalid_form_is_refused(data, status):
    assert refused(data)[0] == status


@pytest.mark.parametrize(
    "kind", [b"application/json", b"", b"multipart/form-data", b"multipart/form-data; boundary="]
)
def test_a_body_that_is_not_a_form_is_refused(kind):
    assert refused(body(("photo", b"", "a.jpg")), kind=kind)[0] in (400, 415)


def test_several_photos_are_a_burst_and_the_layers_are_named_after_the_reference_photo():
    photos = [("photo", name.encode(), f"{name}.jpg") for name in "abc"]
    request = read(body(*photos, ("strength", b"0.5")))
    assert (request.burst, request.options.reference_index) == ((b"a", b"b", b"c"), 1)
    assert (request.photo, request.name, request.options.strength) == (b"b", "b.jpg", 0.5)
    request = read(body(*photos, ("reference", b"3"), ("mask", b"mask", "m.png")))
    assert (request.photo, request.mask) == (b"c", b"mask")
    assert request.target("reflection", "jpeg") == "c.reflection.jpg"
    assert parse().burst == ()


@pytest.mark.parametrize("number", ["0", "3", "-1", "1.5", "²", "9" * 5000, "first"])
def test_the_reference_is_the_number_of_a_photo(number):
    status, message = refused(
        body(("photo", b"", "a.jpg"), ("photo", b"", "b.jpg"), ("reference", number.encode()))
    )
    assert status == 422
    assert message.startswith("reference is ")


def test_the_schema_has_the_descriptions_and_limits_of_options():
    fields = form_schema(MODELS)["properties"]
    assert set(fields) == {
        *("photo", "film", "mask", "hints"),
        *FIELDS,
    }
    assert (fields["strength"]["minimum"], fields["strength"]["maximum"]) == (0, 1)
    assert fields["model"]["enum"] == ["compact", "mine"]
    about = field_schemas(Options)
    for name in set(FIELDS) - {"model"}:
        assert fields[name]["description"] == about[name]["description"]


@given(name=st.text())
def test_a_safe_name_is_never_a_path_and_fits_every_file_system(name):
    safe = safe_name(name)
    assert safe.strip(". ")
    assert not {unicodedata.category(letter) for letter in safe} & {"Cc", "Cs", "Zl", "Zp"}
    assert not set(safe) & set('/\\<>:"|?*')
    assert PurePosixPath(safe).name == PureWindowsPath(safe).name == safe
    assert (
        len(
            SeparationRequest(Upload((safe,), (b"",)), Options())
            .target("transmission", "jpeg")
            .encode()
        )
        <= 255
    )
    assert safe_name(safe) == safe


ODD_LETTERS = st.characters(categories=("L", "M", "N", "Zs"), include_characters="-_()'%;=,.~#")


@given(
    stem=st.text(
        ODD_LETTERS | st.sampled_from(". \N{NO-BREAK SPACE}\N{ZERO WIDTH JOINER}"), max_size=50
    ),
    suffix=st.sampled_from(["", ".jpg", ".JPG", ".jpg_large", ".tif", ".gif", ".dng"]),
    layer=st.sampled_from(OUTPUT_LAYERS),
)
def test_layers_have_the_same_names_as_in_a_batch(stem, suffix, layer):
    name = f"{stem}{suffix}"
    assume(name.strip(". "))
    options = Options((layer,))
    ((_, targets),) = name_layers([(Path("in", name), Path("out"))], options)
    assert (
        SeparationRequest(Upload((safe_name(name),), (b"",)), options).target(layer, "png")
        == targets[layer].name
    )


@pytest.mark.parametrize(("name", "safe"), [
    ("../../etc/passwd", "passwd"), (("a\r\nSet-Cookie: "
                                     "x.jpg"), "a__Set-Cookie_ x.jpg"), ("", "photo"),
    ("folder/", "photo"), ("x" * 1000 + ".JPG", "x" * 237 + ".JPG"),
])  # fmt: skip
def test_unsafe_names_are_replaced(name, safe):
    assert safe_name(name) == safe
