"""Colours that a file describes without an ICC profile have the same appearance in the layers, or
are refused.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageCms

from brewster.errors import MaskError, UnsupportedPhoto
from brewster.photo import Hints, Photo
from brewster.photo.colour.description import build_profile
from brewster.photo.colour.spaces import REC709_CHROMATICITIES
from brewster.photo.srgb import to_linear
from picture_files import P3, exr_of, file_of, pil, png_with, smooth, tiff_with

P3_PRIMARIES = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"/>'
SWAPPED = (0.30, 0.60, 0.64, 0.33, 0.15, 0.06, 0.3127, 0.3290)  # red and green are exchanged


def gama(value):
    return b"gAMA", struct.pack(">I", value)


def chrm(primaries):
    return b"cHRM", struct.pack(
        ">8I", *(round(100_000 * value) for value in (*primaries[6:], *primaries[:6]))
    )


def iccp(profile):
    return b"iCCP", b"name\0\0" + zlib.compress(profile)


SRGB_CHUNK = b"sRGB", b"\0"
GREY = smooth()[..., 0]


@pytest.mark.parametrize(
    "array", [smooth(), GREY, (GREY.astype(np.uint16) << 8) + 99], ids=["RGB", "grey", "16 bits"]
)
@pytest.mark.parametrize("value", [100_000, 55_556, 38_462, 20_000])
def test_the_light_of_a_png_with_gama_is_a_power_of_its_values(value, array):
    photo = Photo.open(png_with(gama(value), array=array))
    white = np.iinfo(array.dtype).max
    expected = (array.reshape(48, 64, -1) / white) ** (100_000 / value)
    assert np.abs(photo.linear() - expected).max() < 2e-4
    assert np.array_equal(Photo.open(photo.encode()).linear(), photo.linear())
    assert np.array_equal(photo.with_linear(photo.linear()).pixels, photo.pixels)
    if photo.pixels.shape[2] == 3:
        as_tiff, as_jpeg = (Photo.open(photo.encode(name)) for name in ("tiff", "jpeg"))
        assert np.array_equal(as_tiff.linear(), photo.linear())
        assert as_jpeg.file_info.icc == photo.file_info.icc


def shown_by_littlecms(image, **options):
    profile = ImageCms.ImageCmsProfile(io.BytesIO(image.info["icc_profile"]))
    return np.asarray(
        ImageCms.profileToProfile(image, profile, ImageCms.createProfile("sRGB"), **options), int
    )


def test_littlecms_computes_the_same_colours_with_the_profile():
    photo = Photo.open(png_with(gama(55_556), chrm(P3_PRIMARIES)))
    assert np.abs(shown_by_littlecms(pil(photo.encode())) - photo.srgb_8bit()).max() <= 1
    grey = shown_by_littlecms(
        pil(Photo.open(png_with(gama(100_000), array=GREY)).encode()), outputMode="RGB"
    )
    assert (
        np.abs(to_linear(grey[..., 0] / 255) - GREY / 255).max() < 0.01
    )  # its grid is coarse in the dark


CICP_SRGB = (b"cICP", bytes((1, 13, 0, 1)))


@pytest.mark.parametrize("chunks", [
    [gama(45_455)], [gama(0)], [gama(45_455), chrm(REC709_CHROMATICITIES)], [chrm([0] * 8)],
    [SRGB_CHUNK, gama(100_000), chrm(SWAPPED)], [CICP_SRGB, gama(100_000)], [CICP_SRGB, iccp(P3)],
    [(b"sBIT", b"\5\6\5")], [(b"mDCV", bytes(24)), (b"cLLI", bytes(8))],
], ids=str)  # fmt: skip
def test_descriptions_of_srgb_and_those_that_a_better_one_replaces_change_nothing(chunks):
    photo = Photo.open(png_with(*chunks))
    assert photo.file_info.icc is None
    assert np.array_equal(photo.pixels, smooth())


def test_chrm_sets_the_primaries_unless_there_is_a_profile():
    assert Photo.open(png_with(iccp(P3), gama(100_000), chrm(SWAPPED))).file_info.icc == P3
    photo = Photo.open(png_with(gama(45_455), chrm(SWAPPED)))
    assert np.abs(photo.srgb_8bit().astype(int) - smooth()[..., [1, 0, 2]]).max() <= 1
    display_p3 = Photo.open(png_with(chrm(P3_PRIMARIES)))
    expected = Photo.open(file_of(smooth(), "PNG", icc_profile=P3))
    assert np.abs(display_p3.linear() - expected.linear()).max() < 2e-3


@pytest.mark.parametrize(("chunks", "message"), [
    ([(b"cICP", bytes((9, 16, 0, 1))), iccp(P3)], "primaries 9 and the transfer function 16"),
    ([(b"cICP", bytes((1, 13, 0, 0)))], "narrow range"),
    ([(b"cICP", bytes((1, 13, 1, 1)))], "matrix 1"), ([gama(1)], "gAMA with the value 1"),
    ([gama(2**31 - 1)], "gAMA with the value"),
])  # fmt: skip
def test_descriptions_that_are_not_supported_are_refused_by_name(chunks, message):
    with pytest.raises(UnsupportedPhoto, match=message):
        Photo.open(png_with(*chunks))


def fractions(values):
    return [part for value in values for part in (round(10_000 * value), 10_000)]


def test_the_chromaticities_and_the_transfer_function_of_a_tiff_are_used():
    primaries = (319, 5, 6, fractions(SWAPPED[:6])), (318, 5, 2, fractions(SWAPPED[6:]))
    linear = np.arange(256) * 257
    photo = Photo.open(tiff_with(smooth(), *primaries, (301, 3, 256, linear.tolist())))
    assert np.abs(photo.linear() - smooth()[..., [1, 0, 2]] / 255).max() < 1e-3
    three = [*linear, *(linear // 2), *linear]
    halved = Photo.open(tiff_with(smooth(), (301, 3, 768, [int(value) for value in three])))
    assert np.abs(halved.linear() - smooth() / 255 * (1, 0.5, 1)).max() < 1e-3
    default = Photo.open(tiff_with(smooth(), *primaries))
    assert np.abs(default.linear() - (smooth()[..., [1, 0, 2]] / 255) ** 2.2).max() < 1e-3
    grey = Photo.open(tiff_with(GREY, (301, 3, 256, linear.tolist())))
    assert np.abs(grey.linear()[..., 0] - GREY / 255).max() < 1e-3
    with pytest.raises(UnsupportedPhoto, match="TransferFunction of 100 values"):
        Photo.open(tiff_with(smooth(), (301, 3, 100, [0] * 100)))


@pytest.mark.parametrize("primaries", [None, P3_PRIMARIES])
def test_a_profile_with_the_curve_of_srgb_equals_srgb(primaries):
    from brewster.photo.colour.description import _SRGB_CURVE, _parametric  # noqa: PLC0415

    profile = build_profile(primaries, [_parametric(*_SRGB_CURVE)], is_grey=False)
    expected = file_of(smooth(), "PNG", icc_profile=P3) if primaries else file_of(smooth(), "PNG")
    found = Photo.open(file_of(smooth(), "PNG", icc_profile=profile)).linear()
    assert np.abs(found - Photo.open(expected).linear()).max() < 2e-3


# --- premultiplied alpha


def test_the_colours_of_an_exr_are_divided_by_alpha_and_multiplied_when_written():
    straight = np.random.default_rng(0).random((8, 9, 3)).astype(np.float32)
    alpha = np.linspace(0, 1, 72, dtype=np.float32).reshape(8, 9)
    stored = straight * np.where(alpha > 0, alpha, 1)[..., None]
    photo = Photo.open(
        exr_of({name: stored[..., i] for i, name in enumerate("RGB")} | {"A": alpha})
    )
    assert np.abs(photo.pixels - straight).max() < 1e-6
    written = OpenEXR.File(io.BytesIO(photo.encode()), separate_channels=True).parts[0].channels
    for i, name in enumerate("RGB"):
        assert np.abs(written[name].pixels - stored[..., i]).max() < 1e-6
    assert np.array_equal(written["A"].pixels, alpha)
    assert np.abs(Photo.open(photo.encode("tiff")).linear() - straight).max() < 1e-6


def test_the_colours_of_a_premultiplied_avif_are_divided_by_alpha(data):
    source = data / "field" / "premultiplied.avif"
    photo = Photo.open(source)
    expected = np.asarray(Image.open(source).convert("RGBA"))
    opaque_enough = expected[..., 3] > 60
    assert np.array_equal(photo.alpha, expected[..., 3])
    assert np.abs(photo.pixels.astype(int) - expected[..., :3])[opaque_enough].mean() < 2
    assert np.array_equal(Photo.open(photo.encode("png")).pixels, photo.pixels)


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_a_premultiplied_avif_of_any_depth_has_its_straight_colours(bits):
    """The file is written as straight, and then marked: the reference of its metadata to the image
    becomes that of the image to its alpha.
    """
    dtype, white = (np.uint8, 255) if bits == 8 else (np.uint16, 65535)
    colour = np.array([0.8, 0.5, 0.25])
    alpha = np.broadcast_to(np.linspace(0.3, 1, 64)[:, None], (48, 64, 1))
    stored = np.rint(white * np.concatenate([colour * alpha, alpha], axis=2)).astype(dtype)
    photo = Photo.from_array(stored, encoding="srgb")
    file_info = replace(photo.file_info, bits=bits, lossless=True, xmp=XMP)
    data = replace(photo, file_info=file_info).encode("avif")
    marked = data.replace(b"cdsc\0\3\0\1\0\1", b"prem\0\1\0\1\0\2")
    assert (data.count(b"prem"), marked.count(b"prem")) == (0, 1)
    found = Photo.open(marked)
    assert found.file_info.bits == bits
    assert np.abs(found.pixels / white - colour).max() < 0.02
    assert np.abs(Photo.open(data).pixels / white - colour * alpha).max() < 0.01


# --- hints


@pytest.mark.parametrize(
    "profile", [P3, build_profile(SWAPPED, [struct.pack(">4s4xI", b"curv", 0)], is_grey=False)]
)
def test_red_and_green_of_hints_are_those_of_srgb_whatever_their_profile(profile):
    strokes = np.zeros((48, 64, 3), np.uint8)
    strokes[5:10, 5:10, 0] = 255
    strokes[20:30, 5:10, 1] = 255
    srgb = Photo.open(file_of(strokes, "PNG"))
    other = Photo.open(file_of(strokes, "PNG", icc_profile=profile)).with_linear(srgb.linear())
    found, expected = (Hints.open(photo.encode("png"), (64, 48)).values for photo in (other, srgb))
    assert np.abs(found.astype(int) - expected).max() <= 3
    with pytest.raises(MaskError):
        Hints.open(
            file_of(np.full((48, 64, 3), 99, np.uint8), "PNG", icc_profile=profile), (64, 48)
        )
