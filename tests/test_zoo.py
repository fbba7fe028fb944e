from dataclasses import replace

import pytest

from brewster.errors import ModelError
from brewster.models.zoo import MODELS, ModelFile


def test_every_shipped_model_is_intact_small_enough_and_has_a_card():
    assert "compact" in MODELS
    for model in MODELS.values():
        assert model.verify() == model.sha256
        assert model.path.stat().st_size <= 25e6
        card = model.card()
        for heading in ("Licence", "Trained on", "Scores", "Where it fails"):
            assert heading in card, (model.name, heading)


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(ModelError, match="cannot be read"):
        ModelFile("pane", tmp_path, None, "unknown").verify()


def test_a_damaged_file_is_refused(tmp_path):
    broken = tmp_path / "compact.onnx"
    broken.write_bytes(MODELS["compact"].path.read_bytes()[:-1])
    with pytest.raises(ModelError, match="SHA-256"):
        replace(MODELS["compact"], path=broken).verify()
