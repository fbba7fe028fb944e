import numpy as np
import pytest

from brewster.environments.procedural import registry
from brewster.environments.procedural.canvas import (
    Canvas,
    ProceduralEnvironment,
    Quad,
    SmallEmitter,
    directions,
    fractal,
    render,
    vector,
)
from brewster.environments.procedural.paintings import painting
from brewster.environments.procedural.registry import ENVIRONMENTS
from brewster.srgb import REC709_LUMINANCE

NAMES = sorted(ENVIRONMENTS)


def luminance(picture):
    return picture @ np.array(REC709_LUMINANCE, np.float32)


def dark(directions, _texel):
    return np.zeros_like(directions)


def solid_angles(height):
    return np.sin((np.arange(height) + 0.5) * np.pi / height)[:, None] * (np.pi / height) ** 2


@pytest.fixture(scope="module")
def both_maps():
    """Each environment, built once, since that takes a second, and rendered at two heights."""
    heights = 64, 128
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            registry, "render", lambda environment, _height: [render(environment, each) for each in heights]
        )
        return {name: ENVIRONMENTS[name](7, 0) for name in NAMES}


@pytest.fixture(scope="module")
def maps(both_maps):
    return {name: coarse for name, (coarse, _) in both_maps.items()}


@pytest.fixture(scope="module")
def fine_maps(both_maps):
    return {name: fine for name, (_, fine) in both_maps.items()}


def test_the_environments_are_the_three_that_recipes_name():
    assert NAMES == ["night", "room", "street"]


@pytest.mark.parametrize("name", NAMES)
def test_an_environment_is_a_lat_long_map_of_radiance(maps, name):
    picture = maps[name]
    assert picture.shape == (64, 128, 3)
    assert picture.dtype == np.float32
    assert np.isfinite(picture).all()
    assert picture.min() >= 0
    assert picture.max() > 0.1


@pytest.mark.parametrize("name", ["room", "night"])  # a street is a night street in other light
def test_a_seed_gives_the_same_bytes_and_another_seed_another_environment(maps, name):
    assert ENVIRONMENTS[name](7, 64).tobytes() == maps[name].tobytes()
    first, second = (np.log(picture + 0.01) for picture in (maps[name], ENVIRONMENTS[name](1, 64)))
    assert np.abs(first - second).mean() > 0.2


@pytest.mark.parametrize("name", NAMES)
def test_the_seam_is_like_any_other_pair_of_columns(maps, name):
    light = np.log(luminance(maps[name]) + 0.01)
    steps = np.abs(light - np.roll(light, -1, axis=1)).mean(axis=0)
    assert steps[-1] < np.quantile(steps, 0.97)


@pytest.mark.parametrize("name", NAMES)
def test_a_map_of_twice_the_height_shows_the_same_light(maps, fine_maps, name):
    coarse, fine = (luminance(picture) for picture in (maps[name], fine_maps[name]))
    energies = [(picture * solid_angles(len(picture))).sum() for picture in (coarse, fine)]
    assert energies[0] == pytest.approx(energies[1], rel=0.05)


def test_the_sun_outshines_the_sky_a_thousandfold(fine_maps):
    light = luminance(fine_maps["street"])
    assert 1e3 < light.max() / np.median(light[:32]) < 1e5


def test_lamps_of_a_room_outshine_its_walls(fine_maps):
    light = luminance(fine_maps["room"])
    assert light.max() > 50 * np.median(light)


@pytest.mark.parametrize("height", [32, 128, 512])
@pytest.mark.parametrize("aim", [(0, 0, -1), (0.6, 0.8, 0), (0.1, 1, 0.1), (0, -1, 0)])
def test_a_glow_keeps_its_energy_whatever_the_map_resolves(height, aim):
    position = np.array(aim, np.float32) / np.linalg.norm(aim) * 10
    picture = render(
        ProceduralEnvironment([], [SmallEmitter(position, 0.05, (1000, 0, 0))], dark, 0.5), height
    )
    energy = (picture[..., 0] * solid_angles(height)).sum()
    assert energy == pytest.approx(1000 * np.pi * 0.005**2, rel=1e-3)


def test_directions_follow_the_convention_of_maps():
    ways = directions(64, 0, 0, 64)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=2), 1, atol=1e-6)
    u = np.arctan2(ways[..., 0], -ways[..., 2]) / (2 * np.pi) % 1
    np.testing.assert_allclose(u, np.broadcast_to((np.arange(128) + 0.5) / 128, u.shape), atol=1e-5)
    v = np.arccos(ways[..., 1]) / np.pi
    np.testing.assert_allclose(v, np.broadcast_to((np.arange(64)[:, None] + 0.5) / 64, v.shape), atol=1e-4)


def test_a_quad_is_at_its_position_and_covers_its_solid_angle():
    """A square of 2 m x 2 m at a distance of 1 m is a face of a cube around the viewer: 1/6 of all directions."""
    canvas = Canvas(2, 2, 8, (0.5, 0.5, 0.5))
    canvas.rect(
        (1, 0, 1, 2), (1.0, 1.0, 1.0)
    )  # the right half, which is towards +z if the viewer looks at +x
    quad = Quad(
        canvas,
        vector(1, 1, -1),
        (vector(0, 0, 2), vector(0, -2, 0)),
        lambda points, _normal: np.ones_like(points),
    )
    picture = render(ProceduralEnvironment([quad], [], dark, 0), 64)[..., 0]
    assert ((picture > 0) * solid_angles(64)).sum() == pytest.approx(4 * np.pi / 6, rel=0.03)
    assert picture[32, 32 - 4] == 0.5
    assert picture[32, 32 + 4] == 1


def test_noise_tiles():
    noise = fractal(np.random.default_rng(3), 64, 96)
    inside = np.abs(np.diff(noise, axis=0)).mean()
    assert np.abs(noise[0] - noise[-1]).mean() < 2 * inside
    assert noise.mean() == pytest.approx(0, abs=1e-4)
    assert noise.std() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("seed", range(8))
def test_a_painting_is_a_picture_with_edges(seed):
    picture = painting(seed, 96, 64)
    assert picture.shape == (64, 96, 3)
    assert picture.dtype == np.float32
    assert 0 <= picture.min() < picture.max() <= 1
    assert np.abs(np.diff(luminance(picture), axis=1)).max() > 0.05
    assert picture.tobytes() == painting(seed, 96, 64).tobytes()


@pytest.mark.parametrize(("width", "height"), [(8, 8), (200, 16), (16, 200)])
def test_a_painting_has_any_shape(width, height):
    for seed in range(8):
        assert painting(seed, width, height).shape == (height, width, 3)
