"""A mask scales the strength in each pixel: in Python, on the command line and over HTTP."""

import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.errors import MaskError
from brewster.photo import Mask
from brewster.separation.guided_upsampling import GeneratedOverride, GuidedUpsampler
from cli_helpers import image_bytes
from picture_files import exif_block, file_of, smooth
from web_servers import form, make_app, request

SIZE = 60, 40


def glass_backend(tile):
    return tile * 0.75, tile * 0.25


@pytest.fixture
def photo():
    return Photo.open(image_bytes(*SIZE, "png"))


def left_half(dtype=np.uint8):
    """A mask of SIZE whose left half is white."""
    values = np.zeros(SIZE[::-1], dtype)
    values[:, :30] = 1 if values.dtype.kind in "bf" else np.iinfo(dtype).max
    return values


def layers_of(separation):
    return separation.transmission.pixels, separation.reflection.pixels


@pytest.mark.parametrize("dtype", [np.bool_, np.uint8, np.uint16, np.float32])
def test_white_is_separated_and_black_is_bit_equal_to_the_photo(photo, dtype):
    separator = Separator(glass_backend)
    whole = layers_of(separator(photo))
    masked = layers_of(separator(photo, mask=left_half(dtype)))
    for layer, plain in zip(masked, whole, strict=True):
        assert (layer[:, :30] == plain[:, :30]).all()
    assert (masked[0][:, 30:] == photo.pixels[:, 30:]).all()
    assert not masked[1][:, 30:].any()
    assert (masked[0][:, :30] != photo.pixels[:, :30]).any()


def out_of_range(tile):
    """A backend whose layers are below 0 and above 1, so that the order of scaling and clipping
    matters.
    """
    return tile + np.where(tile > 0.4, 0.9, -0.6).astype(np.float32), np.minimum(tile + 0.3, 1)


@pytest.mark.parametrize("backend", [glass_backend, out_of_range])
def test_a_grey_mask_is_the_same_as_a_lower_strength(photo, backend):
    separator = Separator(backend)
    grey = np.full(SIZE[::-1], 0.4, np.float32)
    masked = separator(photo, mask=grey)
    weak = separator(photo, strength=0.4)
    for ours, theirs in zip(layers_of(masked), layers_of(weak), strict=True):
        assert np.abs(ours.astype(int) - theirs).max() <= 1


def test_the_mask_and_the_strength_multiply_with_a_generated_override(rng):
    image, change = rng.random((2, 20, 30, 3), np.float32)
    weights = np.full((20, 30, 1), 0.5, np.float32)

    def apply(strength, weights=None):
        override = GeneratedOverride(change, weights_of_override, strength)
        scaled = np.float32(strength) * change
        return GuidedUpsampler.fit(image, -scaled, scaled, override).apply(image, 0, 20, weights)

    weights_of_override = rng.random((20, 30, 1), np.float32)
    for ours, theirs in zip(apply(0.8, weights), apply(0.4), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_additive_layers_with_a_mask_still_sum_to_the_photo(photo):
    separation = Separator(glass_backend)(photo, mask=left_half(), additive=True)
    total = separation.transmission.pixels + separation.reflection.pixels
    assert (total == photo.linear()).all()
    assert not separation.reflection.pixels[:, 30:].any()


def test_strips_use_their_own_rows_of_the_mask():
    values = np.zeros((3000, 200), np.uint8)
    values[1000:] = 255
    grey = Photo(np.full((3000, 200, 3), 128, np.uint8))
    assert len(list(grey.strips())) > 1
    transmission = Separator(glass_backend)(grey, mask=values).transmission.pixels
    assert (transmission[:1000] == 128).all()
    assert (transmission[1000:] < 128).all()


def test_the_mask_belongs_to_the_upright_photo():
    turned = file_of(smooth(), "png", exif=exif_block(6))  # stored as 64 x 48, shown as 48 x 64
    assert Separator(glass_backend)(turned, mask=np.ones((64, 48), np.float32)).photo.size == (
        48,
        64,
    )
    with pytest.raises(MaskError, match="64 x 48 pixels; expected 48 x 64"):
        Separator(glass_backend)(turned, mask=np.ones((48, 64), np.float32))


def rgba(alpha):
    return np.dstack([np.full((40, 60, 3), 255, np.uint8), np.full((40, 60), alpha, np.uint8)])


@pytest.mark.parametrize(("mask", "message"), [
    (b"no image", "the mask cannot be read: the file is text"),
    ("missing.png", "cannot be read: missing.png cannot be read"),
    (np.zeros((40, 61), np.uint8), "61 x 40 pixels; expected 60 x 40"),
    (image_bytes(*SIZE, "png"), "the mask has colours"), (rgba(254), ("the mask has transparent "
                                                                     "pixels")),
    (np.full((40, 60), 1.5, np.float32), "the mask has values from 1.5 to 1.5"),
    (np.zeros((40, 60, 5), np.uint8), "the mask cannot be read: the array has the shape"),
])  # fmt: skip
def test_a_mask_that_cannot_be_used_is_refused(photo, mask, message):
    with pytest.raises(MaskError) as raised:
        Separator(glass_backend)(photo, mask=mask)
    assert message in str(raised.value)
    assert (Mask.open(rgba(255), SIZE).rows(0, 40) == 1).all()  # grey, stored as opaque colours


def test_a_mask_may_have_as_many_pixels_as_its_photo(photo, monkeypatch, tmp_path):
    monkeypatch.setitem(Photo.open.__func__.__kwdefaults__, "max_pixels", 1)
    monkeypatch.setattr("brewster.photo.mask.DEFAULT_MAX_PIXELS", 1)
    Photo.from_array(np.full(photo.size[::-1], 255, np.uint8), encoding="srgb").save(
        tmp_path / "mask.png"
    )
    Separator(glass_backend)(photo, mask=tmp_path / "mask.png")


def test_the_command_line_and_the_server_return_the_bytes_of_python(run, tmp_path, model):
    data = image_bytes(*SIZE, "png")
    mask = file_of(left_half(), "png")
    (tmp_path / "mask.png").write_bytes(mask)
    code, made, _ = run("-", "--mask", "mask.png", "--strength", 0.5, stdin=data)
    expected = Separator.load(str(model), device="cpu")(
        data, mask=mask, strength=0.5
    ).transmission.encode()
    assert (code, made) == (0, expected)

    def served(**files):
        parts = {
            name: (f"{name}.png", content) for name, content in ({"photo": data} | files).items()
        }
        fields = {"layers": "transmission", "strength": "0.5"}
        return request(make_app(), "POST", "/separate", files=parts, data=fields)

    whole, masked = (Photo.open(served(**files).content).pixels for files in ({}, {"mask": mask}))
    assert (masked[:, :30] == whole[:, :30]).all()
    assert (masked[:, 30:] == Photo.open(data).pixels[:, 30:]).all()
    wrong = served(mask=image_bytes(50, 50, "png"))
    assert (wrong.status_code, wrong.json()["kind"]) == (422, "MaskError")
    text = request(make_app(), "POST", "/separate", **form(data, mask="white"))
    assert (text.status_code, "no file" in text.json()["error"]) == (422, True)


@pytest.mark.parametrize("size", [(6, 4), (3, 2), (4, 3), (1, 1)])
def test_a_sampled_mask_has_the_weights_at_the_centres_of_its_cells(size):
    values = np.arange(24, dtype=np.uint8).reshape(4, 6)
    width, height = size
    sampled = Mask.open(values, (6, 4)).sampled(width, height)
    expected = [
        [values[int((y + 0.5) * 4 / height), int((x + 0.5) * 6 / width)] for x in range(width)]
        for y in range(height)
    ]
    np.testing.assert_allclose(255 * sampled[..., 0], expected, rtol=1e-6)
