import os
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from brewster.errors import DeviceError, ModelError
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation import onnx_backend
from brewster.separation.models.compact import with_imagenet_features
from brewster.separation.models.linear_separator import LinearSeparator
from brewster.separation.models.networks import DEFAULT_NETWORK, NETWORKS
from brewster.separation.onnx_backend import OnnxBackend, available_devices
from brewster.training.compact.export import export_onnx, read_weights
from other_processes import finished


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(1)
    network = with_imagenet_features().eval()
    for convolution in (network.head, *network.hints):
        torch.nn.init.normal_(convolution.weight, std=0.1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(parameter.half())  # the precision of the file
    return network


@pytest.fixture(scope="module")
def model_file(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.onnx"
    export_onnx(network, path, NETWORKS[DEFAULT_NETWORK])
    return path


@pytest.mark.parametrize("size", [(64, 96), (160, 32), (320, 448)])
@pytest.mark.parametrize("has_hints", [True, False])
def test_the_exported_model_equals_the_network_at_any_size_and_with_hints(
    network, model_file, size, has_hints
):
    rng = np.random.default_rng(3)
    tile = rng.random((*size, 3), np.float32)
    hints = rng.random((*size, 2), np.float32)
    tensors = [torch.from_numpy(image).permute(2, 0, 1)[None] for image in (tile, hints)]
    with torch.no_grad():
        expected = LinearSeparator(network, to_encoded, to_linear)(*tensors[: 1 + has_hints])
    layers = OnnxBackend(model_file, "cpu")(tile, hints if has_hints else None)
    for layer, expected_layer in zip(layers, expected, strict=True):
        np.testing.assert_allclose(layer, expected_layer[0].permute(1, 2, 0).numpy(), atol=5e-4)


def test_the_weights_are_read_from_the_file_by_their_names(network, model_file):
    """The exporter stores no tensor of zeros: it keeps its initial value, zero, after reading."""
    weights = read_weights(model_file)
    assert weights.keys() <= network.state_dict().keys()
    named = {name: value for name, value in network.named_parameters() if value.any()}
    assert {"head.weight", "hints.0.weight", "encoder.stem.conv.weight"} <= named.keys()
    for name, parameter in named.items():
        assert torch.equal(weights[name], parameter)


def test_the_file_contains_no_paths_of_the_machine_that_wrote_it(model_file):
    assert not [
        path for path in (b"site-packages", b"/src/brewster") if path in model_file.read_bytes()
    ]


@pytest.mark.parametrize("size", [(1, 1), (33, 31), (5, 200)])
def test_layers_have_the_size_of_the_tile_if_its_sides_are_not_multiples_of_the_stride(
    model_file, size
):
    for layer in OnnxBackend(model_file, "cpu")(np.full((*size, 3), 0.5, np.float32)):
        assert (layer.shape, np.isfinite(layer).all()) == ((*size, 3), True)


def test_threads_that_share_a_backend_get_the_same_outputs(model_file):
    backend = OnnxBackend(model_file, "cpu")
    tiles = [np.random.default_rng(seed).random((64, 64, 3), np.float32) for seed in range(4)]
    expected = [backend(tile)[0] for tile in tiles]
    with ThreadPoolExecutor(4) as pool:
        outputs = list(pool.map(lambda tile: backend(tile)[0], tiles))
    assert all(map(np.array_equal, outputs, expected))


def test_onnx_runtime_collects_no_telemetry(tmp_path):
    code = "from brewster import Separator; Separator.load(device='cpu')"
    process = finished(
        [sys.executable, "-c", code], env=os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    )
    assert process.returncode == 0, process.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_unavailable_device_is_an_error_with_the_command_that_installs_it(model_file):
    unavailable = "cuda" if "cuda" not in available_devices() else "coreml"
    with pytest.raises(DeviceError, match="pip install onnxruntime"):
        OnnxBackend(model_file, unavailable)
    with pytest.raises(DeviceError, match="one of auto"):
        OnnxBackend(model_file, "unknown")


def test_a_device_that_does_not_start_is_an_error_and_auto_skips_it(model_file, monkeypatch):
    """With onnxruntime-gpu and no driver, the provider is listed, but its session runs on the
    CPU.
    """
    providers = ["AzureExecutionProvider", "CPUExecutionProvider"]
    ort = onnx_backend.ort
    monkeypatch.setitem(
        onnx_backend._PROVIDERS, "cuda", (providers[0], "pip install onnxruntime-gpu")
    )
    monkeypatch.setattr(ort, "get_available_providers", lambda: providers)
    monkeypatch.setattr(ort.InferenceSession, "get_providers", lambda self: providers[1:])
    with pytest.raises(DeviceError, match="does not start"):
        OnnxBackend(model_file, "cuda")
    assert OnnxBackend(model_file, "auto").device == "cpu"
    create = onnx_backend._create_session

    def fail_on_the_gpu(model, data, device):
        if device == "cuda":
            raise ModelError("the provider failed", "expected a GPU", "install a driver")
        return create(model, data, device)

    monkeypatch.setattr(onnx_backend, "_create_session", fail_on_the_gpu)
    with pytest.raises(DeviceError, match="does not start"):
        OnnxBackend(model_file, "cuda")
    assert OnnxBackend(model_file, "auto").device == "cpu"


@pytest.mark.parametrize(("value", "threads"), [("3", 3), ("2,1", 2), ("", 0), ("many", 0)])
def test_a_session_has_the_threads_of_the_environment_or_one_for_each_core(
    monkeypatch, model, value, threads
):
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    create = onnx_backend.ort.InferenceSession
    given = []

    def record(data, options, *args, **more):
        given.append(options.intra_op_num_threads)
        return create(data, options, *args, **more)

    monkeypatch.setattr(onnx_backend.ort, "InferenceSession", record)
    OnnxBackend(model, "cpu")
    assert given == [threads]
