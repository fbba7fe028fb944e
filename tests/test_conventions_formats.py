"""Caches are keyed by format numbers: if an output changes, its format number must be increased.

Each test compares a small fixed output with the values that are stored here under the format
number. If a test fails because you changed the output on purpose, increase the number that the
message names, and store the new output under it (the test prints it). The tolerance covers
differences between processors.
"""

import hashlib
import re

import numpy as np
import pytest
from onnx import helper

from brewster import Photo
from brewster.evaluation.benchmarks.image_files import Case
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.methods import PREDICTION_FORMAT_VERSION, MethodOutput, ModelMethod
from brewster.evaluation.runner import SCORE_FORMAT_VERSION
from brewster.evaluation.scoring import GroundTruth, Scorer
from brewster.metrics import METRICS
from brewster.render.analytic import render
from brewster.render.camera_response import develop
from brewster.render.dataset.store import SAMPLE_FORMAT
from brewster.render.environments.assets import builtin_catalog
from brewster.render.scene.recipe import read_scene_recipe
from brewster.render.scene.sampler import draw
from brewster.separation import QUALITIES
from cli_helpers import write_onnx
from picture_files import smooth
from synthetic_scenes import ASSETS, make_scene, map_side, plane_side

PREDICTIONS = {
    2: {
        "draft": [
            7, 227, 149, 104, 59, 201, 163, 127, 35, 120, 191, 169,
            17, 96, 98, 71, 9, 131, 107, 82, 22, 85, 123, 111,
        ],
        "standard": [
            0, 227, 149, 102, 60, 202, 163, 127, 33, 119, 192, 169,
            17, 98, 98, 71, 4, 130, 106, 81, 23, 88, 120, 109,
        ],
    },
}  # fmt: skip
SCORES = {5: {
    "psnr": 20.003941, "ssim": 0.862947, "ssim_gaussian": 0.876058, "psnr_region": 19.012883,
    "ssim_region": 0.864838, "psnr_reflection": 16.204101, "ssim_reflection": 0.258754,
    "removed_content": 0.435374, "removed_white": 0.580899, "kept_reflection": 0.609849,
    "linear_rmse": 0.131727, "linear_rmse_reflection": 0.04864, "psnr_channels": 20.658735,
    "ssim_clipped": 0.876616,
}}  # fmt: skip
LPIPS = {5: {"lpips": 0.033937, "lpips_region": 0.035948, "lpips_reflection": 0.283549}}
SCENES = {3: {"tiny": "3dd102bf9cda151d", "window": "f21efae60db922de"}}
SAMPLES = {3: {
    "photo, light": [1.0143, 0.8571, 1.1205], "transmission, light": [0.7423, 0.6429, 0.8384],
    "background, light": [0.9394, 0.7656, 1.0188], "reflection, light": [0.2719, 0.2142, 0.2821],
    "mirror, light": [2.1322, 1.543, 2.0908],
    "photo": [0.6699, 0.6691, 0.6722, 0.6348, 0.6333, 0.636, 0.6028, 0.601, 0.6047],
    "transmission": [0.5879, 0.5871, 0.59, 0.5574, 0.5561, 0.5584, 0.5294, 0.528, 0.5309],
    "background": [0.6365, 0.6356, 0.6388, 0.6036, 0.6022, 0.6047, 0.5735, 0.5719, 0.5752],
    "reflection": [0.3521, 0.3517, 0.3533, 0.3312, 0.3302, 0.3321, 0.3125, 0.3111, 0.314],
    "mirror": [0.6659, 0.6653, 0.6679, 0.6292, 0.6274, 0.6306, 0.596, 0.5935, 0.5984],
}}  # fmt: skip


def check_output(name, number, stored, output, tolerance=0.0):
    """Compares an output (name -> numbers) with the output that is stored for this format
    number.
    """
    print(f"{number}: {output!r},")
    assert number in stored, f"{name} is {number}, but no output is stored for it"
    for part, values in stored[number].items():
        expected = pytest.approx(values, abs=tolerance) if tolerance else values
        assert output[part] == expected, (
            f"{part} changed: increase {name} ({number}), and store the new output"
        )


def make_image(seed, height=40, width=56):
    """An image with smooth colours and hard edges."""
    blocks = np.random.default_rng(seed).integers(0, 120, (height // 8, width // 8, 3))
    return (smooth(height, width) // 2 + np.kron(blocks, np.ones((8, 8, 1)))).astype(np.uint8)


def make_case(rendered=False):
    return Case("pairs", "a", "a", "a", *[None] * 3, rendered)


@pytest.fixture(scope="module")
def asymmetric_model(tmp_path_factory):
    """A model that weights the pixels to the left and above: other layers for a flipped or shifted
    photo.
    """
    shares = {"transmission": 0.7, "reflection": 0.2}
    kernels = {f"{name}_kernel": np.zeros((3, 1, 3, 3), np.float32) for name in shares}
    for kernel, share in zip(kernels.values(), shares.values(), strict=True):
        kernel[:, 0, 1, 1] = share
        kernel[:, 0, 1, 0] = 0.1
        kernel[:, 0, 0, 1] = 0.05
    nodes = [
        helper.make_node("Conv", ["photo", name], [name[:-7]], group=3, pads=[1] * 4)
        for name in kernels
    ]
    return write_onnx(tmp_path_factory.mktemp("model") / "asymmetric.onnx", nodes, kernels)


def test_a_changed_prediction_needs_a_new_prediction_format(asymmetric_model, tmp_path):
    photo = Photo.from_array(make_image(1, 720, 960), encoding="srgb")
    output = {}
    for quality in QUALITIES:
        method = ModelMethod("asymmetric", str(asymmetric_model), tmp_path, quality=quality)
        made = method.predict(make_case(), photo)
        layers = [layer.pixels[7::240, 9::240, 1] for layer in (made.transmission, made.reflection)]
        output[quality] = np.concatenate(layers).ravel().tolist()
    name = "evaluate.methods.PREDICTION_FORMAT_VERSION"
    check_output(name, PREDICTION_FORMAT_VERSION, PREDICTIONS, output, 1)


def compute_scores(names):
    photo = make_image(1)
    behind = (photo * 0.85).astype(np.uint8)
    mirrored = photo // 2
    behind[:, :20] = photo[:, :20]
    mirrored[:, :20] = 0  # no reflection at the left
    behind[:16, :16] = 220  # a white object
    pictures = {"photo": photo, "transmission": behind, "reflection": mirrored}
    truth = GroundTruth(
        make_case(rendered=True), Photo.from_array(photo, encoding="srgb"), pictures
    )
    prediction = np.roll(behind, 1, axis=1) // 2 + photo // 2
    layers = (Photo.from_array(layer, encoding="srgb") for layer in (prediction, photo // 7))
    return Scorer(truth, EvaluationConfig(metrics=names)).score(MethodOutput(*layers))


def test_a_changed_score_needs_a_new_score_format():
    # This image has no clipped light.
    others = ("lost_clipped", "lost_near_white", "near_white_cast")
    names = tuple(name for name in METRICS if not name.startswith("lpips") and name not in others)
    output = compute_scores(names)
    assert None not in output.values()
    check_output("evaluate.runner.SCORE_FORMAT_VERSION", SCORE_FORMAT_VERSION, SCORES, output, 2e-6)


def test_a_changed_lpips_needs_a_new_score_format(data, monkeypatch):
    monkeypatch.setenv("BREWSTER_DATA", str(data))
    names = tuple(name for name in METRICS if name.startswith("lpips"))
    name = "evaluate.runner.SCORE_FORMAT_VERSION"
    check_output(name, SCORE_FORMAT_VERSION, LPIPS, compute_scores(names), 1e-4)


def test_a_changed_scene_needs_a_new_sample_format():
    """If only the values of the packaged recipe `window` changed, store its new output under the
    same number: the recipe is in the record of a dataset, so a dataset of the old one is refused.
    """
    output = {}
    for name in ("tiny", "window"):
        recipe = read_scene_recipe(name)
        text = "".join(draw(recipe, builtin_catalog(), 7, index).to_toml() for index in range(20))
        text = re.sub(r'^version = ".*"\n', "", text, flags=re.MULTILINE)
        output[name] = hashlib.sha256(text.encode()).hexdigest()[:16]
    check_output("rendered.store.SAMPLE_FORMAT", SAMPLE_FORMAT, SCENES, output)


def test_a_changed_rendering_needs_a_new_sample_format():
    scene = make_scene(
        camera={"aperture_mm": 5.0},
        panes=[{"absorption_per_m": (20.0, 5.0, 10.0)}, {}],
        behind=plane_side("soft"),
        front=map_side("soft", radius_mm=4000.0, luminance=2.0),
        samples_per_pixel=4,
        seed=5,
    )
    sample = render(scene, ASSETS)
    output = {f"{name}, light": layer[:, 5, 17].tolist() for name, layer in sample.images().items()}
    images = develop(sample).images()
    output |= {name: layer[1, 3::9, 4::9].ravel().tolist() for name, layer in images.items()}
    rounded = {name: [round(value, 4) for value in values] for name, values in output.items()}
    check_output("rendered.store.SAMPLE_FORMAT", SAMPLE_FORMAT, SAMPLES, rounded, 2e-3)
