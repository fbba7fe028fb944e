"""The shipped models; and the card of a LoRA: metadata for the hub, text, and the Python example,
which is run.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from huggingface_hub import ModelCard
from PIL import Image

from brewster.diffusion.adapter.lora import add_lora, lora_parameters, save_lora
from brewster.diffusion.backbones.registry import BACKBONES, tiny
from brewster.diffusion.lora.model_card import card_text, with_benchmark_tables, write_card
from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.diffusion.pipeline import sample
from brewster.diffusion.prompt import PROMPT, PromptEmbedding
from brewster.diffusion.task import DecompositionTask, PanelLayout, conditioning_image, split
from brewster.errors import ModelError
from brewster.separation.models.zoo import MODELS, ModelFile
from brewster.training.recipe import read_recipe
from published_models import save_backbone
from set_folders import render_set

RECIPES = Path(__file__).parents[1] / "recipes" / "train"


def card(name="kontext", **changes):
    recipe = read_recipe(RECIPES / f"{name}.toml")
    changed = LoraRecipe.model_validate(recipe.model_dump(exclude_unset=True) | changes)
    return card_text(changed, scores={}, backbone_class=BACKBONES[name])


@pytest.mark.parametrize(
    ("name", "licence"), [("kontext", "other"), ("klein", "apache-2.0"), ("qwen", "apache-2.0")]
)
def test_the_hub_reads_base_and_licence(name, licence):
    read = ModelCard(card(name))
    metadata = read.data.to_dict()
    assert metadata["base_model"] == BACKBONES[name].hub_id
    assert (metadata["base_model_relation"], metadata["license"]) == ("adapter", licence)
    assert (metadata["library_name"], metadata["pipeline_tag"]) == ("diffusers", "image-to-image")
    assert "lora" in metadata["tags"]
    assert PROMPT in read.text
    assert ("**Not for commercial use.**" in read.text) == (licence == "other")
    finetune = ModelCard(card(name, backbone="some-body/finetune.2"))
    assert finetune.data.base_model == "some-body/finetune.2"


def test_datasets_are_listed_with_their_scenes_and_without_local_paths(tmp_path, monkeypatch):
    render_set(tmp_path / "sets" / "paper", count=3)
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path))
    listed = "`sets/paper` (3 samples of the scene recipe `tiny`, orders all)"
    assert listed in card()
    elsewhere = {"rendered": {"datasets": [str(tmp_path / "sets" / "paper")]}}
    assert "`paper` (3 samples" in card(data=elsewhere)
    assert str(tmp_path) not in card(data=elsewhere)


def test_benchmark_tables_replace_earlier_ones():
    once = with_benchmark_tables(card(), "| a | 1 |\n")
    twice = with_benchmark_tables(once, "### Real20\n\n| b | 2 |")
    assert "\n## Benchmark scores\n\n| a | 1 |\n\n## Limits\n" in once
    assert "\n## Benchmark scores\n\n### Real20\n\n| b | 2 |\n\n## Limits\n" in twice
    assert twice.partition("## Benchmark scores")[0] == card().partition("## Benchmark scores")[0]
    with pytest.raises(ModelError, match="has no section for benchmarks"):
        with_benchmark_tables("# somebody else's", "| a | 1 |")


@pytest.fixture
def exported(tmp_path):
    """Writes a base, a LoRA and its card for a layout. Returns brewster's T of a photo with
    them.
    """

    def export(name, layout):
        backbone, prompt = tiny(name, seed=1)
        save_backbone(backbone, tmp_path / "base")
        add_lora(backbone, rank=2, alpha=2)
        generator = torch.Generator().manual_seed(4)
        with torch.no_grad():
            for parameter in lora_parameters(backbone):
                parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
        save_lora(tmp_path / "lora", backbone, prompt, DecompositionTask(layout))
        changes = {
            "panels": list(layout.panels),
            "direction": layout.direction,
            "white_space": layout.white_space,
        }
        recipe = read_recipe(RECIPES / f"{name}.toml")
        recipe = recipe.model_copy(update=changes | {"max_composite_pixels": 64 * 64 * 3})
        write_card(tmp_path / "lora", recipe, {}, BACKBONES[name])
        picture = torch.randint(0, 256, (64, 64, 3), generator=generator, dtype=torch.uint8)
        Image.fromarray(picture.numpy()).save(tmp_path / "photo.png")
        photo = picture.permute(2, 0, 1)[None] / 127.5 - 1
        size = layout.composite_size((64, 64))
        return split(
            sample(backbone, conditioning_image(photo, layout), prompt, size=size), layout
        )["T"]

    return export


def run_example(folder, monkeypatch, name, **replaced):
    """Runs the Python example for diffusers in the card of the LoRA. Returns its T, (1, 3, h, w) in
    [-1, 1].
    """
    text = (folder / "lora" / "README.md").read_text()
    (code,) = (
        block for block in re.findall(r"```python\n(.*?)```", text, re.S) if "diffusers" in block
    )
    here = {BACKBONES[name].hub_id: "base", "cuda": "cpu", "photo.jpg": "photo.png", **replaced}
    for there, local in here.items():
        assert there in code
        code = code.replace(there, local)
    monkeypatch.chdir(folder)
    made = {}
    exec(compile(code, "README.md", "exec"), made)
    return torch.from_numpy(np.array(made["transmission"])).permute(2, 0, 1)[None] / 127.5 - 1


@pytest.mark.parametrize(("name", "layout"), [
    ("kontext", PanelLayout()), ("kontext", PanelLayout(white_space=False)),
    ("kontext", PanelLayout(("T", "I", "R"), "stacked")), ("klein", PanelLayout(("T", "R"))),
])  # fmt: skip
def test_the_python_example_of_the_card_generates_its_image(
    exported, tmp_path, monkeypatch, name, layout
):
    expected = exported(name, layout)
    picture = run_example(tmp_path, monkeypatch, name, bfloat16="float32")
    torch.testing.assert_close(picture, expected, atol=1.1 / 255, rtol=0)
    assert expected.std() > 0.01


def test_the_card_has_the_prompt_of_the_training(exported, tmp_path):
    exported("klein", PanelLayout())
    assert PROMPT in (tmp_path / "lora" / "README.md").read_text()
    prompt = PromptEmbedding("klein", "Take the glass away.", **tiny("klein")[1].tensors)
    prompt.save(tmp_path / "lora" / "prompt.safetensors")
    recipe = read_recipe(RECIPES / "klein.toml")
    for _ in range(2):
        write_card(tmp_path / "lora", recipe, {"loss": 1.0}, BACKBONES["klein"])
    text = (tmp_path / "lora" / "README.md").read_text()
    assert "> Take the glass away." in text
    assert PROMPT not in text
    with pytest.raises(ModelError, match="encoded for klein"):
        write_card(tmp_path / "lora", recipe, {}, BACKBONES["qwen"])


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
