import re
from pathlib import Path

import pytest
import torch

from brewster.errors import ModelError
from brewster.models.diffusion.prompt import PROMPT, PromptEmbedding, load_prompt

PAPER = Path(__file__).parents[2] / "shared" / "paper.tex"


@pytest.fixture
def prompt():
    torch.manual_seed(0)
    return PromptEmbedding("kontext", PROMPT, torch.randn(1, 6, 8).bfloat16(), torch.randn(1, 4))


@pytest.mark.skipif(not PAPER.is_file(), reason="the paper's source is not here")
def test_the_prompt_is_the_papers_word_for_word():
    box = re.search(r"title=PROMPT\]\n(.*?)\\end\{tcolorbox\}", PAPER.read_text(), re.S)[1]
    assert PROMPT.split() == box.split()


def test_a_saved_prompt_is_read_back_exactly(prompt, tmp_path):
    prompt.save(tmp_path / "prompt.safetensors")
    loaded = load_prompt(tmp_path / "prompt.safetensors", "kontext")
    assert (loaded.text, loaded.sha256, loaded.negative) == (PROMPT, prompt.sha256, None)
    assert torch.equal(loaded.embeds, prompt.embeds)
    assert loaded.embeds.dtype == torch.bfloat16
    assert torch.equal(loaded.pooled, prompt.pooled)


def test_the_same_prompt_gives_the_same_bytes(prompt, tmp_path):
    for name in "ab":
        prompt.save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    header = (tmp_path / "a").read_bytes()[8:].split(b"}")[0]
    assert header.index(b'"backbone"') < header.index(b'"kind"') < header.index(b'"sha256"')


def test_the_digest_depends_on_text_backbone_and_tensors(prompt):
    digests = {
        prompt.sha256,
        PromptEmbedding("qwen", PROMPT, prompt.embeds, prompt.pooled).sha256,
        PromptEmbedding("kontext", "a cat", prompt.embeds, prompt.pooled).sha256,
        PromptEmbedding("kontext", PROMPT, prompt.embeds + 1, prompt.pooled).sha256,
        PromptEmbedding("kontext", PROMPT, prompt.embeds).sha256,
    }
    assert len(digests) == 5


def test_a_prompt_of_another_backbone_is_refused(prompt, tmp_path):
    prompt.save(tmp_path / "p")
    with pytest.raises(ModelError, match="was encoded for kontext; expected a prompt for klein"):
        load_prompt(tmp_path / "p", "klein")


def test_a_prompt_that_was_changed_is_refused(prompt, tmp_path):
    prompt.save(tmp_path / "p")
    data = bytearray((tmp_path / "p").read_bytes())
    data[-1] ^= 1
    (tmp_path / "p").write_bytes(data)
    with pytest.raises(ModelError, match="does not have the digest in its metadata"):
        load_prompt(tmp_path / "p", "kontext")
