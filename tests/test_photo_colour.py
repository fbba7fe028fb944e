"""Colour: sRGB, matrix profiles, grey, chromaticities and LUT profiles, compared with littleCMS or
a formula.
"""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import pyvips
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image, ImageCms

from brewster.errors import UnsupportedPhoto
from brewster.photo import FileInfo, Photo, srgb
from brewster.photo.colour.spaces import SRGB, colour_space_of, convert_to_display_p3
from brewster.photo.decode import read_size

quick = settings(max_examples=25, deadline=None, database=None)

GAMMA = struct.pack(">4s4xIH", b"curv", 1, round(2.2 * 256))
LINEAR = struct.pack(">4s4xI", b"curv", 0)
WHITE = struct.pack(">4s4x3i", b"XYZ ", 63190, 65536, 54061)
SAMPLED = (
    struct.pack(">4s4xI", b"curv", 1024)
    + (np.linspace(0, 1, 1024) ** 1.8 * 65535).astype(">u2").tobytes()
)
NOISE_8BIT = np.random.default_rng(1).integers(0, 256, (8, 8, 3), np.uint8)
ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
REC709 = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.71410))
PRO = ((0.79767, 0.28804, 0.0), (0.13519, 0.71188, 0.0), (0.03134, 0.00009, 0.82491))


def parametric(function, *parameters):
    """Returns a tone curve as a tag of parametricCurveType."""
    numbers = [round(65536 * value) for value in parameters]
    return struct.pack(f">4s4xHH{len(numbers)}i", b"para", function, 0, *numbers)


def profile(curve, colourants):
    """Returns a small ICC profile: RGB with a matrix, or grey if `colourants` is None."""
    curve += bytes(-len(curve) % 4)
    xyz = {
        name: struct.pack(">4s4x3i", b"XYZ ", *(round(65536 * value) for value in values))
        for name, values in zip((b"rXYZ", b"gXYZ", b"bXYZ"), colourants or (), strict=False)
    }
    text = struct.pack(">4s4xI", b"desc", 5) + b"test\0" + bytes(78)
    curves = dict.fromkeys((b"rTRC", b"gTRC", b"bTRC") if colourants else (b"kTRC",), curve)
    tags = {b"desc": text + bytes(-len(text) % 4), b"wtpt": WHITE, **xyz, **curves}
    return icc_file(tags, b"mntr", b"RGB " if colourants else b"GRAY", b"XYZ ")


def icc_file(tags, device, space, connection_space):
    rows = b""
    body = b""
    for name, tag in tags.items():
        rows += struct.pack(">4sII", name, 132 + 12 * len(tags) + len(body), len(tag))
        body += tag
    body = struct.pack(">I", len(tags)) + rows + body
    words = (bytes(4), 0x02400000, device, space, connection_space, b"acsp")
    head = struct.pack(">I4sI4s4s4s12x4s", 128 + len(body), *words)
    return head.ljust(68, b"\0") + struct.pack(">3i", 63190, 65536, 54061) + bytes(48) + body


def lut_profile(points=33):
    """Returns an ICC profile with a table (lut16Type) from RGB to Lab and without a matrix.

    Its tone curve has the exponent 1.8, and its primaries are `LUT_PRIMARIES`.
    """
    grid = np.linspace(0, 1, points)
    rgb = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1)
    xyz = rgb**1.8 @ np.array(LUT_PRIMARIES) / (0.9642, 1.0, 0.8249)
    root = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    a, b = (factor * (root[..., i] - root[..., i + 1]) for i, factor in enumerate((500, 200)))
    lab = np.stack([(116 * root[..., 1] - 16) * 652.8, (a + 128) * 256, (b + 128) * 256], axis=-1)
    linear_curve = struct.pack(">6H", *(0, 65535) * 3)
    table = np.rint(lab).clip(0, 65535).astype(">u2").tobytes()
    matrix = struct.pack(">9i", *(65536 * (i % 4 == 0) for i in range(9)))
    lut = struct.pack(">4s4x4B", b"mft2", 3, 3, points, 0) + matrix + struct.pack(">2H", 2, 2)
    lut += linear_curve + table + linear_curve
    lut += bytes(-len(lut) % 4)
    return icc_file({b"wtpt": WHITE, b"A2B0": lut}, b"scnr", b"RGB ", b"Lab ")


LUT_PRIMARIES = ((0.35, 0.20, 0.05), (0.42, 0.68, 0.09), (0.1942, 0.12, 0.6849))
"""XYZ of red, green and blue under D50. These colours are in the gamut of Display P3."""

PROFILES = {
    "Display P3": bytes(pyvips.Image.profile_load("p3")), "Adobe RGB": profile(GAMMA, ADOBE),
    "ProPhoto, sampled": profile(SAMPLED, PRO), "linear": profile(LINEAR, ADOBE),
}  # fmt: skip


def photo_of(pixels, icc):
    return Photo(pixels, None, FileInfo(bits=8 * pixels.dtype.itemsize, icc=icc))


def all_code_values(dtype, channels=3):
    """Returns every value of the dtype, in another order in each channel."""
    count = np.iinfo(dtype).max + 1
    order = np.random.default_rng(1)
    return np.stack([order.permutation(count) for _ in range(channels)], axis=1).astype(dtype)[None]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_srgb_is_decoded_by_its_curve_and_every_value_round_trips(dtype):
    photo = photo_of(all_code_values(dtype), None)
    formula = srgb.to_linear(photo.pixels / np.iinfo(dtype).max)
    np.testing.assert_allclose(photo.linear(), formula, atol=1e-7)
    assert np.array_equal(photo.with_linear(photo.linear()).pixels, photo.pixels)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_new_light_is_rounded_to_the_nearest_value(dtype):
    linear = np.linspace(-0.1, 1.1, 30_000, dtype=np.float32).reshape(10, 1000, 3)
    white = np.iinfo(dtype).max
    found = photo_of(np.zeros((10, 1000, 3), dtype), None).with_linear(linear).pixels
    exact = srgb.to_encoded(linear.clip(0, 1).astype(np.float64)) * white
    assert np.abs(found - exact).max() <= 0.6


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_unchanged_light_is_bit_equal_with_every_profile(name, dtype):
    photo = photo_of(all_code_values(dtype), PROFILES[name])
    assert np.array_equal(photo.with_linear(photo.linear()).pixels, photo.pixels)


def littlecms(pixels, source, target):
    """Converts pixels between two profiles with littleCMS."""
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    flags = ImageCms.Flags.NOOPTIMIZE
    image = Image.fromarray(pixels)
    return np.asarray(
        ImageCms.profileToProfile(image, source, target, renderingIntent=intent, flags=flags)
    )


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_agrees_with_littlecms_in_both_directions(name):
    pixels = np.random.default_rng(2).integers(0, 256, (32, 32, 3), np.uint8)
    icc = ImageCms.ImageCmsProfile(io.BytesIO(PROFILES[name]))
    standard = ImageCms.createProfile("sRGB")
    decoded = srgb.to_encoded(photo_of(pixels, PROFILES[name]).linear().clip(0, 1)) * 255
    assert np.abs(decoded - littlecms(pixels, icc, standard)).max() <= 1
    ours = (
        photo_of(np.zeros_like(pixels), PROFILES[name])
        .with_linear(srgb.to_linear(pixels / 255))
        .pixels
    )
    assert np.abs(ours.astype(int) - littlecms(pixels, standard, icc)).max() <= 1


def test_wide_gamut_is_not_clipped_and_white_stays_white():
    green_and_white = np.array([[[0, 255, 0], [255, 255, 255]]], np.uint8)
    green, white = photo_of(green_and_white, PROFILES["Display P3"]).linear()[0]
    assert green[0] < -0.1
    np.testing.assert_allclose(white, 1, atol=2e-3)


@quick
@given(arrays.arrays(np.float32, (4, 5, 3), elements=st.floats(0, 1, width=32)))
def test_a_second_round_trip_through_16_bits_changes_light_by_less_than_1e_4(linear):
    for icc in (None, *PROFILES.values()):
        space = colour_space_of(icc, None, is_float=False)
        inside = space.to_linear(space.to_stored(linear, np.zeros(linear.shape, np.uint16)))
        again = space.to_linear(space.to_stored(inside, np.zeros(linear.shape, np.uint16)))
        np.testing.assert_allclose(again, inside, atol=1e-4)


def test_the_light_of_a_row_does_not_depend_on_its_strip():
    pixels = np.random.default_rng(4).integers(0, 256, (50, 33, 3), np.uint8)
    photo = photo_of(pixels, PROFILES["Adobe RGB"])
    whole = photo.linear()
    for top, bottom in ((0, 1), (7, 50), (13, 14)):
        assert np.array_equal(photo.linear_rows(top, bottom), whole[top:bottom])
        assert np.array_equal(photo.stored_rows(whole[top:bottom], top), pixels[top:bottom])


def test_only_changed_pixels_change():
    pixels = np.random.default_rng(5).integers(0, 256, (20, 20, 3), np.uint8)
    photo = photo_of(pixels, PROFILES["ProPhoto, sampled"])
    linear = photo.linear()
    linear[3, 4, 0] = 0.9 - linear[3, 4, 0]
    changed = photo.with_linear(linear)
    assert np.argwhere((changed.pixels != pixels).any(axis=2)).tolist() == [[3, 4]]
    np.testing.assert_allclose(changed.linear()[3, 4], linear[3, 4], atol=1e-2)


@pytest.mark.parametrize("icc", [
    bytes(pyvips.Image.profile_load("srgb")),
    ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
    profile(parametric(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045), REC709),
])  # fmt: skip
def test_a_profile_that_equals_srgb_is_recognised(icc):
    assert colour_space_of(icc, None, is_float=False) == SRGB


def test_the_tone_curve_of_a_grey_profile_is_applied():
    photo = photo_of(all_code_values(np.uint8, channels=1), profile(GAMMA, None))
    formula = (photo.pixels[..., 0] / 255) ** (round(2.2 * 256) / 256)
    np.testing.assert_allclose(photo.linear()[..., 1], formula, atol=1e-6)
    assert np.array_equal(photo.with_linear(photo.linear()).pixels, photo.pixels)


def test_grey_takes_the_luminance_of_coloured_light():
    linear = np.zeros((1, 1, 3), np.float32)
    linear[..., 1] = 1
    grey = Photo.from_array(np.zeros((1, 1), np.float32), encoding="linear").with_linear(linear)
    np.testing.assert_allclose(grey.pixels, 0.7152, atol=1e-6)


def test_floats_are_stored_as_they_are_beyond_white_and_below_black():
    linear = np.array([[[-0.5, 0.25, 7.0]]], np.float32)
    photo = Photo.from_array(linear, encoding="linear")
    assert np.array_equal(photo.linear(), linear)
    assert np.array_equal(photo.with_linear(linear * 2).pixels, linear * 2)


def test_floats_with_a_profile_are_decoded_and_encoded_with_it():
    pixels = np.random.default_rng(6).random((8, 8, 3), dtype=np.float32)
    photo = photo_of(pixels, PROFILES["Adobe RGB"])
    assert np.array_equal(photo.with_linear(photo.linear()).pixels, pixels)
    moved = photo.with_linear(photo.linear() * np.float32(0.5)).linear()
    np.testing.assert_allclose(moved, photo.linear() * 0.5, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_unchanged_floats_with_the_srgb_profile_are_bit_equal(channels):
    pixels = np.random.default_rng(7).uniform(-0.5, 2, (64, 64, channels)).astype(np.float32)
    photo = photo_of(pixels, bytes(pyvips.Image.profile_load("srgb")))
    assert photo.colour_space() == SRGB
    assert np.array_equal(photo.with_linear(photo.linear()).pixels, pixels)


def test_chromaticities_are_converted_to_rec709_and_white_stays_white():
    aces = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
    to_linear = colour_space_of(None, aces, is_float=True).to_linear
    np.testing.assert_allclose(to_linear(np.ones((1, 1, 3), np.float32)), 1, atol=1e-4)
    red = to_linear(np.array([[[1, 0, 0]]], np.float32))[0, 0]
    np.testing.assert_allclose(
        red, (2.5217, -0.2765, -0.0154), atol=0.01
    )  # ACES2065-1 to linear sRGB, Bradford


@pytest.mark.parametrize(("function", "count"), [(0, 1), (1, 3), (2, 4), (3, 5), (4, 7)])
def test_all_parametric_functions_of_icc_agree_with_littlecms(function, count):
    numbers = (2.2, 0.9, 0.1, 0.0 if function == 2 else 0.08, 0.05, 0.0, 0.0)[:count]
    test_profile = profile(parametric(function, *numbers), ADOBE)
    pixels = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    expected = littlecms(
        pixels, ImageCms.ImageCmsProfile(io.BytesIO(test_profile)), ImageCms.createProfile("sRGB")
    )
    ours = srgb.to_encoded(photo_of(pixels, test_profile).linear().clip(0, 1)) * 255
    assert np.abs(ours - expected).max() <= 1.5


def light_by_lut(pixels):
    """Returns the linear Rec.709 light of pixels with the LUT profile, by its formula."""
    return (
        (pixels / np.iinfo(pixels.dtype).max) ** 1.8
        @ np.array(LUT_PRIMARIES)
        @ np.linalg.inv(REC709)
    )


@pytest.mark.parametrize(
    ("format_name", "dtype", "tolerance"), [("png", np.uint8, 0.01), ("tiff", np.uint16, 0.006)]
)
def test_a_lut_profile_is_converted_and_its_colours_are_written(format_name, dtype, tolerance):
    noise = np.random.default_rng(8).integers(0, np.iinfo(dtype).max + 1, (24, 24, 3)).astype(dtype)
    data = photo_of(noise, lut_profile()).encode(format_name)
    photo = Photo.open(data)
    assert photo.pixels.dtype == dtype
    np.testing.assert_allclose(photo.linear(), light_by_lut(noise), atol=tolerance)
    assert photo.file_info.icc == PROFILES["Display P3"]
    again = Photo.open(photo.with_linear(photo.linear()).encode())
    assert again.file_info.format_name == format_name
    assert np.array_equal(again.pixels, photo.pixels)
    assert read_size(data) == (24, 24)
    white = np.full((4, 4, 3), np.iinfo(dtype).max, dtype)
    assert Photo.open(photo_of(white, lut_profile()).encode(format_name)).srgb_8bit().min() >= 254


def test_a_pil_image_with_a_lut_profile_is_read_as_its_file_is():
    noise = np.random.default_rng(9).integers(0, 256, (16, 16, 3), np.uint8)
    data = photo_of(noise, lut_profile()).encode("png")
    assert np.array_equal(Photo.open(Image.open(io.BytesIO(data))).pixels, Photo.open(data).pixels)


@pytest.mark.parametrize(
    "icc",
    [lut_profile()[:100_000], lut_profile().replace(b"mft2", b"mftX")],
    ids=["truncated", "unknown"],
)
def test_a_damaged_lut_profile_is_refused(icc):
    """libvips uses sRGB instead, without an error."""
    with pytest.raises(
        UnsupportedPhoto, match=r"LUT-based colour profile \(\d+ bytes\) cannot be used;"
    ):
        Photo.open(photo_of(NOISE_8BIT, icc).encode("tiff"))


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 1), (np.float32, 3)])
def test_a_lut_profile_is_refused_for_grey_and_for_floats(dtype, channels):
    with pytest.raises(UnsupportedPhoto, match="RGB of 8 or 16 bits"):
        convert_to_display_p3(np.ones((4, 4, channels), dtype), FileInfo(icc=lut_profile()))


@pytest.mark.parametrize(
    "icc",
    [
        b"no profile at all" * 20,
        bytes(pyvips.Image.profile_load("cmyk")),
        profile(GAMMA, ADOBE)[:200],
        b"",
    ],
    ids=["garbage", "tables", "truncated", "empty"],
)
def test_profiles_without_curves_and_matrix_are_refused(icc):
    with pytest.raises(UnsupportedPhoto, match="curves and a matrix"):
        colour_space_of(icc, None, is_float=False)


@pytest.mark.parametrize("curve", [
    struct.pack(">4s4xIH", b"curv", 1, 0), parametric(0, 0), parametric(1, 2.2, 0, 0.1),
    parametric(2, 2.2, 0, 0.1, 0.05), parametric(3, 2.2, 0, 0.1, 0.5, 0.04),
], ids=["curve, g = 0", "g = 0", "type 1, a = 0", "type 2, a = 0", "type 3, a = 0"])  # fmt: skip
@pytest.mark.parametrize("colourants", [None, ADOBE], ids=["grey", "rgb"])
def test_curves_without_an_inverse_are_refused(curve, colourants):
    with pytest.raises(UnsupportedPhoto, match="curves and a matrix"):
        colour_space_of(profile(curve, colourants), None, is_float=False)


@pytest.mark.parametrize(("format_name", "bits"), [("jpeg", 8), ("tiff", 8), ("tiff", 16)])
@pytest.mark.parametrize("has_profile", [True, False])
def test_cmyk_is_converted_by_its_profile_or_a_default_one_with_a_note(
    format_name, bits, has_profile
):
    """Paper white and the grey of black ink stay neutral; the colours come back by the inverse of
    the separation.
    """
    pixels = np.kron(
        np.uint8([[[255] * 3, [180, 90, 60]], [[90, 120, 80], [128] * 3]]), np.ones((16, 16, 1))
    ).astype(np.uint8)
    image = pyvips.Image.new_from_array(pixels).copy(interpretation="srgb")
    cmyk = image.icc_transform("cmyk", input_profile="srgb", intent="relative", depth=bits)
    if not has_profile:
        cmyk = cmyk.copy()
        cmyk.remove("icc-profile-data")
    data = cmyk.write_to_buffer(f".{format_name}", **({"Q": 97} if format_name == "jpeg" else {}))
    photo = Photo.open(data)
    assert read_size(data) == photo.size == (32, 32)
    assert photo.pixels.dtype.itemsize == bits // 8
    assert ("default" in str(photo.file_info.note)) != has_profile
    assert np.abs(photo.srgb_8bit().astype(int) - pixels).max() < 12
    assert Photo.open(photo.encode()).file_info.icc == photo.file_info.icc
