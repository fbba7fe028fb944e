import re
from pathlib import Path

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from brewster.diffusion.prompt import PROMPT, PromptEmbedding, load_prompt
from brewster.diffusion.task import (
    PanelLayout,
    compose,
    conditioning_image,
    fit_panel,
    split,
)
from brewster.errors import ModelError, PhotoError, RecipeError

LAYOUTS = [
    PanelLayout(panels, direction)
    for panels in [("I", "T", "R"), ("T", "R"), ("R", "I", "T"), ("T",)]
    for direction in ["side by side", "stacked"]
]
layouts = st.sampled_from(LAYOUTS)
sides = st.integers(1, 9)


@given(layouts, sides, sides, st.integers(0, 2**31))
def test_splitting_is_the_exact_inverse_of_composing(layout, height, width, seed):
    generator = torch.Generator().manual_seed(seed)
    panels = {name: torch.randn(2, 3, height, width, generator=generator) for name in layout.panels}
    composite = compose(panels, layout)
    assert tuple(composite.shape[:-3:-1]) == layout.composite_size((width, height))
    panels_again = split(composite, layout)
    assert list(panels_again) == list(layout.panels)
    assert all(torch.equal(panels_again[name], panels[name]) for name in panels)
    assert torch.equal(compose(panels_again, layout), composite)


def test_the_conditioning_image_is_the_photo_and_white_space():
    photo = torch.rand(1, 3, 4, 5) - 1
    panels = split(conditioning_image(photo, PanelLayout()), PanelLayout())
    assert torch.equal(panels["I"], photo)
    assert panels["T"].eq(1).all()
    assert panels["R"].eq(1).all()


def test_without_a_generated_photo_the_conditioning_image_is_the_photo():
    photo = torch.rand(1, 3, 4, 5)
    assert torch.equal(conditioning_image(photo, PanelLayout(("T", "R"))), photo)
    assert torch.equal(conditioning_image(photo, PanelLayout(white_space=False)), photo)


def test_the_papers_composite_is_three_squares_of_512_pixels():
    fit = fit_panel((2000, 2000), PanelLayout(), max_composite_pixels=1536 * 512, size_divisor=16)
    assert fit.panel == (512, 512)


@given(
    *[st.integers(1, 9000)] * 2, layouts, st.integers(1000, 2_000_000), st.sampled_from([8, 16, 32])
)
def test_any_photo_fits_without_distortion_or_is_refused(
    width, height, layout, max_pixels, multiple
):
    try:
        fit = fit_panel(
            (width, height), layout, max_composite_pixels=max_pixels, size_divisor=multiple
        )
    except PhotoError:
        assume(False)
    composite = layout.composite_size(fit.panel)
    assert composite[0] * composite[1] <= max_pixels
    padding = [panel - content for panel, content in zip(fit.panel, fit.content, strict=True)]
    assert min(padding) == 0
    assert 0 <= max(padding) <= multiple / 2 + 0.5
    assert all(side % multiple == 0 for side in fit.panel)
    scales = [content / side for content, side in zip(fit.content, (width, height), strict=True)]
    assert max(scales) <= 1
    # One side determines the scale; the other is rounded to the nearest pixel.
    sides = list(zip(fit.content, (width, height), strict=True))
    assert any(
        all(abs(content - scale * side) <= 0.501 for content, side in sides) for scale in scales
    )
    image = torch.rand(1, 1, fit.content[1], 1).expand(1, 1, fit.content[1], fit.content[0])
    if fit.panel[0] * fit.panel[1] < 200_000:
        assert torch.equal(fit.crop(fit.pad(image)), image)


@given(st.integers(1500, 4000), st.integers(1500, 4000), layouts, st.integers(10_000, 2_000_000))
def test_the_next_larger_panel_would_exceed_the_budget(width, height, layout, max_composite_pixels):
    try:
        fit = fit_panel(
            (width, height), layout, max_composite_pixels=max_composite_pixels, size_divisor=16
        )
    except PhotoError:
        assume(False)
    short = min(fit.panel) + 16
    long = round(short * max(width, height) / min(width, height) / 16) * 16
    assert short * long * len(layout.panels) > max_composite_pixels


@given(st.integers(16, 500), st.integers(16, 500), layouts)
def test_a_photo_smaller_than_its_panel_gets_a_smaller_panel(width, height, layout):
    fit = fit_panel((width, height), layout, max_composite_pixels=10**7, size_divisor=16)
    assert fit.content[0] <= width
    assert fit.content[1] <= height


def test_padding_is_a_mirrored_copy_of_the_border():
    fit = fit_panel((100, 61), PanelLayout(("T",)), max_composite_pixels=48 * 80, size_divisor=16)
    assert (fit.content, fit.panel) == ((79, 48), (80, 48))
    image = torch.rand(1, 3, 48, 79)
    assert torch.equal(fit.pad(image)[..., 79], image[..., 77])


@pytest.mark.parametrize("panels", [(), ("I", "I"), ("I", "B")])
def test_unknown_repeated_and_missing_panels_are_refused(panels):
    with pytest.raises(RecipeError, match="expected one or more of I, T and R, each once"):
        PanelLayout(panels)


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
