"""The metadata of a layer contain the program that created it, and its options. All other metadata
are unchanged.
"""

import io
import struct
import xml.etree.ElementTree as ET
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster import Photo, Separator
from brewster.base.image_formats import WRITABLE
from brewster.photo import FileInfo, metadata
from brewster.photo.blocks import tiff_tags
from brewster.photo.history import recorded_parameters, sampled_digest, with_history
from picture_files import exif_block, file_of, pil, png_chunk, smooth

SEPARATOR = Separator(lambda tile: (0.8 * tile, 0.2 * tile), name="a & <b>", sha256="f" * 64)
SOFTWARE = "brewster 1"
XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    b'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b"<rdf:Description rdf:about='uuid:1' xmlns:dc=\"http://purl.org/dc/elements/1.1/\" "
    b'dc:format="image/jpeg"/>'
    b"</rdf:RDF></x:xmpmeta>"
)
LI = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}li"
EVENT = "{http://ns.adobe.com/xap/1.0/sType/ResourceEvent#}"


def events(xmp):
    """The program and the parameters of each step in an XMP block, which must be valid XML."""
    found = ET.fromstring(xmp.decode()).iter(LI)
    return [
        (event.get(f"{EVENT}softwareAgent"), event.get(f"{EVENT}parameters")) for event in found
    ]


@pytest.mark.parametrize(
    "format_name", [name for name in WRITABLE if name not in ("heic", "exr", "hdr")]
)
def test_a_layer_records_the_program_and_the_options(format_name, tmp_path):
    photo = file_of(smooth(), "JPEG", exif=exif_block(1))
    separation = SEPARATOR(photo, strength=0.5, quality="draft")
    path = tmp_path / f"a.{WRITABLE[format_name].suffixes[0]}"
    path.write_bytes(separation.reflection.encode(format_name))
    assert recorded_parameters(path, "brewster") =={
        "layer": "reflection", "model": "a & <b>", "strength": "0.5", "quality": "draft",
        "additive": "no", "burst": "no", "hints": "no", "mask": "no", "sha256": "f" * 12,
        "photo": sampled_digest(io.BytesIO(photo)),
    }  # fmt: skip
    exif = pil(path.read_bytes()).getexif()
    assert exif[305].startswith("brewster ")
    # In a TIFF, a maker note of an unknown kind would lose its positions
    note = None if format_name == "tiff" else b"maker\0note\xff"
    assert (exif[271], exif.get_ifd(34665).get(37500)) == ("Sextant", note)
    assert recorded_parameters(path, "another program") is None


def test_the_history_of_a_photo_is_continued():
    once = with_history(FileInfo(xmp=XMP), SOFTWARE, {"strength": "1"})
    twice = with_history(once, SOFTWARE, {"strength": "0.5"})
    assert events(twice.xmp) == [(SOFTWARE, "strength=1"), (SOFTWARE, "strength=0.5")]
    assert twice.xmp.count(b"<xmpMM:History>") == 1
    thrice = with_history(twice, SOFTWARE, {"strength": "0.2"})
    assert [text for _, text in events(thrice.xmp)] == [
        "strength=1",
        "strength=0.5",
        "strength=0.2",
    ]
    assert (
        b"rdf:about='uuid:1' xmlns:xmpMM" in twice.xmp
    )  # all descriptions must be about the same resource
    assert XMP.removesuffix(b"</rdf:RDF></x:xmpmeta>") in twice.xmp
    new = with_history(FileInfo(), SOFTWARE, {"model": '"<&>'}).xmp
    assert events(new) == [(SOFTWARE, 'model="<&>')]
    assert b'xmp:CreatorTool="brewster 1"' in new


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_software_of_an_exif_block_is_replaced_and_no_offset_in_it_changes(order):
    mark = b"II*\0" if order == "<" else b"MM\0*"
    tags = ((271, 2, 4, b"abc\0"), (305, 2, 4, b"old\0"))
    rows = b"".join(struct.pack(f"{order}HHI4s", *tag) for tag in tags)
    block = mark + struct.pack(f"{order}IH", 8, 2) + rows + bytes(4) + b"the maker note"
    changed = with_history(FileInfo(exif=block), SOFTWARE, {}).exif
    assert changed[8 : len(block)] == block[8:]
    tags = tiff_tags.read_tags(changed)
    assert {tag: value[2] for tag, value in tags.items()} == {271: b"abc\0", 305: b"brewster 1\0"}
    assert with_history(FileInfo(exif=changed), SOFTWARE, {}).exif[8 : len(block)] == block[8:]


def test_an_exif_block_that_fills_a_jpeg_segment_is_kept():
    block = exif_block(1).removeprefix(b"Exif\0\0").ljust(65527, b"\0")
    assert with_history(FileInfo(exif=block), SOFTWARE, {}).exif == block


BYTE_ORDERS = st.sampled_from([b"II*\0", b"MM\0*", b""])


@given(st.binary(max_size=60), BYTE_ORDERS, st.integers(0, 70), st.binary(max_size=40))
def test_damaged_metadata_never_stop_a_separation(garbage, byte_order, offset, xmp):
    exif = byte_order + struct.pack("<I", offset) + garbage
    info = with_history(FileInfo(exif=exif, xmp=xmp), SOFTWARE, {})
    assert tiff_tags.orientation_of(info.exif) in range(1, 9)


def test_the_xmp_of_a_png_is_found_next_to_other_texts_and_where_other_programs_write_it(tmp_path):
    path = tmp_path / "a.png"
    data = SEPARATOR(file_of(smooth(), "PNG")).transmission.encode("png")
    xmp = dict(metadata.png_chunks(data))[b"iTXt"].removeprefix(b"XML:com.adobe.xmp" + bytes(5))

    def write(*before_pixels, after_pixels=b""):
        start = data.index(b"IDAT") - 4
        end = len(data) - 12
        header = data[: 8 + 12 + 13]
        path.write_bytes(
            b"".join((header, *before_pixels, data[start:end], after_pixels, data[end:]))
        )
        Photo.open(path)  # the file is a valid PNG
        return recorded_parameters(path, "brewster")

    comment = png_chunk(b"zTXt", b"Comment\0\0" + zlib.compress(b"a comment"))
    compressed = png_chunk(
        b"zTXt", b"XML:com.adobe.xmp" + bytes(2) + zlib.compress(xmp)
    )  # as libvips writes it
    uncompressed = png_chunk(b"iTXt", b"XML:com.adobe.xmp" + bytes(5) + xmp)
    compressed_itxt = png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\1" + bytes(3) + zlib.compress(xmp))
    path.write_bytes(data)
    expected = recorded_parameters(path, "brewster")
    assert expected["model"] == "a & <b>"
    assert write(comment) is None
    assert write(comment, compressed) == write(compressed, comment) == expected
    assert write(compressed_itxt) == write(compressed_itxt, comment) == expected
    assert write(uncompressed) == write(comment, after_pixels=uncompressed) == expected


def test_a_file_without_history_or_without_a_name_has_no_parameters(tmp_path):
    (tmp_path / "a.jpg").write_bytes(file_of(smooth(), "JPEG"))
    assert recorded_parameters(tmp_path / "a.jpg", "brewster") is None
    assert recorded_parameters(tmp_path / "missing.jpg", "brewster") is None


def test_the_digest_of_a_photo_changes_with_its_pixels_but_not_with_the_metadata_of_a_large_jpeg(
    rng,
):
    def digest(data):
        return sampled_digest(io.BytesIO(data))

    large = bytearray(rng.bytes(5_000_000))
    original = digest(large)
    assert digest(large[:2] + b"a caption" + large[2:]) == original
    for position in (len(large) - 1, len(large) - (1 << 21), len(large) - (1 << 22)):
        changed = bytearray(large)
        changed[position] ^= 1
        assert digest(changed) != original
    small = [digest(rng.bytes(size)) for size in (0, 1, 2, 100, 100, 1 << 16)]
    assert len(set(small)) == len(small)
    assert len(original) == 16
    assert digest(b"ab") != digest(b"b")
