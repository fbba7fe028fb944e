import json
import math
from pathlib import Path

import numpy as np
import pytest

from brewster import Photo
from brewster.inference import Separator
from brewster.options import Options
from brewster.srgb import to_encoded, to_linear
from brewster.web.preview import PREVIEW_PIXELS, preview
from front_door import picture
from glass_server import app_of, ask, form, pane
from picture_files import exif_block, file_of, smooth

MIXTURE = Path(__file__).parent / "pictures" / "mixture-coffee-rocket.jpg"


class Maps:
    """A preview as light.js reads it."""

    def __init__(self, data):
        line, rest = data.split(b"\n", 1)
        self.head = json.loads(line)
        count = self.head["width"] * self.head["height"]
        shape = self.head["height"], self.head["width"]
        parts = np.split(np.frombuffer(rest, np.uint8), np.cumsum([3, 6, 3]) * count)
        self.photo, self.mirrored = (parts[index].reshape(*shape, 3) for index in (0, 2))
        low, high = self.head["range"]
        numbers = parts[1].view("<u2").reshape(*shape, 3)
        self.transmitted = low + numbers / 65535 * (high - low)
        self.confidence_map = parts[3].reshape(shape)

    def at(self, strength):
        """Transmission and reflection, in codes, by the formula that light.js uses."""
        photo, mirrored = to_linear(self.photo / 255), to_linear(self.mirrored / 255)
        layers = photo + strength * (self.transmitted - photo), np.minimum(strength * mirrored, photo)
        return [np.rint(255 * to_encoded(layer.clip(0, 1))) for layer in layers]


def maps_of(photo, backend=pane, **options):
    return Maps(preview(Separator(backend), Photo.open(photo), Options(**options), lambda _: None))


@pytest.fixture(scope="module")
def shipped():
    return Separator.load(device="cpu")


@pytest.fixture(scope="module")
def mixture(shipped):
    return Maps(preview(shipped, Photo.open(MIXTURE), Options(quality="draft"), lambda _: None))


@pytest.mark.parametrize("strength", [0, 0.25, 0.5, 1])
def test_what_the_browser_composites_is_what_the_server_makes(shipped, mixture, strength):
    made = shipped(Photo.open(MIXTURE), strength=strength, quality="draft")
    shown = mixture.at(strength)
    for layer, ours in zip((made.transmission, made.reflection), shown, strict=True):
        apart = np.abs(layer.pixels.astype(int) - ours)
        assert apart.max() <= 2
        assert apart.mean() < 0.2
    assert np.abs(made.confidence.pixels[..., 0].astype(int) - mixture.confidence_map).max() <= 1


def too_much(tile):
    """A backend whose layers leave the range that can be stored, below and above."""
    change = np.where(tile > 0.4, 0.9, -0.6).astype(np.float32)
    return tile + change, np.minimum(tile + 0.3, 1)


@pytest.mark.parametrize("strength", [0.1, 0.5, 0.9])
def test_layers_that_are_clipped_at_full_strength_are_right_below_it(strength):
    data = picture(120, 90, "png")
    made = Separator(too_much)(data, strength=strength)
    for layer, ours in zip(
        (made.transmission, made.reflection), maps_of(data, too_much).at(strength), strict=True
    ):
        apart = np.abs(layer.pixels.astype(int) - ours)
        assert np.quantile(apart, 0.99) <= 2


@pytest.mark.slow
def test_a_large_photo_is_made_smaller_and_looks_like_its_large_separation(shipped):
    pixels = np.kron(Photo.open(MIXTURE).pixels, np.ones((4, 4, 1), np.uint8))
    photo = Photo.from_array(pixels, encoding="srgb")
    maps = Maps(preview(shipped, photo, Options(quality="draft"), lambda _: None))
    assert maps.head["full"] == list(photo.size)
    assert maps.head["width"] * maps.head["height"] == pytest.approx(PREVIEW_PIXELS, rel=0.01)
    whole = shipped(photo, quality="draft").transmission
    small = 255 * to_encoded(whole.resized(maps.head["width"], maps.head["height"]).clip(0, 1))
    apart = np.abs(small - maps.at(1)[0])
    assert apart.mean() < 0.5
    assert np.quantile(apart, 0.99) < 3


@pytest.mark.parametrize("size", [(1, 1), (1, 900), (3000, 2)])
def test_odd_sizes_are_shown_too(size):
    maps = maps_of(picture(*size, "png"))
    assert [maps.head["width"], maps.head["height"]] == maps.head["full"] == list(size)


def test_a_rotated_photo_is_shown_upright_and_a_grey_one_grey():
    turned = maps_of(file_of(smooth(), "png", exif=exif_block(6)))
    assert turned.head["full"] == [48, 64]
    assert (turned.photo == np.rot90(smooth(), -1)).all()

    def tinted(tile):
        return tile * np.float32([0.5, 0.7, 0.9]), tile * 0.1

    grey = maps_of(file_of(smooth()[..., :1], "png"), tinted)
    assert np.ptp(grey.at(1)[0], axis=2).max() == 0


def test_a_wide_gamut_photo_is_shown_in_srgb():
    import pyvips  # noqa: PLC0415

    from brewster.photo.file_info import FileInfo  # noqa: PLC0415

    p3 = Photo(
        np.full((20, 30, 3), (230, 60, 60), np.uint8), None, FileInfo(icc=pyvips.Image.profile_load("p3"))
    )
    maps = maps_of(p3.encode("png"))
    assert np.abs(maps.photo.astype(int) - p3.srgb_8bit()).max() <= 1
    assert maps.photo[0, 0, 0] > 240  # P3's red is redder than sRGB's


def test_a_picture_brighter_than_white_is_shown_as_far_as_a_screen_goes():
    light = Photo.from_array(np.full((20, 30, 3), 3.0, np.float32), encoding="linear")
    maps = maps_of(light.encode("tiff"))
    assert maps.photo.min() == 255
    assert math.isclose(maps.transmitted.max(), maps.head["range"][1])


def test_progress_reaches_the_end():
    told = []
    preview(Separator(pane), Photo.open(picture(60, 40, "png")), Options(), told.append)
    assert told == sorted(told)
    assert told[-1] == 1


def test_the_server_gives_the_maps_and_refuses_as_it_does_elsewhere():
    answer = ask(app_of(), "POST", "/preview", **form(picture(60, 40, "png"), quality="draft"))
    assert Maps(answer.content).head["full"] == [60, 40]
    refused = ask(app_of(), "POST", "/preview", **form(b"no picture"))
    assert refused.status_code == 422
    assert "no picture" in refused.json()["error"]
