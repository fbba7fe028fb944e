import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from brewster.photo.srgb import to_encoded, to_linear


def test_the_transfer_function_passes_through_the_published_points():
    encoded = to_encoded(np.array([0.0, 0.0031308, 0.18, 1.0]))
    assert encoded == pytest.approx([0, 0.04045, 0.46136, 1], abs=1e-5)


@given(st.floats(-1, 60))
def test_decoding_inverts_encoding(value):
    assert to_linear(to_encoded(np.array(value))) == pytest.approx(value, rel=1e-6, abs=1e-7)


@given(st.lists(st.floats(-1, 60), min_size=2, max_size=20))
def test_encoding_is_monotonic(values):
    assert (np.diff(to_encoded(np.sort(np.array(values)))) >= 0).all()


def test_numpy_and_torch_agree():
    values = np.linspace(-0.5, 4, 1000, dtype=np.float32)
    np.testing.assert_allclose(
        to_encoded(torch.from_numpy(values)).numpy(), to_encoded(values), atol=1e-6
    )
    np.testing.assert_allclose(
        to_linear(torch.from_numpy(values)).numpy(), to_linear(values), atol=1e-5
    )


@pytest.mark.parametrize("curve", [to_linear, to_encoded])
def test_gradients_are_finite_even_in_black(curve):
    black = torch.zeros(3, requires_grad=True)
    curve(black).sum().backward()
    assert black.grad.isfinite().all()
