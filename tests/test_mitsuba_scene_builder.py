import numpy as np

from brewster.render.mitsuba.scene_builder import sample_bilinear


def test_light_between_texels_is_interpolated_and_wraps_around():
    texels = np.arange(8, dtype=np.float32).reshape(2, 4, 1).repeat(3, 2)
    u_and_v = np.array([0.125, 0.25, 0.0]), np.array([0.0, 0.25, 0.5])
    assert sample_bilinear(texels, *u_and_v)[..., 0].tolist() == [[0, 0.5, 1.5], [0, 0.5, 1.5], [2, 2.5, 3.5]]
