"""The parts of the loss, compared with values computed by hand."""

import math
from dataclasses import replace

import pytest
import torch

from brewster.errors import ModelError
from brewster.training.data.mixtures import TrainingBatch
from brewster.training.losses import check_finite, exposure_ratio, psnr_gain_db, separation_loss


def make_batch(level=0.4, weight=1.0):
    """Returns two samples of 32 px. Photo, transmission and reflection have the same grey."""
    grey = torch.full((2, 3, 32, 32), level)
    return TrainingBatch(grey, grey, grey, torch.full((2,), weight))


def loss_of(transmission_error=0.0, reflection_error=0.0, *, weight=1.0):
    """Returns the parts of the loss of a prediction with constant errors."""
    batch = make_batch(weight=weight)
    zero = torch.zeros_like(batch.photo_encoded)
    layers = [batch.transmission_encoded + transmission_error, batch.reflection_encoded + reflection_error]
    parts = separation_loss(torch.cat([layer + zero for layer in layers], dim=1), batch)
    return {name: float(part) for name, part in parts.items()}


def test_an_even_error_counts_once_at_each_of_three_scales():
    parts = loss_of(transmission_error=0.1)
    assert parts["transmission"] == pytest.approx(3 * 0.1, rel=1e-5)
    assert parts["edges"] == pytest.approx(0, abs=1e-6)
    assert parts["reflection"] == 0


def test_the_weight_of_an_image_scales_only_its_own_reflection():
    """A batch mixes samples with and without a known reflection."""
    batch = make_batch()
    batch = replace(batch, reflection_weight=torch.tensor([1.0, 0.0]))
    wrong = batch.reflection_encoded.clone()
    wrong[1] += 0.1
    for reflection, expected in ((wrong, 0), (wrong.flip(0), 0.3 * 3 * 0.1 / 2)):
        layers = torch.cat([batch.transmission_encoded, reflection], dim=1)
        assert float(separation_loss(layers, batch)["reflection"]) == pytest.approx(expected, rel=1e-4)


def test_fine_stripes_count_at_the_finest_scale_only_and_as_edges():
    stripes = torch.tensor([0.1, -0.1]).repeat(16)  # neighbours differ by 0.2, means of 4 and of 16 are 0
    for error in (stripes, stripes[:, None]):
        parts = loss_of(transmission_error=error)
        assert parts["transmission"] == pytest.approx(0.1, rel=1e-5)
        assert parts["edges"] == pytest.approx(0.2, rel=1e-5)


def test_stripes_of_two_pixels_count_as_edges_at_each_scale_at_which_they_are_visible():
    stripes = torch.tensor([0.1, 0.1, -0.1, -0.1]).repeat(8)
    batch = make_batch()
    layers = torch.cat([batch.transmission_encoded + stripes, batch.reflection_encoded], dim=1)
    parts = [separation_loss(layers, batch, 6.0, scales) for scales in ((1,), (2,), (4,), (1, 2, 4))]
    # 15 of 31 neighbours differ by 0.2; all 15 neighbours of the means of 2 differ; the means of 4 are 0.
    expected = [6 * 0.2 * 15 / 31, 6 * 0.2, 0, 6 * 0.2 * (15 / 31 + 1)]
    assert [float(part["edges"]) for part in parts] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_the_logarithm_of_the_squared_error_is_limited_at_40_db():
    for error in (0.1, 0.0):
        expected = 0.04 * math.log(error**2 + 0.0001)
        assert loss_of(transmission_error=error)["log_mse"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("photo", "truth", "expected"), [(1.0, 1.0, 3 * 0.2), (0.9, 1.0, 0.0), (1.0, 0.9, 0.0)]
)
def test_an_error_counts_as_clipped_only_where_photo_and_transmission_are_white(photo, truth, expected):
    batch = replace(make_batch(truth), photo_encoded=make_batch(photo).photo_encoded)
    layers = torch.cat([batch.transmission_encoded - 0.2, batch.reflection_encoded], dim=1)
    clipped = separation_loss(layers, batch, clipped_weight=3.0)["clipped"]
    assert float(clipped) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("truth", "expected"), [(1.0, 0.0), (0.9, 3 * 0.2)])
def test_light_above_white_is_an_error_only_where_the_true_light_is_known(truth, expected):
    batch = make_batch(truth)
    layers = torch.cat([batch.transmission_encoded + 0.2, batch.reflection_encoded], dim=1)
    assert float(separation_loss(layers, batch)["transmission"]) == pytest.approx(expected, abs=1e-6)


def test_a_tenth_of_the_error_is_a_gain_of_twenty_decibels():
    ground_truth = torch.full((1, 3, 8, 8), 0.5)
    assert psnr_gain_db(ground_truth + 0.02, ground_truth + 0.2, ground_truth) == pytest.approx(20, abs=1e-3)
    assert psnr_gain_db(ground_truth + 0.2, ground_truth + 0.02, ground_truth) == pytest.approx(-20, abs=1e-3)


def test_the_exposure_ratio_is_the_ratio_of_light_where_the_glass_added_none():
    """A white spot was added to one corner; elsewhere the prediction has half of the photo's light."""
    ground_truth = torch.full((1, 3, 8, 8), 0.5)
    photo = ground_truth.clone()
    prediction = torch.full_like(ground_truth, 0.3611)  # half the linear light of 0.5
    photo[..., :2, :2] = 1
    prediction[..., :2, :2] = 1
    assert exposure_ratio(prediction, photo, ground_truth) == pytest.approx(0.5, abs=1e-3)
    assert exposure_ratio(prediction, torch.ones_like(ground_truth), ground_truth) == 1


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_value_that_is_not_finite_is_refused(value):
    with pytest.raises(ModelError, match=r"gradient is .* at step 7"):
        check_finite(torch.tensor(value), 7, "gradient")
    assert check_finite(torch.tensor(1.0), 7) == 1
