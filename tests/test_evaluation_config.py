"""Every setting is described in the reports. Invalid settings are errors."""

import pytest

from brewster.errors import BrewsterError
from brewster.evaluate.config import EvaluationConfig


@pytest.mark.parametrize(
    "settings",
    [
        {"metrics": ()},
        {"metrics": ("psnr", "psnr")},
        {"thresholds": ()},
        {"thresholds": (0.1, 1.5)},
        {"short_side_px": 0},
    ],
)
def test_invalid_settings_are_an_error(settings):
    with pytest.raises(BrewsterError):
        EvaluationConfig(**settings)


def test_several_thresholds_give_a_column_each():
    config = EvaluationConfig(metrics=("psnr", "psnr_region"), thresholds=(0.05, 0.1))
    assert list(config.columns()) == ["psnr", "psnr_region@0.05", "psnr_region@0.1"]
    assert config.columns()["psnr_region@0.05"].title.endswith("> 0.05")
    assert [config.threshold(column) for column in config.columns()] == [0.05, 0.05, 0.1]
    assert list(EvaluationConfig(metrics=("psnr_region",)).columns()) == ["psnr_region"]
