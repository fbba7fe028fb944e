"""What layers keep of the metadata of a photo, by the table of formats, and what they no longer
promise.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile

from brewster import Photo
from brewster.base.image_formats import WRITABLE
from brewster.photo import FileInfo, metadata
from brewster.photo.blocks import tiff_tags
from brewster.photo.blocks.xmp import guid_of
from brewster.photo.file_info import lost_metadata
from brewster.photo.history import recorded_parameters, with_layer_history
from picture_files import exif_block, file_of, pil, smooth, tiff_with

needs_exiftool = pytest.mark.skipif(
    not shutil.which("exiftool"), reason="exiftool is not installed"
)
HEADER = b"http://ns.adobe.com/xap/1.0/\0"
EXTENSION_HEADER = b"http://ns.adobe.com/xmp/extension/\0"
RDF = 'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
GOOGLE = "http://ns.google.com/photos/1.0"


def layer_of(data: bytes) -> Photo:
    return with_layer_history(Photo.open(data), "transmission", {"photo": "0" * 16})


def packet(properties: str = "", elements: str = "") -> bytes:
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta '
        f'xmlns:x="adobe:ns:meta/"><rdf:RDF {RDF}>'
        '<rdf:Description rdf:about="" '
        f"{properties}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>"
        '<?xpacket end="w"?>'
    ).encode()


ADOBE = "http://ns.adobe.com"
RATED = f'xmlns:xmp="{ADOBE}/xap/1.0/" xmp:Rating="5" xmlns:crs="{ADOBE}/camera-raw-settings/1.0/"'


def with_segments(jpeg: bytes, *segments: tuple[int, bytes]) -> bytes:
    head = b"".join(
        struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body for marker, body in segments
    )
    return jpeg[:2] + head + jpeg[2:]


def exiftool(path: Path, *arguments: str) -> dict[str, object]:
    """Writes tags, and returns those of the file."""
    if arguments:
        subprocess.run(["exiftool", "-q", "-overwrite_original", *arguments, path], check=True)
    read = ["exiftool", "-j", "-G1", "-struct", "-a", path]
    return json.loads(subprocess.run(read, check=True, capture_output=True).stdout)[0]


WRITTEN = {
    "exif": {
        "IFD0:Artist": "A. Person",
        "IFD0:Rating": 4,
        "IFD0:XPTitle": "Titel é",
        "ExifIFD:LensModel": "L50",
        "GPS:GPSLatitudeRef": "North",
    },
    "xmp": {
        "XMP-xmp:Rating": 4,
        "XMP-dc:Subject": ["glass", "window"],
        "XMP-dc:Creator": ["A. Person"],
    },
    "iptc": {
        "IPTC:Keywords": [f"keyword{number}" for number in range(12)],
        "IPTC:CopyrightNotice": "(c) A. Person",
        "Photoshop:URL": "https://example.org/1",
    },
    "texts": {
        "jpeg": {"File:Comment": "a comment"},
        "png": {"PNG:Copyright": "A. Person", "PNG:Comment": "seed 7"},
    },
}


@needs_exiftool
@pytest.mark.parametrize("format_name", [name for name, row in WRITABLE.items() if row.keeps])
def test_a_layer_keeps_what_the_table_of_formats_says(format_name, tmp_path):
    if format_name == "heic":
        pytest.importorskip("pillow_heif")
    path, layer = (tmp_path / f"{name}{WRITABLE[format_name].suffixes[0]}" for name in "ab")
    path.write_bytes(Photo.from_array(smooth(), encoding="srgb").encode(format_name))
    blocks = {name: tags for name, tags in WRITTEN.items() if name in WRITABLE[format_name].keeps}
    blocks["texts"] = blocks.get("texts", {}).get(format_name, {})
    expected = {tag: value for tags in blocks.values() for tag, value in tags.items()}
    lists = {tag: value if isinstance(value, list) else [value] for tag, value in expected.items()}
    source = exiftool(path, *(f"-{tag}={one}" for tag, values in lists.items() for one in values))
    assert expected.items() <= source.items()
    layer.write_bytes(layer_of(path.read_bytes()).encode())
    assert expected.items() <= exiftool(layer).items()
    validity = subprocess.run(
        ["exiftool", "-validate", "-error", "-warning", layer], check=True, capture_output=True
    )
    assert b"Error" not in validity.stdout


@pytest.mark.parametrize("format_name", WRITABLE)
def test_what_a_format_cannot_keep_is_named(format_name):
    info = FileInfo("png", exif=b"1", xmp=b"1", iptc=b"1", texts=(b"1",))
    note = lost_metadata(info, format_name) or ""
    names = {"exif": "EXIF", "xmp": "XMP", "iptc": "IPTC", "texts": "texts"}
    for field, name in names.items():
        is_kept = field in WRITABLE[format_name].keeps and (
            field != "texts" or format_name == "png"
        )
        assert (name in note) is not is_kept


# --- IPTC

IPTC = b"".join(
    b"\x1c\2" + struct.pack(">BH", number, len(text)) + text
    for number, text in [*((25, b"keyword%d" % i) for i in range(12)), (116, b"(c) A. Person")]
)


@pytest.mark.parametrize("byte_order", "<>")
@pytest.mark.parametrize(("kind", "integers"), [(1, ""), (2, ""), (4, "<u4"), (4, ">u4"), (7, "")])
@pytest.mark.parametrize("is_big", [False, True])
def test_the_iptc_of_a_tiff_is_kept_whole_whatever_its_type(kind, integers, byte_order, is_big):
    """Some programs write integers in the order of the other kind of machine."""
    padded = IPTC + bytes(-len(IPTC) % 4)
    value = np.frombuffer(padded, integers).tolist() if integers else padded
    count = len(padded) // (4 if kind == 4 else 1)
    data = tiff_with(smooth(), (33723, kind, count, value), byteorder=byte_order, bigtiff=is_big)
    written = tifffile.TiffFile(io.BytesIO(Photo.open(data).encode())).pages[0].tags[33723]
    assert written.dtype == 7
    assert written.value == IPTC


def resource(number: int, content: bytes) -> bytes:
    return (
        b"8BIM" + struct.pack(">HHI", number, 0, len(content)) + content + bytes(len(content) % 2)
    )


@pytest.mark.parametrize("thumbnail", [1033, 1036])  # of Photoshop 4, and of later versions
def test_the_iptc_of_a_jpeg_is_kept_in_a_jpeg_and_a_tiff_without_the_thumbnail_of_the_input(
    thumbnail,
):
    resources = resource(1028, IPTC) + resource(1034, b"\1") + resource(thumbnail, b"a thumbnail")
    photo = Photo.open(
        with_segments(file_of(smooth(), "JPEG"), (0xED, b"Photoshop 3.0\0" + resources))
    )
    kept = resource(1028, IPTC) + resource(1034, b"\1")
    assert metadata.jpeg_image_resources(photo.encode()) == kept
    tags = tiff_tags.read_tags(photo.encode("tiff"))
    assert tags[33723] == (7, len(IPTC), IPTC)
    assert tags[34377][2] == resource(1034, b"\1")
    again = Photo.open(photo.encode("tiff")).encode("jpeg")
    assert resource(1028, IPTC) in metadata.jpeg_image_resources(again)


def test_image_resources_larger_than_a_segment_are_kept():
    resources = resource(1028, IPTC) + resource(2000, bytes(150_000))
    jpeg = Photo(smooth(), None, FileInfo("jpeg", iptc=resources)).encode()
    assert Photo.open(jpeg).file_info.iptc == resources


# --- XMP

LARGE_XMP = {
    "just fits": packet(f'{RATED} crs:Note="{"A" * 65_000}"'),
    "one large property": packet(f'{RATED} crs:Note="{"A" * 300_000}"'),
    "many properties": packet(
        RATED, "".join(f"<crs:N{i}>{'A' * 500}</crs:N{i}>" for i in range(2000))
    ),
}


@pytest.mark.parametrize("xmp", LARGE_XMP.values(), ids=LARGE_XMP)
@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff", "webp", "avif"])
def test_large_xmp_is_kept_and_the_history_is_found(xmp, format_name, tmp_path):
    photo = Photo(smooth(), None, FileInfo(format_name, xmp=xmp))
    path = tmp_path / "a"
    path.write_bytes(with_layer_history(photo, "transmission", {"photo": "0" * 16}).encode())
    assert recorded_parameters(path, "brewster") == {"layer": "transmission", "photo": "0" * 16}
    kept = Photo.open(path).file_info
    assert kept.note is None
    for part in (b'xmp:Rating="5"', b"A" * 500):
        assert kept.xmp.count(part) == xmp.count(part)
    assert b"HasExtendedXMP" not in kept.xmp


@needs_exiftool
def test_exiftool_reads_the_large_xmp_of_a_jpeg(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(
        layer_of(
            Photo(smooth(), None, FileInfo("jpeg", xmp=LARGE_XMP["many properties"])).encode()
        ).encode()
    )
    found = exiftool(path)
    assert found["XMP-xmp:Rating"] == 5
    assert sum(name.startswith("XMP-crs:N") for name in found) == 2000
    assert found["XMP-xmpMM:History"][0]["Parameters"] == f"layer=transmission; photo={'0' * 16}"


def extended(extension: bytes, parts: int = 1, guid: str | None = None) -> bytes:
    guid = guid or guid_of(extension)
    main = packet(
        f'{RATED} xmlns:xmpNote="http://ns.adobe.com/xmp/note/" '
        f'xmpNote:HasExtendedXMP="{guid_of(extension)}"'
    )
    size = -(-len(extension) // parts)
    segments = []
    for at in range(0, len(extension), size):
        head = EXTENSION_HEADER + guid.encode() + struct.pack(">II", len(extension), at)
        segments.insert(0, (0xE1, head + extension[at : at + size]))
    return with_segments(file_of(smooth(), "JPEG"), (0xE1, HEADER + main), *segments)


@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff"])
def test_extended_xmp_is_merged_into_the_main_packet(format_name):
    extension = packet('xmlns:GDepth="http://ns.google.com/photos/1.0/depthmap/" GDepth:Note="far"')
    assert guid_of(extension) == hashlib.md5(extension).hexdigest().upper()
    kept = Photo.open(layer_of(extended(extension, parts=3)).encode(format_name)).file_info.xmp
    assert b'GDepth:Note="far"' in kept
    assert b'xmp:Rating="5"' in kept
    assert b"HasExtendedXMP" not in kept


@pytest.mark.parametrize("source", [extended(packet("a"), guid="0" * 32), extended(b"<damaged")])
def test_a_pointer_to_extended_xmp_that_is_missing_or_damaged_is_removed_with_a_note(source):
    info = Photo.open(source).file_info
    assert b"HasExtendedXMP" not in info.xmp
    assert b'xmp:Rating="5"' in info.xmp
    assert "extended XMP" in info.note


@pytest.mark.parametrize("xmp", [b"not xmp", b"<x:xmpmeta", packet().replace(b"RDF", b"RFD")])
def test_a_damaged_packet_does_not_prevent_the_history(xmp, tmp_path):
    source = with_segments(file_of(smooth(), "JPEG"), (0xE1, HEADER + xmp))
    assert "XMP, which is damaged" in Photo.open(source).file_info.note
    (tmp_path / "a.jpg").write_bytes(layer_of(source).encode())
    assert recorded_parameters(tmp_path / "a.jpg", "brewster")["photo"] == "0" * 16


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_xmp_of_another_encoding_is_kept_as_utf_8(encoding):
    xmp = packet(RATED).decode().replace('"5"', '"5" xmp:Label="é"').encode(encoding)
    source = with_segments(file_of(smooth(), "JPEG"), (0xE1, HEADER + xmp))
    kept = layer_of(source).file_info.xmp
    assert 'xmp:Label="é"'.encode() in kept
    assert b"xmpMM:History" in kept


def test_a_packet_with_entities_is_not_expanded():
    bomb = b"<!DOCTYPE a [<!ENTITY b 'bbbb'>]>" + packet(
        f'xmlns:G="{GOOGLE}/camera/" G:MotionPhoto="1" G:Note="&b;"'
    )
    info = Photo.open(with_segments(file_of(smooth(), "JPEG"), (0xE1, HEADER + bomb))).file_info
    assert info.xmp is None
    assert "damaged" in info.note


# --- promises

ITEMS = (
    '<Container:Directory><rdf:Seq><rdf:li rdf:parseType="Resource"><Container:Item '
    'Item:Semantic="Primary"/></rdf:li>'
    '<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="{}" '
    'Item:Length="9"/></rdf:li></rdf:Seq>'
    "</Container:Directory>"
)
CONTAINER = f'xmlns:Container="{GOOGLE}/container/" xmlns:Item="{GOOGLE}/container/item/"'
CAMERA = f'xmlns:GCamera="{GOOGLE}/camera/"'
GAIN_MAP = 'xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0"'
APPLE_MAP = 'xmlns:H="http://ns.apple.com/HDRGainMap/1.0/" H:HDRGainMapVersion="1"'
THUMBNAIL = f"<xmp:Thumbnails><rdf:Alt><rdf:li>{'A' * 100}</rdf:li></rdf:Alt></xmp:Thumbnails>"
PROMISES = {
    "film, attributes": ("film", f'{CAMERA} GCamera:MotionPhoto="1" GCamera:MicroVideoOffset="9"'),
    "film, elements": ("film", CAMERA, "<GCamera:MicroVideo>1</GCamera:MicroVideo>"),
    "film, container": ("film", CONTAINER, ITEMS.format("MotionPhoto")),
    "gain map": ("gain map", f"{CONTAINER} {GAIN_MAP}", ITEMS.format("GainMap")),
    "gain map of Apple": ("gain map", APPLE_MAP),
    "depth": ("Depth", CONTAINER, ITEMS.format("Depth")),
    "no film": (None, f'{CAMERA} GCamera:MotionPhoto="0"'),
    "thumbnail": (None, "", THUMBNAIL),
}
PROMISE = re.compile(
    rb"MotionPhoto|MicroVideo|hdrgm|HDRGainMap|Container|Item:|GainMap|Depth|Thumbnails|AAAA"
)


@pytest.mark.parametrize("promise", PROMISES.values(), ids=PROMISES)
@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff", "webp", "avif"])
def test_xmp_promises_nothing_that_a_layer_does_not_have(promise, format_name):
    lost, properties, *elements = promise
    xmp = packet(f"{RATED} {properties}", *elements)
    photo = Photo.open(Photo(smooth(), None, FileInfo(format_name, xmp=xmp)).encode())
    assert b'xmp:Rating="5"' in photo.file_info.xmp
    assert not PROMISE.search(photo.file_info.xmp)
    assert (lost is None) == (photo.file_info.note is None)
    assert (lost or "") in (photo.file_info.note or "")


@pytest.mark.parametrize(
    ("mark", "lost"),
    [(b"urn:iso:std:iso:ts:21496:-1\0", "gain map"), (b"MotionPhoto_Data", "film")],
)
def test_parts_that_only_the_file_names_are_noted(mark, lost):
    assert lost in Photo.open(file_of(smooth(), "JPEG") + mark).file_info.note


# --- the size and the thumbnail in EXIF


@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff", "webp", "avif"])
@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize("is_long", [True, False])
def test_the_size_in_exif_and_xmp_is_that_of_the_layer(format_name, orientation, is_long):
    kind, size_format = (4, "I") if is_long else (3, "H")
    sizes = {
        tag: (kind, 1, struct.pack(f"<{size_format}", side))
        for tag, side in ((40962, 64), (40963, 48))
    }
    tags = {271: (2, 4, b"Cam\0"), 274: (3, 1, struct.pack("<H", orientation)), 34665: sizes}
    body, first = tiff_tags._serialised_directory(tags, 8)
    exif = b"Exif\0\0II*\0" + struct.pack("<I", first) + body
    xmp = packet(
        'xmlns:exif="http://ns.adobe.com/exif/1.0/" exif:PixelXDimension="64" '
        'exif:PixelYDimension="48"'
    )
    options = {"exif": exif} | ({"xmp": xmp} if format_name in ("jpeg", "webp") else {})
    source = Photo.open(file_of(smooth(), format_name.upper(), **options))
    if "xmp" in options:
        assert b'exif:PixelXDimension="%d"' % source.size[0] in source.file_info.xmp
    layer = layer_of(source.encode()).encode()
    found = pil(layer).getexif().get_ifd(34665)
    assert (found[40962], found[40963]) == pil(layer).size == source.size
    assert source.size == ((48, 64) if orientation == 6 else (64, 48))


# --- comments and texts


def test_the_comments_of_a_jpeg_and_the_texts_of_a_png_are_kept():
    jpeg = with_segments(file_of(smooth(), "JPEG"), (0xFE, b"first"), (0xFE, b"second"))
    written = Photo.open(jpeg).encode()
    assert [segment[4:] for segment in metadata.jpeg_comments(written)] == [b"first", b"second"]
    from PIL.PngImagePlugin import PngInfo  # noqa: PLC0415

    texts = PngInfo()
    texts.add_text("Copyright", "A. Person")
    texts.add_text("parameters", "steps: 20", zip=True)
    texts.add_itxt("Title", "Glas é", "de", "Titel")
    source = file_of(smooth(), "PNG", pnginfo=texts)
    assert pil(layer_of(source).encode()).text.items() >= pil(source).text.items()
    assert Photo.open(Photo.open(source).encode("jpeg")).file_info.texts == ()


# --- TIFF


@pytest.mark.parametrize("byte_order", "<>")
@pytest.mark.parametrize("compression", [None, "deflate"])
def test_a_bigtiff_keeps_its_camera_tags_and_its_compression(byte_order, compression):
    tags = (271, 2, 0, "Maker"), (315, 2, 0, "A. Person"), (18246, 3, 1, 4), (274, 3, 1, 6)
    data = tiff_with(smooth(), *tags, bigtiff=True, byteorder=byte_order, compression=compression)
    photo = Photo.open(data)
    written = pil(photo.encode())
    assert written.size == photo.size == (48, 64)
    assert [written.getexif()[tag] for tag in (271, 315, 18246, 274)] == [
        "Maker",
        "A. Person",
        4,
        1,
    ]
    assert (
        written.info["compression"] == {None: "raw", "deflate": "tiff_adobe_deflate"}[compression]
    )


def test_private_tags_of_a_tiff_are_kept_and_those_of_its_pixels_are_not():
    tags = (33550, 12, 3, (1.0, 1.0, 0.0)), (269, 2, 0, "a document"), (50839, 1, 4, b"abcd")
    data = tiff_with(smooth(), *tags, tile=(16, 16))
    written = tifffile.TiffFile(io.BytesIO(layer_of(data).encode())).pages[0].tags
    assert (written[33550].value, written[269].value) == ((1.0, 1.0, 0.0), "a document")
    assert 322 not in written


def test_exif_of_a_jpeg_is_kept_in_a_tiff_without_tags_of_its_pixels():
    exif = pil(file_of(smooth(), "JPEG", exif=exif_block())).getexif()
    exif[256] = 5
    exif[18246] = 4
    exif[40091] = "Titel".encode("utf-16-le")
    written = pil(Photo.open(file_of(smooth(), "JPEG", exif=exif)).encode("tiff"))
    assert written.size == (48, 64)
    assert written.getexif()[256] == 48
    assert (written.getexif()[18246], written.getexif()[271]) == (4, "Sextant")
