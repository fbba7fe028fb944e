import torch
from hypothesis import given
from hypothesis import strategies as st

from brewster.training.data.rendered import blend

BYTES = st.integers(0, 255)


def constant_image(value):
    return torch.full((3, 2, 2), value / 255)


@given(BYTES, BYTES, st.floats(0.8, 1), st.floats(0.4, 1))
def test_a_blend_is_the_formula_in_eight_bits(t, r, alpha, beta):
    exact = alpha * t / 255 + beta * r / 255 - t * r / 255**2
    found = blend(constant_image(t), constant_image(r), alpha, beta)
    assert abs(found[0, 0, 0].item() - min(max(exact, 0), 1)) <= 0.5 / 255 + 1e-6
