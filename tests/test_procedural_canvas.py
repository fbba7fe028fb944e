"""Parts of the procedural environments: occlusion of surfaces, lamps, and the sun."""

import math

import numpy as np
import pytest
from numpy.random import PCG64, Generator

from brewster.environments.procedural.canvas import (
    Canvas,
    ProceduralEnvironment,
    Quad,
    render,
    resize,
    vector,
)
from brewster.environments.procedural.props import UP, EnvironmentLighting, Lamp
from brewster.environments.procedural.streets import street_environment


def even(points, _normal):
    return np.ones_like(points)


def wall(distance, grey):
    """A square wall straight ahead, seen under the same angle at any distance."""
    side = 2 * distance
    corner = vector(-distance, distance, -distance)
    return Quad(Canvas(side, side, 4, (grey,) * 3), corner, (vector(side, 0, 0), vector(0, -side, 0)), even)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_near_surface_hides_a_far_one_whichever_is_drawn_first(order):
    walls = wall(1.0, 0.25), wall(5.0, 0.75)
    picture = render(
        ProceduralEnvironment(
            [walls[i] for i in order], [], lambda directions, _: np.zeros_like(directions), 0.0
        ),
        32,
    )
    assert picture[16, 0].tolist() == [0.25] * 3
    assert set(np.unique(picture[10:22, :4])) == {0.25}


def lit(distance, normal, facing=None):
    """Light on a point below a lamp of 1 per steradian."""
    lamps = EnvironmentLighting(
        vector(0, 0, 0), floor_y_m=-2.0, lamps=[Lamp(UP * distance, vector(1, 1, 1), facing)]
    )
    return lamps(np.zeros((1, 1, 3), np.float32), normal)[0, 0, 0]


@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_a_lamp_lights_by_the_square_of_its_distance_and_the_cosine(distance):
    """Irradiance / pi = intensity cos / (pi distance^2)."""
    straight = 1 / (math.pi * distance**2)
    assert lit(distance, UP) == pytest.approx(straight, rel=1e-5)
    slanted = vector(math.sin(math.radians(60)), math.cos(math.radians(60)), 0)
    assert lit(distance, slanted) == pytest.approx(straight / 2, rel=1e-5)


def test_what_is_turned_away_from_a_lamp_or_behind_it_is_dark():
    assert lit(1.0, -UP) == 0
    assert lit(1.0, UP, facing=UP) == 0
    assert lit(1.0, UP, facing=-UP) == lit(1.0, UP)


def test_the_sun_is_half_a_degree_wide():
    sun = street_environment(Generator(PCG64(7)), night=False).emitters[-1]
    width = 2 * sun.radius / np.linalg.norm(sun.position)
    assert math.degrees(width) == pytest.approx(0.533, abs=0.01)


def test_a_ramp_stays_a_ramp_when_it_is_enlarged():
    ramp = np.arange(8, dtype=np.float32)[:, None]
    enlarged = resize(ramp, 32, 1)[:, 0]
    np.testing.assert_allclose(np.diff(enlarged[2:-2]), 0.25, atol=1e-6)
    assert enlarged.mean() == pytest.approx(ramp.mean())
