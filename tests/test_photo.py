"""Reading and writing photos: pixels and metadata are kept."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from brewster.base.image_formats import FORMATS
from brewster.errors import OutputError, PhotoError, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import FileInfo, Photo
from picture_files import P3, exif_block, exr_of, file_of, pil, random_image, smooth

quick = settings(max_examples=25, deadline=None, database=None)

LOSSLESS = ("png", "tiff")
SHAPES = st.tuples(*[st.integers(1, 9)] * 2, st.sampled_from([1, 3, 4]))


@quick
@given(arrays.arrays(st.sampled_from([np.uint8, np.uint16]), SHAPES))
def test_pixels_survive_lossless_files_bit_for_bit(pixels):
    photo = Photo.from_array(pixels, encoding="srgb")
    for format_name in LOSSLESS:
        again = Photo.open(photo.encode(format_name))
        assert again.pixels.dtype == pixels.dtype
        assert np.array_equal(again.pixels, pixels[..., :3])
        assert pixels.shape[2] < 4 or np.array_equal(again.alpha, pixels[..., 3])


@quick
@given(arrays.arrays(np.float32, (3, 4, 3), elements=st.floats(0, 1e6, width=32)))
def test_floats_survive_tiff_and_exr_bit_for_bit(pixels):
    photo = Photo.from_array(pixels, encoding="linear")
    for format_name in ("tiff", "exr"):
        assert np.array_equal(Photo.open(photo.encode(format_name)).pixels, pixels)


@pytest.mark.parametrize(("mode", "channels"), [("L", 1), ("LA", 2), ("RGB", 3), ("RGBA", 4)])
@pytest.mark.parametrize("format_name", ["png", "tiff", "webp"])
def test_grey_stays_grey_and_alpha_is_kept(format_name, mode, channels):
    array = random_image(channels=channels)
    data = file_of(array, format_name, **({"lossless": True} if format_name == "webp" else {}))
    again = pil(Photo.open(data).encode())
    if format_name != "webp":  # WebP stores RGB only
        assert again.mode == mode
    assert np.array_equal(np.asarray(again.convert("RGBA")), np.asarray(pil(data).convert("RGBA")))


@pytest.mark.parametrize("mode", ["1", "P"])
def test_bilevel_and_palette_images_become_grey_and_rgb(mode):
    image = Image.fromarray(smooth()).convert(mode)
    pixels = Photo.open(file_of(image, "PNG")).pixels.squeeze()
    assert np.array_equal(pixels, image.convert("L" if mode == "1" else "RGB"))


def test_a_gif_of_one_frame_is_read_and_written_as_png():
    image = Image.fromarray(smooth()).convert("P")
    photo = Photo.open(file_of(image, "GIF"))
    assert photo.file_info.format_name == "png"
    assert np.array_equal(
        np.asarray(pil(photo.encode()).convert("RGB")), np.asarray(image.convert("RGB"))
    )


@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff", "webp", "avif", "exr", "hdr"])
def test_one_pixel_works_in_every_format(format_name):
    photo = Photo.from_array(np.full((1, 1, 3), 128, np.uint8), encoding="srgb")
    assert photo.encode(format_name) == photo.encode(format_name)
    again = Photo.open(photo.encode(format_name))
    assert again.size == (1, 1)
    np.testing.assert_allclose(again.linear(), photo.linear(), atol=0.01)


def test_exr_keeps_its_half_floats_alpha_and_attributes():
    exr = pytest.importorskip("OpenEXR")
    planes = {name: np.random.default_rng(1).random((5, 7)).astype(np.float16) for name in "RGBA"}
    photo = Photo.open(exr_of(planes, compression=exr.PIZ_COMPRESSION, owner="me"))
    part = exr.File(io.BytesIO(photo.encode()), separate_channels=True).parts[0]
    assert part.header["owner"] == "me"
    assert part.header["compression"] == exr.PIZ_COMPRESSION
    for name in "RGBA":
        assert part.channels[name].pixels.dtype == np.float16
        assert np.array_equal(part.channels[name].pixels, planes[name])


def test_radiance_images_round_trip_bit_equal_and_run_lengths_are_decoded():
    rgbe = random_image(height=6, width=16, channels=4)
    rgbe[..., 0] |= 128
    rgbe[..., 3] = 120 + rgbe[..., 3] % 20
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n-Y 6 +X 16\n"
    flat = Photo.open(head + rgbe.tobytes())
    lines = b""
    for line in rgbe:
        lines += b"\2\2\0\x10"
        for plane in line.T[:3]:
            lines += b"\x10" + plane.tobytes()
        lines += bytes((128 + 15, line[0, 3], 1, line[0, 3]))
    rgbe[..., 3] = rgbe[:, :1, 3]
    coded = Photo.open(head + lines)
    formula = rgbe[..., :3] * 2.0 ** (rgbe[..., 3:].astype(float) - 136)
    np.testing.assert_array_equal(coded.linear(), formula.astype(np.float32))
    for photo in (flat, coded):
        again = Photo.open(photo.encode())
        assert np.array_equal(again.pixels, photo.pixels)
        assert again.file_info.header == {"EXPOSURE": "2"}


def test_run_lengths_of_old_radiance_images_are_decoded():
    """The pixel (1, 1, 1, n) repeats the pixel before it n times; the next such pixel counts 256
    times as much.
    """
    first, second, third = (bytes((128, 2, level, 129)) for level in (3, 4, 5))
    body = (
        first + bytes((1, 1, 1, 43, 1, 1, 1, 1)) + second + third + bytes((1, 1, 1, 42, 1, 1, 1, 1))
    )
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 300\n"
    flat = first * 300 + second + third * 299
    np.testing.assert_array_equal(
        Photo.open(head + body).linear(), Photo.open(head + flat).linear()
    )
    for damaged in (body[:-4], body + first, body[4:]):
        with pytest.raises(UnreadablePhoto, match="is truncated or damaged"):
            Photo.open(head + damaged)


def test_repeated_factors_of_a_radiance_header_are_multiplied():
    """The exposure of an image is the product of all EXPOSURE lines."""
    head = (
        b"#?RADIANCE\nEXPOSURE=2\nVIEW=a\nEXPOSURE= 0.25\nCOLORCORR=1 2 3\nCOLORCORR=2 2 "
        b"0.5\nVIEW=b\n"
    )
    photo = Photo.open(head + b"\n-Y 1 +X 1\n" + bytes((128, 64, 32, 129)))
    header = {"EXPOSURE": "0.5", "VIEW": "b", "COLORCORR": "2 4 1.5"}
    assert photo.file_info.header == Photo.open(photo.encode()).file_info.header == header


@pytest.mark.parametrize("width", [1 << 15, 1 << 16])
def test_a_radiance_image_too_wide_for_run_lengths_is_flat(width):
    photo = Photo.from_array(np.full((1, width, 3), 0.5, np.float32), encoding="linear")
    assert np.array_equal(Photo.open(photo.encode("hdr")).pixels, photo.pixels)


def test_negative_light_is_black_in_a_radiance_image():
    light = np.float32([[[-0.5, 0.25, 2], [-3, -1, -0.1]]])
    stored = Photo.open(Photo.from_array(light, encoding="linear").encode("hdr")).linear()
    assert stored.tolist() == [[[0, 0.25, 2], [0, 0, 0]]]


@pytest.mark.parametrize("primaries", ["0 0 0 0 0 0 0 0", "none", "0.3 0.3"])
def test_primaries_that_span_no_gamut_are_ignored(primaries):
    data = f"#?RADIANCE\nPRIMARIES={primaries}\n\n-Y 1 +X 1\n".encode() + bytes((128, 64, 32, 129))
    np.testing.assert_allclose(Photo.open(data).linear()[0, 0], (1, 0.5, 0.25))


@pytest.mark.parametrize(("depth", "dtype"), [(8, np.uint8), (16, np.uint16), (32, np.float32)])
def test_bit_depth_is_changed_only_on_request(depth, dtype):
    for photo in (
        Photo(smooth(), None, FileInfo(icc=P3)),
        Photo.from_array(smooth() / 255, encoding="srgb"),
    ):
        again = Photo.open(photo.encode("tiff", depth=depth))
        assert again.pixels.dtype == dtype
        np.testing.assert_allclose(again.linear(), photo.linear(), atol=5e-3)
    assert Photo.open(Photo(smooth(), None, FileInfo()).encode("tiff")).pixels.dtype == np.uint8


def test_heic_keeps_profile_exif_and_pixels():
    pytest.importorskip("pillow_heif")
    photo = Photo(smooth(), None, FileInfo(icc=P3, exif=exif_block(1).removeprefix(b"Exif\0\0")))
    for depth in FORMATS["heic"].bit_depths:
        again = Photo.open(photo.encode("heic", depth=depth))
        assert (again.file_info.format_name, again.file_info.bits) == ("heic", depth)
        assert (again.file_info.icc, again.file_info.exif) == (P3, photo.file_info.exif)
        assert np.abs(again.linear() - photo.linear()).mean() < 0.01


@pytest.mark.parametrize("brand", [b"mif1", b"miaf"])
@pytest.mark.parametrize("format_name", ["avif", "heic"])
def test_a_file_with_a_general_brand_is_recognised_by_its_content(format_name, brand):
    pytest.importorskip("pillow_heif")
    data = Photo(smooth(), None, FileInfo()).encode(format_name)
    again = Photo.open(data[:8] + brand + data[12:])
    assert again.file_info.format_name == format_name
    assert np.array_equal(again.pixels, Photo.open(data).pixels)


def test_an_unknown_encoding_and_one_for_sources_other_than_arrays_are_refused():
    for dtype in (np.uint8, np.float32):
        for create in (Photo.open, Photo.from_array):
            with pytest.raises(PhotoError, match=r"'sRGB'; .*; pass encoding"):
                create(smooth().astype(dtype), encoding="sRGB")
    data = file_of(smooth(), "PNG")
    for source in (data, "a.png", pil(data), Photo.open(data)):
        with pytest.raises(PhotoError, match="expected no encoding"):
            Photo.open(source, encoding="srgb")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64])
def test_arrays_are_read_by_their_encoding(dtype):
    white = np.iinfo(dtype).max if dtype != np.float64 else 1
    half = np.full((2, 2), white * 0.5).astype(dtype)
    encoded = Photo.from_array(half, encoding="srgb").linear()
    linear = Photo.from_array(half, encoding="linear").linear()
    np.testing.assert_allclose(encoded, 0.214, atol=2e-3)
    np.testing.assert_allclose(linear, 0.5, atol=2e-3)


def test_a_photo_does_not_change_with_the_array_it_came_from():
    array = smooth()
    photo = Photo.from_array(array, encoding="srgb")
    array[:] = 0
    assert np.array_equal(photo.pixels, smooth())
    with pytest.raises(ValueError, match="read-only"):
        photo.pixels[0] = 1


def test_a_pil_jpeg_followed_by_previews_is_one_image():
    image = Image.fromarray(smooth())
    data = file_of(smooth(), "MPO", save_all=True, append_images=[image.resize((8, 8))])
    assert Photo.open(pil(data)).size == Photo.open(data).size == image.size


def test_a_cmyk_or_lab_pil_image_is_refused():
    for mode in ("CMYK", "LAB"):
        image = Image.new(mode, (4, 4))
        with pytest.raises(UnsupportedPhoto, match=mode):
            Photo.open(image)


@quick
@given(st.integers(1, 12), st.integers(1, 12), st.integers(1, 30), st.integers(1, 30))
def test_a_resized_photo_has_the_mean_light_of_each_area(width, height, across, down):
    pixels = random_image(down, across)
    photo = Photo.from_array(pixels, encoding="srgb")
    repeated = photo.linear().repeat(height, axis=0).repeat(width, axis=1)
    means = repeated.reshape(height, down, width, across, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(photo.resized(width, height), means, atol=1e-5)


def test_a_photo_may_be_used_by_many_threads():
    photo = Photo(random_image(200, 200), None, FileInfo(icc=P3))
    with ThreadPoolExecutor(4) as pool:
        linears = list(pool.map(lambda _: photo.with_linear(photo.linear()).encode(), range(8)))
    assert len(set(linears)) == 1


@pytest.mark.parametrize(
    ("name", "format_name", "is_misleading"),
    [
        ("a.jpg", "png", True),
        ("a.heic", "png", True),
        ("a.avif", "heic", False),  # both are HEIF files
        ("a.heic", "avif", False),
        ("a.dng", "tiff", False),
        ("a.JPEG", "jpeg", False),
        ("a", "png", False),
    ],
)
def test_a_suffix_of_another_format_is_noted(name, format_name, is_misleading, tmp_path):
    pytest.importorskip("pillow_heif")
    (tmp_path / name).write_bytes(Photo(smooth(), None, FileInfo()).encode(format_name))
    note = Photo.open(tmp_path / name).file_info.note or ""
    assert (format_name.upper() in note) == is_misleading


def test_the_suffix_of_a_saved_file_sets_its_format_and_no_file_is_overwritten(tmp_path):
    photo = Photo.from_array(smooth(), encoding="srgb")
    formats = {".jpg": "JPEG", ".PNG": "PNG", ".tif": "TIFF", ".webp": "WEBP", ".avif": "AVIF"}
    for suffix, pil_format in formats.items():
        photo.save(tmp_path / f"a{suffix}")
        assert pil((tmp_path / f"a{suffix}").read_bytes()).format == pil_format
    with pytest.raises(OutputError):
        photo.save(tmp_path / "a.jpg")
    photo.save(tmp_path / "a.jpg", overwrite=True)


def test_alpha_is_not_dropped_silently_and_impossible_depths_are_refused():
    photo = Photo.from_array(random_image(channels=4), encoding="srgb")
    for format_name in ("jpeg", "hdr"):
        with pytest.raises(UnsupportedPhoto, match="alpha"):
            photo.encode(format_name)
    with pytest.raises(UnsupportedPhoto, match="16 bits"):
        photo.encode("webp", depth=16)


def test_sixteen_bits_are_rounded_to_eight():
    values = np.arange(0, 65536, 37, np.uint16)
    photo = Photo.from_array(np.repeat(values[None, :, None], 3, axis=2), encoding="srgb")
    stored = Photo.open(photo.encode("png", depth=8)).pixels[0, :, 0]
    assert (stored == np.rint(values / 257)).all()
