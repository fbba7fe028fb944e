import csv
import hashlib

import numpy as np
import pytest

from brewster.errors import PhotoError, RecipeError, UnsupportedPhoto
from brewster.photo import Photo
from brewster.photo.srgb import REC709_LUMINANCE, to_linear
from brewster.render.environments import assets as assets_module
from brewster.render.environments.assets import Assets
from brewster.render.scene.world import AssetSource, EnvironmentMap, Plane
from picture_files import exr_of, file_of, smooth

HEIGHT = 32
WIDTH = 64


def luminance(light):
    return light @ np.array(REC709_LUMINANCE, np.float32)


def sphere_mean(values):
    solid_angle = np.sin((np.arange(len(values)) + 0.5) * np.pi / len(values))
    return (values.mean(axis=1) * solid_angle).sum() / solid_angle.sum()


def sky(rng):
    """A map without lamps: (32, 64, 3), with a maximum of about three times the mean in one
    texel.
    """
    texels = rng.uniform(0.2, 1.8, (HEIGHT, WIDTH, 3)).astype(np.float32)
    texels[8, 9] = 3
    return texels


def exr_map(texels):
    return exr_of({name: texels[..., i] for i, name in enumerate("RGB")})


def hdr_of(texels):
    return Photo.from_array(texels, encoding="linear").encode("hdr")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "maps").mkdir()
    return tmp_path / "maps"


def map_radiance(folder, name, data, **values):
    (folder / name).write_bytes(data)
    return Assets([folder]).map_radiance(EnvironmentMap(source=AssetSource(file=name), **values))


def plane_radiance(folder, name, data, **values):
    (folder / name).write_bytes(data)
    plane = Plane(source=AssetSource(file=name), distance_mm=1000, width_mm=1000, **values)
    return Assets([folder]).plane_radiance(plane)


def test_a_map_has_the_mean_luminance_of_the_scene(folder, rng):
    texels = sky(rng)
    light = map_radiance(folder, "sky.exr", exr_map(texels * 37), luminance=2.5)
    assert light.dtype == np.float32
    assert sphere_mean(luminance(light)) == pytest.approx(2.5, rel=1e-4)
    np.testing.assert_allclose(light / light.mean(), texels / texels.mean(), rtol=1e-4)


def test_lamps_are_excluded_from_the_mean_but_not_from_the_light(folder, rng):
    texels = sky(rng)
    plain = map_radiance(folder, "plain.exr", exr_map(texels))
    texels[20, 30] = 1e5
    lit = map_radiance(folder, "lamp.exr", exr_map(texels))
    # In the mean, the lamp counts with ten times the mean in one of 2048 texels.
    assert sphere_mean(luminance(lit)) > 10
    mean = sphere_mean(np.minimum(luminance(texels), 10 * sphere_mean(luminance(texels))))
    np.testing.assert_allclose(lit, texels / mean, rtol=1e-4)
    assert lit[20, 30, 0] > 1e4
    assert np.median(lit / plain) < 1.01


def test_negative_values_are_set_to_zero(folder, rng):
    texels = sky(rng)
    texels[3, 4] = -5
    light = map_radiance(folder, "gamut.exr", exr_map(texels))
    assert light.min() == 0
    assert not light[3, 4].any()


def test_builtin_maps_need_no_folder_and_a_file_of_the_user_takes_their_place(folder, rng):
    environment = EnvironmentMap(source=AssetSource(file="spree_bank.exr"), luminance=3)
    light = Assets().map_radiance(environment)
    assert light.shape == (512, 1024, 3)
    assert sphere_mean(luminance(light)) == pytest.approx(3, rel=0.01)
    assert map_radiance(folder, "spree_bank.exr", exr_map(sky(rng))).shape != light.shape


@pytest.mark.parametrize("folder", [assets_module.BUILTIN_MAPS, assets_module.BUILTIN_PHOTOS])
def test_the_origin_and_licence_of_each_builtin_file_is_listed(folder):
    with (folder / "manifest.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["file"] for row in rows} == {path.name for path in folder.iterdir()} - {
        "manifest.csv"
    }
    assert all(row["licence"] == "CC0 1.0" and row["origin"] for row in rows)


def test_another_file_of_the_same_name_is_refused(folder, rng):
    data = hdr_of(sky(rng))
    (folder / "sky.hdr").write_bytes(data)
    correct = hashlib.sha256(data).hexdigest()
    wrong = hashlib.sha256(b"").hexdigest()
    assets = Assets([folder])
    assets.map_radiance(EnvironmentMap(source=AssetSource(file="sky.hdr", sha256=correct)))
    with pytest.raises(
        RecipeError, match="not the file that was chosen when the scene was sampled"
    ):
        assets.map_radiance(
            EnvironmentMap(source=AssetSource(file="sky.hdr", sha256=wrong))
        )  # the cached map of the other file is not used


def test_the_folder_with_the_right_file_is_found(tmp_path, folder, rng):
    first, second = (hdr_of(sky(rng)) for _ in range(2))
    (tmp_path / "sky.hdr").write_bytes(first)
    (folder / "sky.hdr").write_bytes(second)
    assets = Assets([tmp_path, folder])
    lights = [
        assets.map_radiance(EnvironmentMap(source=AssetSource(file="sky.hdr", sha256=sha256)))
        for sha256 in (hashlib.sha256(first).hexdigest(), hashlib.sha256(second).hexdigest(), "")
    ]
    assert not np.array_equal(lights[0], lights[1])
    assert np.array_equal(lights[0], lights[2])


def with_texel(texels, value):
    texels[5, 6, 1] = value
    return texels


BAD_MAPS = {
    "narrow.hdr": lambda texels: hdr_of(texels[:, :60]),
    "narrow.exr": lambda texels: exr_map(texels[:, :60]),
    "nan.exr": lambda texels: exr_map(with_texel(texels, np.nan)),
    "infinite.exr": lambda texels: exr_map(with_texel(texels, np.inf)),
    "black.hdr": lambda texels: hdr_of(0 * texels),
    "empty.hdr": lambda texels: b"",
    "cut.hdr": lambda texels: hdr_of(texels)[:-900],
    "cut.exr": lambda texels: exr_map(texels)[:-900],
    "header.hdr": lambda texels: hdr_of(texels).replace(b"-Y", b"?Y"),
    "other.hdr": lambda texels: b"<html>",
}


@pytest.mark.parametrize("name", BAD_MAPS)
def test_a_map_that_cannot_light_a_scene_is_refused_by_name(folder, rng, name):
    with pytest.raises(PhotoError, match=name):
        map_radiance(folder, name, BAD_MAPS[name](sky(rng)))


def test_an_ordinary_photo_saved_as_a_map_is_refused(folder, rng):
    """The maximum of an HDR map is in few texels, but here it is in an eighth of them."""
    encoded = (sky(rng) / 2).clip(0, 1)
    encoded[:4] = 1
    with pytest.raises(UnsupportedPhoto, match="clipped"):
        map_radiance(folder, "photo.hdr", hdr_of(to_linear(encoded)))


def test_a_picture_has_the_mean_luminance_of_the_scene(folder):
    light = plane_radiance(folder, "a.png", file_of(smooth(), "PNG"), luminance=4)
    assert light.shape == (48, 64, 3)
    assert light.dtype == np.float32
    assert luminance(light).mean() == pytest.approx(4, rel=2e-3)
    linear = to_linear(smooth() / 255)
    np.testing.assert_allclose(light / light.mean(), linear / linear.mean(), rtol=1e-3, atol=1e-4)


def test_highlights_raise_whites_and_nothing_else(folder):
    picture = smooth() // 2 + 40
    picture[:6, :6] = 255
    data = file_of(picture, "PNG")
    plain = plane_radiance(folder, "a.png", data)
    raised = plane_radiance(folder, "a.png", data, highlight_boost=9)
    factor = raised / plain
    np.testing.assert_allclose(factor[:6, :6], 10, rtol=1e-5)
    np.testing.assert_allclose(factor[6:], 1, rtol=1e-6)
    np.testing.assert_allclose(factor[:6, 6:], 1, rtol=1e-6)


def test_near_whites_are_raised_less_than_whites_and_keep_their_hue(folder):
    greys = np.linspace(150, 255, 64).astype(np.uint8)
    picture = np.broadcast_to(greys[:, None] * np.array([1, 0.9, 0.5]), (16, 64, 3)).astype(
        np.uint8
    )
    data = file_of(picture, "PNG")
    factor = plane_radiance(folder, "a.png", data, highlight_boost=5) / plane_radiance(
        folder, "a.png", data
    )
    np.testing.assert_allclose(factor, np.broadcast_to(factor[..., :1], factor.shape), rtol=1e-5)
    assert (np.diff(factor[0, :, 0]) >= -1e-6).all()
    assert factor[0, 0, 0] == pytest.approx(1)
    assert factor[0, -1, 0] == pytest.approx(6, rel=1e-5)


def test_a_black_picture_is_dark_and_finite(folder):
    light = plane_radiance(
        folder, "a.png", file_of(np.zeros((8, 8, 3), np.uint8), "PNG"), highlight_boost=3
    )
    assert not light.any()


def test_files_of_one_name_and_a_map_that_is_also_a_picture_are_cached_apart(tmp_path, rng):
    folders = [tmp_path / "one", tmp_path / "two"]
    sources = []
    for place in folders:
        data = hdr_of(sky(rng))
        place.mkdir()
        (place / "a.hdr").write_bytes(data)
        sources.append(AssetSource(file="a.hdr", sha256=hashlib.sha256(data).hexdigest()))
    shared = Assets(folders)
    for place, source in zip(folders, sources, strict=True):
        for content, radiance in (
            (EnvironmentMap(source=source), Assets.map_radiance),
            (Plane(source=source, distance_mm=1000, width_mm=1000), Assets.plane_radiance),
        ):
            np.testing.assert_array_equal(
                radiance(shared, content), radiance(Assets([place]), content)
            )


def test_the_luminance_of_the_scene_does_not_change_the_cached_map(folder, rng):
    (folder / "a.hdr").write_bytes(hdr_of(sky(rng)))
    assets = Assets([folder])
    bright, dim = (
        assets.map_radiance(EnvironmentMap(source=AssetSource(file="a.hdr"), luminance=value))
        for value in (8, 0.5)
    )
    np.testing.assert_allclose(bright, 16 * dim, rtol=1e-6)
