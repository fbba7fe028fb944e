"""The procedural environments by name, for machines without HDR maps: a street, a street at night, a room.

    environment_map = ENVIRONMENTS["street"](7, 512)  # (512, 1024, 3), linear radiance around the viewer

The same seed gives the same bytes. The radiance is relative, and its scale depends on the environment: a white sheet in the
shade has a radiance of about 1 on a street by day, less in a room, and far less on a street at night.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.random import PCG64, Generator
from numpy.typing import NDArray

from brewster.environments.procedural.canvas import render
from brewster.environments.procedural.rooms import room_environment
from brewster.environments.procedural.streets import street_environment


def street(seed: int, height: int) -> NDArray[np.float32]:
    """Returns a street by day, radiance (height, 2 height, 3).

    The sky has a radiance of .3 to 1. The sun, if no clouds hide it, has 1e3 to 1e5, and more in a larger map.
    """
    return render(street_environment(Generator(PCG64(seed)), night=False), height)


def street_at_night(seed: int, height: int) -> NDArray[np.float32]:
    """Returns a street at night, radiance (height, 2 height, 3).

    The ground has a radiance of .01 to .1 away from lamps, and the lamps 1e2 to 4e3.
    """
    return render(street_environment(Generator(PCG64(seed)), night=True), height)


def room(seed: int, height: int) -> NDArray[np.float32]:
    """Returns a furnished room, radiance (height, 2 height, 3).

    The walls have a radiance of .1 to 1, and more in sunlight. The lamps, if there are any, have 5 to 600.
    """
    return render(room_environment(Generator(PCG64(seed))), height)


ENVIRONMENTS: Final[dict[str, Callable[[int, int], NDArray[np.float32]]]] = {
    "street": street,
    "room": room,
    "night": street_at_night,
}
"""Functions (seed, height) by name. Each returns a lat-long map (height, 2 height, 3) in linear light."""
