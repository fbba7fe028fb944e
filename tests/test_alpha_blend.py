import torch
from hypothesis import given
from hypothesis import strategies as st

from brewster.training.data.alpha_blend import blend

BYTES = st.integers(0, 255)


def constant_image(value):
    return torch.full((3, 2, 2), value / 255)


@given(BYTES, BYTES, st.floats(0.8, 1), st.floats(0.4, 1))
def test_a_blend_is_the_formula_in_eight_bits(t, r, alpha, beta):
    exact = alpha * t / 255 + beta * r / 255 - t * r / 255**2
    found = blend(constant_image(t), constant_image(r), alpha, beta)
    assert abs(found[0, 0, 0].item() - min(max(exact, 0), 1)) <= 0.5 / 255 + 1e-6


@given(BYTES)
def test_black_reflects_nothing(t):
    assert torch.equal(blend(constant_image(t), constant_image(0), 1.0, 0.7), constant_image(t))


@given(BYTES)
def test_white_behind_the_glass_hides_a_full_reflection(r):
    assert torch.allclose(blend(constant_image(255), constant_image(r), 1.0, 1.0), constant_image(255))
