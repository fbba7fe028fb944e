"""The table of compact networks: what the trainer and the exported file require of a row."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from brewster.inference.onnx_backend import OnnxBackend
from brewster.models.compact import CompactNetwork
from brewster.models.networks import DEFAULT_NETWORK, MAX_STRIDE, NETWORKS, NetworkEntry
from brewster.training.compact.trainer import CompactTrainer
from brewster.training.loop import Checkpoint
from brewster.training.recipe import with_value
from training_helpers import ignore_step, train


class SmallNetwork(nn.Module):
    """A network of two convolutions at a stride of 4."""

    def __init__(self):
        super().__init__()
        self.encoder = nn.Conv2d(3, 8, 4, stride=4)
        self.head = nn.ConvTranspose2d(8, 6, 4, stride=4)

    def forward(self, photo_encoded):
        return self.head(self.encoder(photo_encoded)) + torch.cat([photo_encoded, 0 * photo_encoded], dim=1)


@pytest.fixture
def small_network(monkeypatch):
    monkeypatch.setitem(NETWORKS, "small", NetworkEntry(SmallNetwork, SmallNetwork))
    return "small"


@pytest.mark.parametrize("name", list(NETWORKS))
def test_every_network_takes_multiples_of_the_stride_and_returns_two_layers(name):
    entry = NETWORKS[name]
    random, pretrained = entry.build(), entry.pretrained()
    assert random.state_dict().keys() == pretrained.state_dict().keys()
    assert list(pretrained.get_submodule("encoder").parameters())
    assert random(torch.rand(2, 3, MAX_STRIDE, 2 * MAX_STRIDE)).shape == (2, 6, MAX_STRIDE, 2 * MAX_STRIDE)


def test_a_recipe_trains_and_exports_the_network_that_it_names_or_a_default(recipe, small_network, tmp_path):
    assert type(CompactTrainer(recipe).network) is CompactNetwork
    recipe = with_value(recipe, "network", small_network)
    assert isinstance(train(recipe, tmp_path, ignore_step), SmallNetwork)
    trainer = CompactTrainer(recipe)
    trainer.load_state_dict(Checkpoint.read(tmp_path / "checkpoint.pt").state)
    backend = OnnxBackend(trainer.export(tmp_path), "cpu")
    photo = torch.rand(8, 20, 3).numpy()
    transmission, reflection = backend(photo)
    assert transmission.shape == reflection.shape == photo.shape


def test_a_run_that_starts_from_a_model_needs_no_pretrained_weights(recipe, monkeypatch):
    def missing():
        raise AssertionError

    monkeypatch.setitem(NETWORKS, DEFAULT_NETWORK, replace(NETWORKS[DEFAULT_NETWORK], pretrained=missing))
    trainer = CompactTrainer(with_value(recipe, "init", "compact"))
    trainer.initialize()
    assert trainer.network.encoder.stem.conv.weight.abs().max() > 1  # random ones are smaller


def test_a_network_with_a_refiner_starts_from_a_model_without_one(recipe):
    trainer = CompactTrainer(with_value(with_value(recipe, "init", "compact"), "network", "lite2-refined"))
    trainer.initialize()
    refined, photo = trainer.ema_network(), torch.rand(1, 3, 64, 64)
    plain = CompactTrainer(with_value(recipe, "init", "compact"))
    plain.initialize()
    with torch.no_grad():
        torch.testing.assert_close(refined(photo), plain.ema_network()(photo))
