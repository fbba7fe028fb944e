"""Writes the model card of a LoRA, a README.md for the hub: licence, prompt, use, data, settings,
scores, limits.

It depends on the recipe, the prompt, the log and the records of rendered datasets only, not on the
machine.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from brewster.base.files import write_atomically
from brewster.diffusion.backbones.backbone import APACHE_2, Backbone
from brewster.diffusion.backbones.registry import BACKBONES
from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.diffusion.model_table import TINY_PREFIX
from brewster.diffusion.prompt import PROMPT, PROMPT_FILE, load_prompt
from brewster.errors import BrewsterError, ModelError
from brewster.render.dataset.generation.job import RECORD_FILE
from brewster.render.dataset.store import read_dataset
from brewster.training.streams import resolve_folders

CARD_FILE: Final = "README.md"
_TEMPLATE: Final = "model_card.md.jinja"
_BENCHMARK_HEADING: Final = "## Benchmark scores"
_SCORE_TITLES: Final = {
    "psnr_gain_db_": "PSNR gain over the input, {}, dB",
    "loss_panel_": "loss, panel {}",
}
"""Prefix of a name in the log -> its title in the card, with the rest of the name."""


def write_card(
    folder: Path, recipe: LoraRecipe, scores: Mapping[str, float], backbone_class: type[Backbone]
) -> None:
    """Writes or replaces the model card in a folder that contains the LoRA and its prompt. `scores`
    is the last line of the run's log. Raises ModelError if the prompt is missing, damaged, or of
    another backbone.
    """
    prompt = load_prompt(folder / PROMPT_FILE, backbone_class.name).text
    text = card_text(recipe, scores=scores, backbone_class=backbone_class, prompt=prompt)
    write_atomically(folder / CARD_FILE, text.encode(), overwrite=True)


def card_text(
    recipe: LoraRecipe,
    *,
    scores: Mapping[str, float],
    backbone_class: type[Backbone],
    prompt: str = PROMPT,
) -> str:
    """Returns the model card, Markdown, of a LoRA; `scores` is the last line of the run's log."""
    import jinja2  # noqa: PLC0415  (an extra)

    is_tiny = recipe.backbone.startswith(TINY_PREFIX)
    base = backbone_class.hub_id
    # A local folder counts as a copy of its backbone on the hub.
    is_hub_id = (
        re.fullmatch(r"[\w.-]+/[\w.-]+", recipe.backbone) and not Path(recipe.backbone).exists()
    )
    if is_hub_id and recipe.backbone not in BACKBONES:
        base = recipe.backbone
    # The example is a large square photo, whose panels fill the pixel budget best
    width, height = panel_size = recipe.task.fit((4096, 4096), backbone_class.size_divisor).panel
    environment = jinja2.Environment(  # noqa: S701  (Markdown, not HTML)
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    # JSON is valid YAML.
    environment.filters |= {
        "json": json.dumps,
        "dataset": _dataset_description,
        "folder_name": _folder_name,
    }
    return environment.get_template(_TEMPLATE).render(
        recipe=recipe,
        backbone=backbone_class,
        is_tiny=is_tiny,
        base=base,
        prompt=prompt,
        prompt_file=PROMPT_FILE,
        panel=panel_size,
        corners={
            panel: (index * width, 0) if recipe.layout.axis == -1 else (0, index * height)
            for index, panel in enumerate(recipe.panels)
        },
        scores={
            _score_title(name): value
            for name, value in scores.items()
            if name not in {"step", "seconds"}
        },
        benchmark_heading=_BENCHMARK_HEADING,
        licence=APACHE_2 if is_tiny else backbone_class.licence,
    )


def with_benchmark_tables(card: str, tables: str) -> str:
    """Returns the card with these Markdown tables under the heading for benchmarks, in place of
    earlier tables. Raises ModelError if the card has no heading for benchmarks.
    """
    before, heading, rest = card.partition(f"\n{_BENCHMARK_HEADING}\n")
    after = re.search(r"^## ", rest, re.MULTILINE)
    if not (heading and after):
        raise ModelError(
            "the card has no section for benchmarks",
            f"expected the heading {_BENCHMARK_HEADING!r} and a section after it",
            "train again to write a new card",
        )
    return f"{before}{heading}\n{tables.strip()}\n\n{rest[after.start() :]}"


def _score_title(name: str) -> str:
    for prefix, title in _SCORE_TITLES.items():
        if name.startswith(prefix):
            return title.format(name.removeprefix(prefix))
    return name.replace("_", " ")


def _dataset_description(folder: Path) -> str:
    """Returns the name of a dataset and, if the dataset can be read, its number of samples and
    their scene recipe.
    """
    with suppress(BrewsterError, OSError, ValueError, KeyError):
        (path,) = resolve_folders([folder])
        recipe = tomllib.loads((path / RECORD_FILE).read_text())["recipe"]
        count = sum(1 for _ in read_dataset(path))
        scenes = (
            f"{count} samples of the scene recipe `{recipe['name']}`, orders {recipe['orders']}"
        )
        return f"`{_folder_name(folder)}` ({scenes})"
    return f"`{_folder_name(folder)}`"


def _folder_name(folder: Path) -> str:
    """Returns the relative path of a folder, or the last part of an absolute one, which depends on
    the machine.
    """
    return folder.name if folder.is_absolute() else folder.as_posix()
