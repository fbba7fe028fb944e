"""The preview: its maps, and the formula with which the browser computes the layers."""

import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest

from brewster import Photo
from brewster.options import Options
from brewster.photo import FileInfo
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation import Separator
from brewster.separation.guided_upsampling import upsample_rows
from brewster.web.preview import MAX_PREVIEW_PIXELS, TILE_PX, photo_tile, preview
from cli_helpers import image_bytes
from picture_files import P3, exif_block, file_of, smooth
from web_servers import form, make_app, pane, request

MIXTURE = Path(__file__).parent / "pictures" / "mixture-coffee-rocket.jpg"


def sent_preview(response):
    """The first line of a preview that was sent, and the preview."""
    line, preview = gzip.decompress(response.content).split(b"\n", 1)
    return json.loads(line), preview


class Maps:
    """A preview, parsed as in light.js."""

    def __init__(self, data):
        line, rest = data.split(b"\n", 1)
        self.head = json.loads(line)
        self.shape = self.head["height"], self.head["width"]
        at = 3 * math.prod(self.shape)
        self.photo = np.frombuffer(rest[:at], np.uint8).reshape(*self.shape, 3)
        self.maps = {}
        for row in self.head["maps"]:
            shape = row["height"], row["width"], row["channels"]
            numbers = np.frombuffer(rest, "<u2", math.prod(shape), at).reshape(shape)
            at += numbers.nbytes
            low, high = row["range"]
            self.maps[row["name"]] = (low + numbers / 65535 * (high - low)).astype(np.float32)
        assert at == len(rest)

    def upsampled(self, name):
        return upsample_rows(self.maps[name], 0, self.shape[0], self.shape)

    def at(self, strength):
        """Transmission and reflection as 8-bit codes, computed as in light.js."""
        photo = to_linear(self.photo / 255)
        change, reflection = (
            self.upsampled(f"{layer}_slope") * photo + self.upsampled(f"{layer}_offset")
            for layer in ("change", "reflection")
        )
        if "weight" in self.maps:
            change += self.upsampled("weight") * (self.upsampled("generated") - photo - change)
        layers = photo + strength * change, np.minimum(strength * reflection, photo)
        return [np.rint(255 * to_encoded(layer.clip(0, 1))) for layer in layers]


def maps_of(photo, backend=pane, **options):
    return Maps(
        preview(Separator(backend), Photo.open(photo), Options(**options), lambda _: None)[0]
    )


@pytest.fixture(scope="module")
def compact_separator():
    return Separator.load(device="cpu")


@pytest.fixture(scope="module")
def mixture(compact_separator):
    return Maps(
        preview(compact_separator, Photo.open(MIXTURE), Options(quality="draft"), lambda _: None)[0]
    )


@pytest.mark.parametrize("strength", [0, 0.25, 0.5, 1])
def test_the_formula_of_the_browser_equals_the_separation_of_the_server(
    compact_separator, mixture, strength
):
    separation = compact_separator(Photo.open(MIXTURE), strength=strength, quality="draft")
    shown = mixture.at(strength)
    for layer, ours in zip((separation.transmission, separation.reflection), shown, strict=True):
        difference = np.abs(layer.pixels.astype(int) - ours)
        assert difference.max() <= 2
        assert difference.mean() < 0.2
    shown = np.rint(255 * mixture.upsampled("confidence"))
    assert np.abs(separation.confidence.pixels - shown).max() <= 1


def out_of_range(tile):
    """A backend whose layers are below 0 and above 1."""
    change = np.where(tile > 0.4, 0.9, -0.6).astype(np.float32)
    return tile + change, np.minimum(tile + 0.3, 1)


@pytest.mark.parametrize("strength", [0.1, 0.5, 0.9])
def test_layers_that_are_clipped_at_full_strength_are_correct_below_it(strength):
    data = image_bytes(120, 90, "png")
    layers = Separator(out_of_range)(data, strength=strength)
    shown = maps_of(data, out_of_range).at(strength)
    for layer, ours in zip(layers, shown, strict=True):
        difference = np.abs(layer.pixels.astype(int) - ours)
        assert np.quantile(difference, 0.99) <= 2


@pytest.mark.slow
def test_a_preview_depends_on_the_quality_and_on_no_other_option():
    def bytes_of(**options):
        separator = Separator(lambda tile: (0.9 * tile**1.1, 0.1 * tile))
        return preview(separator, Photo.open(MIXTURE), Options(**options), lambda _: None)[0]

    others = {"strength": 0.3, "format": "tiff", "additive": True, "layers": ("confidence",)}
    assert bytes_of(quality="draft", **others) == bytes_of(quality="draft") != bytes_of()


def test_the_preview_of_a_large_photo_matches_its_reduced_separation(compact_separator):
    pixels = np.kron(Photo.open(MIXTURE).pixels, np.ones((4, 4, 1), np.uint8))
    photo = Photo.from_array(pixels, encoding="srgb")
    maps = Maps(preview(compact_separator, photo, Options(quality="draft"), lambda _: None)[0])
    assert maps.head["full"] == list(photo.size)
    assert maps.head["width"] * maps.head["height"] == pytest.approx(MAX_PREVIEW_PIXELS, rel=0.01)
    whole = compact_separator(photo, quality="draft").transmission
    small = 255 * to_encoded(whole.resized(maps.head["width"], maps.head["height"]).clip(0, 1))
    difference = np.abs(small - maps.at(1)[0])
    assert difference.mean() < 0.5
    assert np.quantile(difference, 0.99) < 3


@pytest.mark.parametrize("size", [(1, 1), (1, 900), (3000, 2)])
def test_unusual_sizes_work(size):
    maps = maps_of(image_bytes(*size, "png"))
    assert [maps.head["width"], maps.head["height"]] == maps.head["full"] == list(size)


def test_a_rotated_photo_is_shown_upright_and_a_grey_one_grey():
    turned = maps_of(file_of(smooth(), "png", exif=exif_block(6)))
    assert turned.head["full"] == [48, 64]
    assert (turned.photo == np.rot90(smooth(), -1)).all()

    def tinted(tile):
        return tile * np.float32([0.5, 0.7, 0.9]), tile * 0.1

    grey = maps_of(file_of(smooth()[..., :1], "png"), tinted)
    assert np.ptp(grey.at(1)[0], axis=2).max() == 0


def test_a_wide_gamut_photo_is_shown_in_srgb_and_light_above_white_white():
    p3 = Photo(np.full((20, 30, 3), (230, 60, 60), np.uint8), None, FileInfo(icc=P3))
    maps = maps_of(p3.encode("png"))
    assert np.abs(maps.photo.astype(int) - p3.srgb_8bit()).max() <= 1
    assert maps.photo[0, 0, 0] > 240  # the red primary of P3 is outside sRGB

    light = Photo.from_array(np.full((20, 30, 3), 3.0, np.float32), encoding="linear")
    assert maps_of(light.encode("tiff")).photo.min() == 255


def tiles_of(photo, level):
    """All tiles of a level as one array."""
    columns, rows = (math.ceil(math.ceil(side / (1 << level)) / TILE_PX) for side in photo.size)
    return np.vstack(
        [
            np.hstack([photo_tile(photo, level, x, y).pixels for x in range(columns)])
            for y in range(rows)
        ]
    )


def test_the_tiles_of_level_zero_are_the_pixels_of_the_photo_and_others_are_means():
    photo = Photo.open(image_bytes(1100, 700, "png"))
    assert (tiles_of(photo, 0) == photo.pixels).all()
    half = tiles_of(photo, 1)
    assert half.shape == (350, 550, 3)
    expected = 255 * to_encoded(photo.resized(550, 350))
    assert np.abs(half - expected).max() <= 1
    assert tiles_of(photo, 3).shape == (88, 138, 3)
    grey = Photo(np.full((1001, 603, 3), 128, np.uint8))
    assert (tiles_of(grey, 3) == 128).all()


@pytest.mark.parametrize(
    "address", [(0, 3, 0), (0, 0, 2), (0, -1, 0), (-1, 0, 0), (9, 0, 0), (60, 0, 0)]
)
def test_there_are_no_tiles_outside_the_photo(address):
    assert photo_tile(Photo.open(image_bytes(1100, 700, "png")), *address) is None


def test_tiles_are_served_until_the_photo_is_dropped_and_again_after_it_was_sent_again():
    app = make_app()
    assert request(app, "GET", f"/tile/{'0' * 64}/0/0/0").status_code == 404
    for path in ("/preview", "/photo"):
        sent = request(app, "POST", path, **form(image_bytes(60, 40, "png")))
        assert sent.headers["Brewster-Size"] == "60x40"
        tile = request(app, "GET", f"/tile/{sent.headers['Brewster-Photo']}/0/0/0")
        assert Photo.open(tile.content).size == (60, 40)
    assert request(app, "GET", f"/tile/{sent.headers['Brewster-Photo']}/0/1/0").status_code == 404


def test_the_preview_route_returns_the_maps_and_refuses_invalid_files():
    response = request(
        make_app(), "POST", "/preview", **form(image_bytes(60, 40, "png"), quality="draft")
    )
    head, maps = sent_preview(response)
    assert Maps(maps).head["full"] == head["size"] == [60, 40]
    assert head["result"]["assessment"]["verdict"] == response.headers["Brewster-Verdict"]
    refused = request(make_app(), "POST", "/preview", **form(b"no picture"))
    assert refused.status_code == 422
    assert "no known image format" in refused.json()["error"]
