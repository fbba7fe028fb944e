"""Diffusion models in the Separator. Tiny random models test the code, a fake pipeline the
values.
"""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn import functional

from brewster import Photo, Separator
from brewster.diffusion.adapter.lora import LORA_FILE, add_lora, save_lora
from brewster.diffusion.backbones.registry import tiny
from brewster.diffusion.pipeline import fingerprint, load_pipeline
from brewster.diffusion.predictor import DiffusionPredictor
from brewster.diffusion.task import DecompositionTask, PanelLayout
from brewster.diffusion.tensors import read_tensors, write_tensors
from brewster.errors import DeviceError, DownloadError, ModelError
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.assessment import RECONSTRUCTION_ERROR_LIMIT
from picture_files import random_image
from published_models import hub_snapshot, save_backbone, with_random_lora

SMALL_COMPOSITE_PIXELS = 3 * 48 * 32


class FakePipeline:
    """A pipeline with T = 0.7 I and R = 0.3 I. It adds the constant `tint` to all encoded
    panels.
    """

    backbone = SimpleNamespace(size_divisor=16)

    def __init__(self, tint=0.0, panels=("I", "T", "R"), max_composite_pixels=3 * 96 * 96):
        self.task = DecompositionTask(PanelLayout(panels), max_composite_pixels)
        self.tint = tint
        self.calls = []

    def __call__(self, photo, *, steps, seeds, on_progress):
        self.calls.append((tuple(photo.shape[-2:]), steps, len(seeds)))
        light = to_linear((photo + 1) / 2)
        factors = {"I": 1.0, "T": 0.7, "R": 0.3}
        for step in range(steps):
            on_progress(step + 1, steps)
        return {
            name: self.generate(factors[name] * light, len(seeds))
            for name in self.task.layout.panels
        }

    def generate(self, light, count):
        return (2 * (to_encoded(light) + self.tint) - 1).clamp(-1, 1).expand(count, -1, -1, -1)


def smooth_photo(width, height):
    """Returns a photo of smooth colours that are neither near black nor near white."""
    coarse = torch.from_numpy(
        np.random.default_rng(1).uniform(0.15, 0.6, (4, 5, 3)).astype(np.float32)
    )
    planes = coarse.permute(2, 0, 1)[None]
    image = functional.interpolate(planes, (height, width), mode="bilinear", align_corners=True)[0]
    return Photo.from_array(image.permute(1, 2, 0).contiguous().numpy(), encoding="linear")


@pytest.fixture(scope="module")
def lora(tmp_path_factory):
    """A LoRA with random weights on a tiny version of the paper's backbone."""
    folder = tmp_path_factory.mktemp("kontext") / "lora"
    backbone, prompt = with_random_lora("kontext")
    task = DecompositionTask(max_composite_pixels=SMALL_COMPOSITE_PIXELS)
    save_lora(
        folder, backbone, prompt, task, base_model="tiny:kontext", target_modules=["*.attn.*"]
    )
    return folder


@pytest.mark.parametrize("tint", [-0.1, 0.0, 0.08])
def test_a_colour_shift_of_the_model_does_not_reach_the_layers(tint):
    photo = smooth_photo(300, 200)
    result = Separator(DiffusionPredictor(FakePipeline(tint)))(photo)
    error = np.abs(result.transmission.linear() - 0.7 * photo.linear()).mean()
    shifted = np.abs(
        to_linear(to_encoded(0.7 * photo.linear()) + tint) - 0.7 * photo.linear()
    ).mean()
    assert error < max(0.004, shifted / 2)
    assert result.reconstruction_error == pytest.approx(abs(tint), abs=0.004)
    assert (result.assessment.verdict == "doubtful") == (abs(tint) > RECONSTRUCTION_ERROR_LIMIT)
    low, high = {0.0: (245, 255), 0.08: (50, 150), -0.1: (0, 100)}[tint]
    assert low <= result.confidence.pixels.mean() <= high


def test_strength_zero_is_the_photo_and_half_is_halfway():
    photo = Photo.from_array(random_image(160, 240), encoding="srgb")
    separator = Separator(DiffusionPredictor(FakePipeline()))
    layers = [separator(photo, strength=strength).transmission for strength in (0, 0.5, 1)]
    assert (layers[0].pixels == photo.pixels).all()
    none, half, whole = (layer.linear() for layer in layers)
    np.testing.assert_allclose(half, (none + whole) / 2, atol=0.01)


def test_the_detail_of_the_photo_is_kept_unless_plain_is_set():
    rows = np.linspace(0.2, 0.5, 400, dtype=np.float32)[:, None, None]
    photo = Photo.from_array(np.broadcast_to(rows, (400, 400, 3)).copy(), encoding="linear")
    fine = photo.linear()
    fine[::2] *= 1.1  # lines of one pixel, which a panel of 96 px cannot resolve
    photo = Photo.from_array(fine, encoding="linear")
    guided, plain = (
        Separator(DiffusionPredictor(FakePipeline(), no_guided_upsampling=plain))(
            photo
        ).transmission.linear()
        for plain in (False, True)
    )
    contrast = [
        np.abs(np.diff(layer[100:-100], axis=0)).mean()
        / np.abs(np.diff(fine[100:-100], axis=0)).mean()
        for layer in (guided, plain)
    ]
    assert contrast[0] > 0.6
    assert contrast[1] < 0.1


@pytest.mark.parametrize(("quality", "steps"), [("draft", 4), ("standard", 20)])
def test_drafts_take_few_steps(quality, steps):
    pipeline = FakePipeline()
    Separator(DiffusionPredictor(pipeline, ensemble_size=2))(
        smooth_photo(400, 300), quality=quality
    )
    assert pipeline.calls == [((80, 112), steps, 2)]


@pytest.mark.parametrize(
    ("width", "height"), [(16, 16), (17, 40), (30, 20), (90, 21), (171, 16), (1000, 60)]
)
def test_photos_of_any_shape_keep_their_size(width, height):
    pipeline = FakePipeline(max_composite_pixels=3 * 128 * 128)
    result = Separator(DiffusionPredictor(pipeline))(smooth_photo(width, height))
    assert result.transmission.size == result.reflection.size == (width, height)
    np.testing.assert_allclose(result.transmission.linear(), 0.7 * result.photo.linear(), atol=0.02)


def test_without_a_reflection_panel_the_reflection_is_what_was_removed():
    photo = smooth_photo(100, 80)
    result = Separator(
        DiffusionPredictor(FakePipeline(panels=("T",), max_composite_pixels=96 * 96))
    )(photo)
    np.testing.assert_allclose(result.reflection.linear(), 0.3 * photo.linear(), atol=0.02)
    assert result.reconstruction_error is None
    assert result.assessment.verdict != "doubtful"
    assert (
        not result.confidence.pixels.any()
    )  # a confidence needs a reconstruction or several samples


def test_a_model_that_generates_nan_is_refused():
    class Broken(FakePipeline):
        def generate(self, light, count):
            return super().generate(light * float("nan"), count)

    with pytest.raises(ModelError, match="contains NaN or infinity; expected finite values"):
        Separator(DiffusionPredictor(Broken()))(smooth_photo(60, 40))


def test_a_reconstruction_above_white_is_clipped_before_its_error_is_measured():
    photo = Photo.from_array(np.full((64, 64, 3), 1.0, np.float32), encoding="linear")

    class Bright(FakePipeline):
        def generate(self, light, count):
            return super().generate(light + 0.4, count)

    assert (
        Separator(DiffusionPredictor(Bright(panels=("T", "R"))))(photo).reconstruction_error < 0.004
    )


def test_progress_rises_with_tiles_and_steps():
    pipeline = FakePipeline()
    progress = []
    pipeline.task = replace(pipeline.task, short_side_px=64, square_tiles=True)
    Separator(DiffusionPredictor(pipeline))(smooth_photo(400, 100), on_progress=progress.append)
    assert pipeline.calls == [((64, 64), 20, 1)] * 5
    assert progress == sorted(progress)
    assert progress[-1] == 1
    assert len(progress) > 5 * 20


@pytest.mark.parametrize(("objective", "options", "message"), [
    ("flow", {"steps": 0}, "expected both to be at least 1"),
    ("flow", {"ensemble_size": 0}, "expected both to be at least 1"),
    ("one_step", {"steps": 4}, "one-step model"),
    ("one_step", {"ensemble_size": 2}, "one-step model"),
])  # fmt: skip
def test_numbers_that_the_model_does_not_take_are_refused(objective, options, message):
    pipeline = FakePipeline()
    pipeline.task = replace(pipeline.task, objective=objective)
    with pytest.raises(ModelError, match=message):
        DiffusionPredictor(pipeline, **options)


def test_a_lora_is_loaded_by_its_folder(lora):
    separator = Separator.load(str(lora), steps=2)
    first = separator(smooth_photo(90, 60))
    again = Separator.load(str(lora), steps=2)(smooth_photo(90, 60))
    assert (separator.name, separator.device, len(separator.sha256)) == ("lora", "cpu", 64)
    assert (first.transmission.pixels == again.transmission.pixels).all()
    assert (first.transmission.pixels != first.photo.pixels).any()
    assert first.reconstruction_error is not None
    other = Separator.load(str(lora), steps=3)(smooth_photo(90, 60))
    assert (first.transmission.pixels != other.transmission.pixels).any()


def test_a_backbone_without_a_lora_generates_the_transmission_only():
    pipeline = load_pipeline("tiny:klein")
    assert pipeline.task.layout.panels == ("T",)
    generic = load_pipeline("tiny:klein", prompt="generic")
    assert generic.prompt.text == "Remove the reflection."
    assert generic.sha256 != pipeline.sha256
    result = Separator(DiffusionPredictor(pipeline, steps=1))(smooth_photo(40, 40))
    assert result.transmission.size == (40, 40)


def test_the_base_and_the_device_of_a_lora_are_checked(lora, tmp_path):
    with pytest.raises(ModelError, match="is a LoRA of kontext; expected a base model of kontext"):
        load_pipeline(str(lora), base_model="tiny:klein")
    with pytest.raises(
        DeviceError, match="do not run on coreml; expected one of auto, cuda, rocm, cpu"
    ):
        load_pipeline(str(lora), device="coreml")
    (tmp_path / "adapter_model.safetensors").touch()
    with pytest.raises(ModelError, match="brewster models import"):
        load_pipeline(str(tmp_path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rank": "4"}, "metadata of the LoRA cannot be read"),
        ({"more": 1}, "no field more"),
        ({"task": {"objective": "two"}}, "metadata of the LoRA cannot be read"),
        (
            {"task": {"layout": {"panels": ["I", "R"], "direction": "stacked"}}},
            "expected a list with T",
        ),
        ({"task": {"layout": {"panels": ["T", "T"], "direction": "stacked"}}}, "each once"),
    ],
)
def test_a_damaged_card_is_a_model_error(lora, tmp_path, change, message):
    tensors, metadata = read_tensors(lora / LORA_FILE)
    card = json.loads(metadata["brewster"])
    card |= change | {"task": card["task"] | change.get("task", {})}
    write_tensors(tmp_path / LORA_FILE, tensors, metadata | {"brewster": json.dumps(card)})
    with pytest.raises(ModelError, match=message):
        Separator.load(str(tmp_path))


def test_another_base_has_another_digest(lora, tmp_path):
    for seed in (0, 1):
        save_backbone(tiny("kontext", seed)[0], tmp_path / str(seed))
    digests = [fingerprint(str(lora))]
    digests += [load_pipeline(str(lora), base_model=str(tmp_path / name)).sha256 for name in "01"]
    assert len(set(digests)) == 3
    assert fingerprint(str(tmp_path / "0")) != fingerprint(str(tmp_path / "1"))
    assert Separator.load(str(lora), base_model=str(tmp_path / "1")).sha256 == digests[2]


@pytest.mark.parametrize("folder", ["compact", "kontext", "models"])
def test_local_folders_do_not_hide_models(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / folder).mkdir()
    assert Separator.load("compact").name == "compact"
    with pytest.raises(
        ModelError, match="there is no model 'models/mine'" if folder == "models" else "."
    ):
        Separator.load(f"{folder}/mine")


def test_the_path_of_a_base_that_has_moved_can_be_given(tmp_path):
    backbone, prompt = tiny("kontext")
    add_lora(backbone, rank=1, alpha=1)
    task = DecompositionTask(max_composite_pixels=SMALL_COMPOSITE_PIXELS)
    save_lora(tmp_path / "lora", backbone, prompt, task, base_model="/gone/kontext")
    with pytest.raises(
        ModelError, match=r"the base model of .* was /gone/kontext, which does not exist"
    ):
        Separator.load(str(tmp_path / "lora"))
    assert Separator.load(str(tmp_path / "lora"), base_model="tiny:kontext").name == "lora"


def test_options_of_diffusion_models_are_refused_for_other_models():
    with pytest.raises(
        ModelError, match="steps, no_guided_upsampling was set for the model compact"
    ):
        Separator.load("compact", steps=3, no_guided_upsampling=True)


def test_a_lora_is_opened_by_its_name_on_the_hub_from_the_cache(lora, tmp_path, monkeypatch):
    shutil.copytree(lora, hub_snapshot(tmp_path, "me/glass", monkeypatch))
    separator = Separator.load("me/glass", steps=1)
    assert separator.name == "glass"
    assert separator.sha256 == Separator.load(str(lora)).sha256
    with pytest.raises(DownloadError, match="me/other is not in the cache"):
        Separator.load("me/other")
