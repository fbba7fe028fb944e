"""Every setting is described in the reports. Invalid settings are errors."""

import pytest

from brewster.errors import BrewsterError
from brewster.evaluate.config import EvaluationConfig


@pytest.mark.parametrize(
    "settings",
    [
        {"metrics": ()},
        {"metrics": ("psnr", "psnr")},
        {"threshold": 0.0},
        {"threshold": 1.5},
        {"short_side_px": 0},
    ],
)
def test_invalid_settings_are_an_error(settings):
    with pytest.raises(BrewsterError):
        EvaluationConfig(**settings)
