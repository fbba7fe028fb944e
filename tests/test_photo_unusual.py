"""Unusual metadata, channels, parts and headers of files of users."""

import io
from pathlib import Path

import numpy as np
import pytest
import pyvips
from PIL import Image

from brewster.errors import UnsupportedPhoto
from brewster.photo import Photo
from brewster.photo.blocks import tiff_tags
from brewster.photo.file_info import lost_metadata
from picture_files import P3, exr_of, file_of, pil, smooth, tiff_with

FIELD = Path(__file__).parent / "field_files"
CANON_NOTE = b"\x03\0\x06\0\x02\0\x0e\0\0\0\x24\x01\0\0" + bytes(40)
APPLE_NOTE = b"Apple iOS\0\0\1MM\0\1\0\1\0\t\0\0\0\1\0\0\0\7\0\0\0\0"


def exif_tags(exif):
    return tiff_tags.read_tags(exif)[34665]


def jpeg_with_maker_note(note):
    exif = Image.Exif()
    exif[271] = "Sextant"
    exif.get_ifd(34665)[37500] = note
    return file_of(smooth(), "JPEG", exif=exif)


@pytest.mark.parametrize(
    "source", [FIELD / "makernote-to-tiff.jpg", CANON_NOTE, b"SONY DSC \0\0\0"]
)
def test_a_maker_note_with_positions_in_its_file_is_not_moved_to_a_tiff_and_is_named(source):
    photo = Photo.open(source if isinstance(source, Path) else jpeg_with_maker_note(source))
    assert 37500 in exif_tags(photo.file_info.exif)
    assert "maker note" in lost_metadata(photo.file_info, "tiff")
    assert lost_metadata(photo.file_info, "jpeg") is None
    layer = photo.encode("tiff")
    assert 271 in tiff_tags.read_tags(layer)
    assert b"Canon\0" in layer or b"Sextant\0" in layer
    assert 37500 not in tiff_tags.read_tags(layer).get(34665, {})
    assert (
        exif_tags(Photo.open(photo.encode("jpeg")).file_info.exif)[37500]
        == exif_tags(photo.file_info.exif)[37500]
    )


def test_a_maker_note_with_its_own_positions_is_kept_in_a_tiff():
    photo = Photo.open(jpeg_with_maker_note(APPLE_NOTE))
    assert lost_metadata(photo.file_info, "tiff") is None
    assert exif_tags(photo.encode("tiff"))[37500][2] == APPLE_NOTE


def test_a_maker_note_of_a_tiff_is_dropped_with_a_note_unless_it_can_be_moved():
    for note, is_kept in ((CANON_NOTE, False), (APPLE_NOTE, True)):
        photo = Photo.open(jpeg_with_maker_note(APPLE_NOTE))
        tags = {34665: {37500: (7, len(note), note), 36864: (7, 4, b"0232")}}
        plain = Photo.from_array(photo.pixels).encode("tiff")
        opened = Photo.open(tiff_tags.with_tags(plain, tags))
        assert (37500 in exif_tags(opened.file_info.exif)) == is_kept
        assert ("maker note" in (opened.file_info.note or "")) != is_kept


@pytest.mark.parametrize("format_name", ["tiff", "png", "jpeg"])
def test_text_in_utf_8_is_kept(format_name):
    photo = Photo.open(FIELD / "exif3-utf8-to-tiff.jpg")
    layer = Photo.open(photo.encode(format_name)).file_info.exif
    tags = tiff_tags.read_tags(layer)
    entries = [
        tags.get(270),
        tags.get(315),
        *(tags[34665].get(tag) for tag in (42032, 42038, 42039)),
    ]
    assert all(entry and entry[0] == 129 for entry in entries)
    texts = [entry[2].rstrip(b"\0").decode() for entry in entries]
    title = "Fenster \u2014 \u7a93 f\u00fcr Stra\u00dfe"
    assert texts == [
        title,
        *["Zo\u00eb \u00c5ngstr\u00f6m"] * 2,
        title,
        "Zo\u00eb \u00c5ngstr\u00f6m",
    ]


def test_the_preview_of_an_exr_is_not_in_its_layers():
    OpenEXR = pytest.importorskip("OpenEXR")
    source = OpenEXR.File(str(FIELD / "preview-attribute.exr"))
    assert "preview" in source.parts[0].header
    photo = Photo.open(FIELD / "preview-attribute.exr")
    layer = OpenEXR.File(io.BytesIO(photo.encode()))
    assert "preview" not in layer.parts[0].header
    assert "screenWindowWidth" in layer.parts[0].header


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("channels", [2, 4])
def test_an_unspecified_channel_is_no_transparency_and_is_kept_in_a_tiff(kind, channels):
    tifffile = pytest.importorskip("tifffile")
    array = np.random.default_rng(0).integers(0, 200, (24, 40, channels)).astype(kind)
    array = array / np.float32(200) if kind is np.float32 else array
    photometric = "rgb" if channels == 4 else "minisblack"
    options = {"extrasamples": ["unspecified"], "photometric": photometric}
    options |= {"planarconfig": "contig"}
    photo = Photo.open(tiff_with(array, **options))
    assert photo.alpha is None
    assert np.array_equal(photo.pixels, array[..., :-1])
    with tifffile.TiffFile(io.BytesIO(photo.encode())) as file:
        page = file.pages[0]
        assert [int(sample) for sample in page.extrasamples] == [0]
        assert np.array_equal(page.asarray(), array)
    assert lost_metadata(photo.file_info, "tiff") is None
    assert "no transparency" in lost_metadata(photo.file_info, "png")
    assert Photo.open(photo.encode("png")).alpha is None


@pytest.mark.parametrize("kind", ["unassalpha", "assocalpha"])
def test_a_channel_of_transparency_is_alpha(kind):
    array = np.full((24, 40, 4), 255, np.uint8)
    photo = Photo.open(tiff_with(array, extrasamples=[kind]))
    assert photo.alpha is not None
    assert photo.file_info.extra_channel is None


def test_the_other_images_of_a_heic_are_counted():
    pytest.importorskip("pillow_heif")
    assert "2 other images" in Photo.open(FIELD / "three-images.heic").file_info.note
    single = Photo.from_array(smooth()).encode("heic")
    assert Photo.open(single).file_info.note is None


def test_the_other_images_of_an_avif_are_counted():
    pages = pyvips.Image.new_from_array(np.concatenate([smooth(64, 64)] * 3))
    pages.set_type(pyvips.GValue.gint_type, "page-height", 64)
    data = bytes(pages.heifsave_buffer(compression="av1"))
    assert "2 other images" in Photo.open(data).file_info.note
    assert Photo.open(Photo.from_array(smooth()).encode("avif")).file_info.note is None


def exr_with_parts(*parts):
    OpenEXR = pytest.importorskip("OpenEXR")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    file = io.BytesIO()
    made = [
        OpenEXR.Part(dict(header), {channel: PLANES[channel] for channel in channels}, name)
        for name, channels in parts
    ]
    OpenEXR.File(made).write(file)
    return file.getvalue()


PLANES = {
    name: np.random.default_rng(seed).random((24, 40)).astype(np.float32)
    for seed, name in enumerate("RGBAYZ")
}


@pytest.mark.parametrize("parts", [
    [("depth", "Z"), ("beauty", "RGB")],
    [("beauty", "RGB"), ("depth", "Z")],
    [("depth", "Z"), ("beauty", "RGB"), ("grey", "Y")],
])  # fmt: skip
def test_the_part_of_an_exr_with_colours_is_read_and_the_others_are_named(parts):
    photo = Photo.open(exr_with_parts(*parts))
    assert np.array_equal(photo.pixels, np.stack([PLANES[name] for name in "RGB"], axis=2))
    others = {name for name, _ in parts} - {"beauty"}
    assert all(name in photo.file_info.note for name in others)
    assert "beauty" not in photo.file_info.note
    layer = Photo.open(photo.encode())
    assert np.array_equal(layer.pixels, photo.pixels)
    assert layer.file_info.note is None


def test_an_exr_of_parts_without_colours_is_refused_with_their_channels():
    with pytest.raises(UnsupportedPhoto, match=r"2 parts .* Z; A"):
        Photo.open(exr_with_parts(("depth", "Z"), ("matte", "A")))
    assert Photo.open(exr_of({"Y": PLANES["Y"]})).size == (40, 24)


@pytest.mark.parametrize(("icc", "reason"), [(P3, "not for CMYK"), (None, "it has none")])
def test_the_note_on_cmyk_says_why_a_default_profile_is_used(icc, reason):
    data = file_of(Image.fromarray(smooth()).convert("CMYK"), "JPEG", icc_profile=icc)
    assert pil(data).mode == "CMYK"
    assert reason in Photo.open(data).file_info.note


@pytest.mark.parametrize("order", ["-Y 4 -X 8", "+Y 4 +X 8", "+X 8 -Y 4", "-X 8 +Y 4"])
def test_a_mirrored_or_rotated_radiance_image_is_named_as_such(order):
    data = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n{order}\n".encode() + bytes(128)
    with pytest.raises(UnsupportedPhoto, match="mirrored or rotated"):
        Photo.open(data)


def test_a_radiance_image_that_was_changed_as_text_is_named_as_such():
    data = b"#?RADIANCE\r\nFORMAT=32-bit_rle_rgbe\r\n\r\n-Y 4 +X 8\r\n" + bytes(128)
    with pytest.raises(UnsupportedPhoto, match="CR LF"):
        Photo.open(data)
