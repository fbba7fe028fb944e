"""Uploads to the hub: the files, the removal of local paths, and the errors."""

import hashlib
import json

import huggingface_hub
import pytest
from huggingface_hub import ModelCard

import fake_hub
from brewster.errors import DownloadError, ModelError
from brewster.models.diffusion.adapter.hub import FILES, plan_push, push
from brewster.models.diffusion.adapter.lora import LORA_FILE, add_lora, load_lora, save_lora
from brewster.models.diffusion.backbones.registry import BACKBONES, tiny
from brewster.models.diffusion.task import DecompositionTask
from brewster.models.diffusion.tensors import read_metadata, read_tensors
from brewster.training.lora.model_card import write_card
from brewster.training.recipe import LoraRecipe

pytestmark = pytest.mark.loopback

REPO = "somebody/some-lora"
VALUES = {
    "seed": 1, "steps": 6, "batch_size": 2, "learning_rate": 1e-2, "warmup_steps": 2, "weight_decay": 1e-4,
    "report_every": 6, "checkpoint_every": 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def tiny_model():
    backbone, prompt = tiny("kontext")
    add_lora(backbone, rank=2, alpha=2)
    return backbone, prompt


@pytest.fixture
def write_lora(tiny_model, tmp_path):
    """A function that writes a LoRA's folder as training does."""

    def write_lora(base_model="kontext", sets="sets/window"):
        folder = tmp_path / "lora"
        hub_id = BACKBONES["kontext"].hub_id if base_model == "kontext" else base_model
        save_lora(folder, *tiny_model, DecompositionTask(), base_model=hub_id)
        recipe = LoraRecipe.model_validate(
            VALUES | {"backbone": base_model, "data": {"rendered": {"datasets": [sets]}}}
        )
        (folder / "recipe.json").write_text(json.dumps(recipe.model_dump(mode="json"), indent=2))
        write_card(folder, recipe, {"loss": 1.0}, BACKBONES["kontext"])
        return folder

    return write_lora


@pytest.fixture
def hub(monkeypatch, tmp_path):
    with fake_hub.served() as hub:
        monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", hub.url)
        monkeypatch.setattr(huggingface_hub.constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
        monkeypatch.setenv("HF_TOKEN", hub.token)
        yield hub


def test_the_plan_has_the_four_files_unchanged(write_lora):
    folder = write_lora()
    (folder / "notes.txt").write_text("mine")
    plan = plan_push(folder, REPO)
    assert list(plan.files) == sorted(FILES, key=FILES.index)
    assert plan.files == {name: (folder / name).read_bytes() for name in FILES}
    assert plan.is_private
    assert plan.message == "LoRA of black-forest-labs/FLUX.1-Kontext-dev, rank 2"
    assert plan.remarks[1:] == ["not sent: notes.txt"]
    for file in plan.to_dict()["files"]:
        assert file["sha256"] == hashlib.sha256((folder / file["name"]).read_bytes()).hexdigest()
    assert all(name in plan.table() for name in FILES)


def test_local_paths_are_replaced_in_uploaded_files_and_the_lora_still_loads(
    write_lora, tmp_path, tiny_model
):
    base, sets = tmp_path / "models" / "flux", tmp_path / "secret" / "window"
    folder = write_lora(str(base), str(sets))
    before = {name: (folder / name).read_bytes() for name in FILES}
    plan = plan_push(folder, REPO)
    sent = plan.files
    assert all(str(tmp_path).encode() not in data for data in sent.values())
    recipe = json.loads(sent["recipe.json"])
    assert recipe["data"]["rendered"]["datasets"] == ["window"]
    assert recipe["backbone"] == BACKBONES["kontext"].hub_id
    assert json.loads(read_metadata(sent[LORA_FILE])["brewster"])["base_model"] == BACKBONES["kontext"].hub_id
    assert f"{sets} is replaced by window in the uploaded files" in plan.remarks
    assert before == {name: (folder / name).read_bytes() for name in FILES}
    for name, data in sent.items():
        (folder / name).write_bytes(data)
    card, _ = load_lora(folder, tiny("kontext")[0])
    assert card.base_model == BACKBONES["kontext"].hub_id
    whole, _ = read_tensors(folder / LORA_FILE)
    folder.joinpath(LORA_FILE).write_bytes(before[LORA_FILE])
    assert all((tensor == whole[name]).all() for name, tensor in read_tensors(folder / LORA_FILE)[0].items())


@pytest.mark.parametrize("home", ["/home/ann/photos", "/Users/ann/x.jpg", r"C:\Users\ann\x.jpg"])
def test_a_message_and_a_card_with_the_path_of_a_home_folder_are_refused(write_lora, home):
    folder = write_lora()
    with pytest.raises(ModelError, match=r"the commit message contains the path .*ann"):
        plan_push(folder, REPO, message=f"From {home}")
    with (folder / "README.md").open("a") as card:
        card.write(f"Trained on {home}, at night.\n")
    with pytest.raises(ModelError, match=r"README\.md contains the path .*ann"):
        plan_push(folder, REPO)


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(write_lora, name):
    folder = write_lora()
    (folder / name).unlink()
    with pytest.raises(ModelError, match=name):
        plan_push(folder, REPO)


@pytest.mark.parametrize(
    "front_matter", ["", "---\nlicense: mit\nlibrary_name: x\n---\n", "---\nlicense: [\n---\n"]
)
def test_a_card_without_valid_front_matter_is_refused(write_lora, front_matter):
    folder = write_lora()
    (folder / "README.md").write_text(f"{front_matter}# A card\n")
    with pytest.raises(ModelError, match="front matter"):
        plan_push(folder, REPO)


def test_another_prompt_is_refused(write_lora):
    folder = write_lora()
    tiny("kontext", seed=8)[1].save(folder / "prompt.safetensors")
    with pytest.raises(ModelError, match="not the prompt with which the LoRA was trained"):
        plan_push(folder, REPO)


def test_a_push_makes_a_private_repository_with_the_four_files_in_one_commit(write_lora, hub):
    plan = plan_push(write_lora(), REPO, message="First try")
    assert push(plan) == f"{hub.url}/{REPO}/commit/1"
    assert hub.repos == {REPO: plan.files}
    assert hub.private == {REPO: True}
    assert hub.messages == ["First try"]
    assert ModelCard(hub.repos[REPO]["README.md"].decode()).data.license == "other"
    push(plan_push(write_lora(), REPO, message="Again"))
    assert hub.messages == ["First try", "Again"]


def test_a_private_upload_to_a_public_repository_is_refused(write_lora, hub):
    push(plan_push(write_lora(), REPO, public=True))
    assert hub.private == {REPO: False}
    with pytest.raises(DownloadError, match=r"exists already and is public; .*; pass --public"):
        push(plan_push(write_lora(), REPO))
    assert len(hub.messages) == 1


def test_without_a_token_no_request_is_made(write_lora, hub, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(DownloadError, match=r"there is no token to write to .*; .*; create one at https"):
        push(plan_push(write_lora(), REPO))
    assert hub.requests == []


def test_a_dry_run_of_the_command_prints_the_plan_and_sends_nothing(run_without_model, write_lora, hub):
    folder = write_lora()
    code, out, err = run_without_model("models", "push", folder, REPO, "--dry-run")
    assert (code, hub.requests) == (0, [])
    assert out.decode().splitlines()[-1] == "nothing was sent"
    assert "not for commercial use" in err
    code, out, _ = run_without_model(
        "models", "push", folder, REPO, "--dry-run", "--json", "--public", "--message", "Hello"
    )
    plan = json.loads(out)
    assert (plan["address"], plan["private"], plan["message"]) == (None, False, "Hello")
    assert [file["name"] for file in plan["files"]] == list(FILES)


def test_the_command_sends_and_prints_the_address(run_without_model, write_lora, hub):
    code, out, _ = run_without_model("models", "push", write_lora(), REPO)
    assert code == 0
    assert out.decode().splitlines()[-1] == f"sent: {hub.url}/{REPO}/commit/1"
    assert set(hub.repos[REPO]) == set(FILES)
    hub.token = "hf_changed"
    code, _, err = run_without_model("models", "push", write_lora(), REPO)
    assert code == 1
    assert "error: the hub refused the token" in err


def test_the_card_of_a_folder_is_printed(run_without_model, write_lora):
    folder = write_lora()
    code, out, _ = run_without_model("models", "card", folder)
    assert (code, out.decode()) == (0, (folder / "README.md").read_text() + "\n")
