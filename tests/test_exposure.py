"""The exposures of the frames of a burst."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from brewster.film.motion.model.exposure import fitted_exposures
from simulated_bursts import linear_pictures

WALL, MIRRORED = linear_pictures((200, 150))
SHIFT_PX = 7


def shifted(image, pixels):
    return np.roll(image, pixels, axis=1)


def motion_to_first_frame(pixels):
    """In normalised coordinates, the frame moved by `pixels` to the right."""
    matrix = np.eye(3)
    matrix[0, 2] = -2 * pixels / WALL.shape[1]
    return matrix


FACTORS = st.lists(st.floats(0.5, 1.4), min_size=3, max_size=3)


@settings(max_examples=10, deadline=None)
@given(factors=FACTORS)
def test_exposure_and_white_balance_of_a_moved_frame_are_found_where_it_is_not_clipped(factors):
    window = 0.8 * WALL + 0.1 * MIRRORED
    moved = shifted(0.8 * WALL, SHIFT_PX) + 0.1 * shifted(MIRRORED, SHIFT_PX - 3)
    frames = [window, np.minimum(moved * np.float32(factors), 1)]
    motions = np.stack([np.eye(3), motion_to_first_frame(SHIFT_PX)])
    exposures = fitted_exposures(frames, 0, motions)
    np.testing.assert_allclose(exposures[0], 1)
    np.testing.assert_allclose(exposures[1], factors, rtol=0.02)


def test_the_exposures_of_black_and_of_clipped_frames_are_one():
    frames = [WALL, np.zeros_like(WALL), np.ones_like(WALL)]
    exposures = fitted_exposures(frames, 0, np.stack([np.eye(3)] * 3))
    np.testing.assert_allclose(exposures, 1)
