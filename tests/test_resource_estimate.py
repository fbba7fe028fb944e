"""Estimates before spending, against what was counted and measured elsewhere (facts of the project)."""

from pathlib import Path

import pytest
import torch

from brewster.errors import DeviceError, ModelError
from brewster.training.lora.resource_estimate import CARDS, GraphicsCard, estimate_resources, find_card
from brewster.training.recipe import read_recipe, with_value

RECIPES = Path(__file__).parents[1] / "recipes" / "train"
CARD = CARDS["RTX 4090"]


@pytest.fixture(scope="module")
def klein():
    return estimate_resources(read_recipe(RECIPES / "klein.toml"), CARD)


def test_kleins_plan_fits_the_papers_card_with_the_sizes_that_are_known(klein):
    assert klein.panel == (512, 512)
    assert klein.generated_tokens == klein.condition_tokens == 3 * 32 * 32
    assert klein.parameters == pytest.approx(3.88e9, rel=0.01)
    assert klein.memory_gib["base"] == pytest.approx(7.2, abs=0.1)
    klein.check_fits()
    assert klein.total_gib < 16


def test_a_table_tells_tokens_memory_and_time(klein):
    table = klein.table()
    for told in (
        "3.88 billion",
        "rank 16",
        "3072 generated, 3072 condition, 512 text",
        "RTX 4090",
        "4000 steps",
        "estimate",
    ):
        assert told in table


def test_kontexts_plan_agrees_with_what_was_counted_for_the_paper():
    plan = estimate_resources(read_recipe(RECIPES / "kontext.toml"), CARD)
    assert plan.parameters == pytest.approx(11.9e9, rel=0.01)
    assert plan.memory_gib["base"] == pytest.approx(11.2, abs=0.2)
    assert plan.memory_gib["LoRA and AdamW"] == pytest.approx(1.3, abs=0.1)
    assert plan.memory_gib["activations"] == pytest.approx(3.7, abs=0.2)
    assert plan.tflop == pytest.approx(351, rel=0.01)
    assert 17 <= plan.total_gib <= 19


def test_a_photo_shown_alone_takes_a_third_of_the_tokens():
    recipe = with_value(read_recipe(RECIPES / "large-tiny.toml"), "panels", ["T", "R"])
    plan = estimate_resources(recipe, CARD)
    assert plan.generated_tokens == 2 * plan.condition_tokens
    both = estimate_resources(with_value(recipe, "panels", ["I", "T", "R"]), CARD)
    assert both.generated_tokens == both.condition_tokens


def test_what_does_not_fit_is_refused_with_what_would(klein):
    recipe = with_value(read_recipe(RECIPES / "klein.toml"), "budget_px", 768 * 256)
    for memory, cure in (
        (7, 'set quantise = "int8", which needs'),
        (5.5, 'set quantise = "nf4"'),
        (2, "lower budget_px"),
    ):
        plan = estimate_resources(recipe, GraphicsCard("toy card", memory, 100))
        with pytest.raises(
            DeviceError, match=f"klein needs about .* GiB; .* {memory} GiB of toy card; {cure}"
        ):
            plan.check_fits()


def test_cards_are_found_by_name_and_the_papers_stands_in_where_there_is_none(monkeypatch):
    assert find_card("rtx 4090") == CARD
    with pytest.raises(DeviceError, match=r"no card 'rtx 4099' .*; did you mean RTX 4090"):
        find_card("rtx 4099")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert find_card() == CARD


def test_a_backbone_that_nobody_knows_has_no_plan():
    with pytest.raises(ModelError, match="there is no backbone 'somebody/else'"):
        estimate_resources(with_value(read_recipe(RECIPES / "klein.toml"), "backbone", "somebody/else"), CARD)


def test_the_command_prints_the_plan_and_trains_nothing(bare, tmp_path):
    code, out, _ = bare("train", RECIPES / "large-tiny.toml", "--plan", "--card", "A100")
    assert code == 0
    assert b"A100" in out
    assert list(tmp_path.iterdir()) == []
    code, _, err = bare("train", RECIPES / "tiny.toml", "--plan")
    assert code != 0
    assert "train it without --plan" in err
