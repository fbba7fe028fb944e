"""Every setting is printed, and invalid settings are refused."""

import pytest

from brewster.errors import BrewsterError
from brewster.evaluate.config import EvaluationConfig
from brewster.metrics import METRICS


def test_an_unknown_metric_is_refused_with_the_name_that_was_meant():
    with pytest.raises(BrewsterError, match="did you mean psnr"):
        EvaluationConfig(metrics=("pnsr",))


@pytest.mark.parametrize(
    "wrong",
    [
        {"metrics": ()},
        {"metrics": ("psnr", "psnr")},
        {"thresholds": ()},
        {"thresholds": (0.1, 1.5)},
        {"size": 0},
    ],
)
def test_impossible_choices_are_refused(wrong):
    with pytest.raises(BrewsterError):
        EvaluationConfig(**wrong)


def test_several_thresholds_give_a_column_each():
    swept = EvaluationConfig(metrics=("psnr", "psnr_region"), thresholds=(0.05, 0.1))
    assert list(swept.columns()) == ["psnr", "psnr_region@0.05", "psnr_region@0.1"]
    assert swept.columns()["psnr_region@0.05"].title.endswith("> 0.05")
    assert [swept.threshold(column) for column in swept.columns()] == [0.05, 0.05, 0.1]
    assert list(EvaluationConfig(metrics=("psnr_region",)).columns()) == ["psnr_region"]


def test_every_choice_is_printed():
    said = " ".join(EvaluationConfig(size=420, quality="best", thresholds=(0.05, 0.2), paper=True).choices())
    for word in (
        "420 px",
        '"best"',
        "0.05 or 0.2",
        "seed 181",
        "bootstrap",
        "by name",
        "100 dB",
        "8-bit sRGB",
    ):
        assert word in said
    assert "nothing is resized" in EvaluationConfig().choices()[0]


def test_by_default_every_metric_but_the_second_ssim_is_measured():
    assert set(METRICS) - set(EvaluationConfig().metrics) == {"ssim_gaussian"}
