"""The card of a LoRA, README.md as the hub reads it: base, licence, prompt, use, data, settings, scores, limits.

    write_card(Path("out/kontext/lora"), recipe, {"gain_db_nature": 1.2}, Kontext)

It says what the recipe and the log know, and nothing of the machine it was made on: same run, same bytes.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from brewster.errors import BrewsterError, ModelError
from brewster.files import write_atomically
from brewster.models.diffusion.adapter.hub import CARD_FILE
from brewster.models.diffusion.backbones import BACKBONES
from brewster.models.diffusion.families.family import APACHE_2, Backbone, StockCall
from brewster.models.diffusion.panels import fit_panel
from brewster.models.diffusion.prompt import PROMPT, PROMPT_FILE, load_prompt
from brewster.models.diffusion.sampling import GUIDANCE, STEPS
from brewster.models.zoo import TINY
from brewster.rendered.generation.job import RECORD
from brewster.rendered.store import read_set
from brewster.training.recipe import LoraRecipe
from brewster.training.streams import resolve_folders

_TAGS: Final = ("lora", "reflection-removal", "image-decomposition", "brewster")
_PANELS: Final = {
    "I": "the photo again (I)",
    "T": "what is behind the glass (T, the transmission)",
    "R": "what is mirrored in it (R, the reflection)",
}
_SQUARE_PHOTO_PX: Final = (4096, 4096)
"""A large square photo, whose panels fill the budget best."""
_BENCHMARK_HEADING: Final = "## Measured"
_NO_BENCHMARKS: Final = """Not yet. `brewster evaluate --benchmark NAME=DIR --model lora` measures it, and
`brewster models card lora --scores out/evaluate/results.json` puts the tables here."""

_LIMITS: Final = """## Limits

- **Not for evidence.** A model draws the transmission and the reflection; it does not recover recorded light. Where a
  reflection hides the scene, what you see is invented.
- **It redraws everything**, at the size of a panel. Faces can become other faces, and small text other text. `brewster` takes
  fine detail from the photo instead, as far as the reflection allows.
- **It drifts.** Colours and edges of the generated photo can differ from the real one. `brewster` measures that, reports it
  as confidence, and flags a result that strayed too far.
- It has seen the glass of its training data and no other: think of rain, dirt, curved or patterned panes.
- Another seed gives another answer. Averaging several removes some of what was merely made up."""


def write_card(folder: Path, recipe: LoraRecipe, scores: Mapping[str, float], base: type[Backbone]) -> None:
    """Writes the card beside the LoRA and the prompt that are in this folder, replacing an older one.

    Raises:
        ModelError: the prompt is missing, damaged, or another backbone's.
        TargetError: the folder cannot be written.
    """
    prompt = load_prompt(folder / PROMPT_FILE, base.name).text
    text = card_text(recipe, scores=scores, base=base, prompt=prompt)
    write_atomically(folder / CARD_FILE, text.encode(), overwrite=True)


def card_text(
    recipe: LoraRecipe, *, scores: Mapping[str, float], base: type[Backbone], prompt: str = PROMPT
) -> str:
    """The card of the LoRA that this recipe makes on such a base; `scores` is the last line of the run's log."""
    parts = [
        _front_matter(recipe, base),
        _description(recipe, base),
        f"## Prompt\n\nAlways this one; `{PROMPT_FILE}` holds it as the base reads it.\n\n> {prompt}",
        _usage(recipe, base),
        _data(recipe),
        _settings(recipe),
        _scores(scores),
        f"{_BENCHMARK_HEADING}\n\n{_NO_BENCHMARKS}",
        _LIMITS,
        f"## Licence\n\n{_licence(recipe, base)}",
    ]
    return "\n\n".join(parts) + "\n"


def with_benchmark_tables(card: str, tables: str) -> str:
    """The card with these tables, Markdown, as what was measured, in place of older ones.

    Raises:
        ModelError: the card has no such part.
    """
    before, heading, rest = card.partition(f"\n{_BENCHMARK_HEADING}\n")
    after = re.search(r"^## ", rest, re.MULTILINE)
    if not (heading and after):
        raise ModelError(
            "the card has no part for scores", f"{_BENCHMARK_HEADING!r} and what follows it", "train again"
        )
    return f"{before}{heading}\n{tables.strip()}\n\n{rest[after.start() :]}"


def _front_matter(recipe: LoraRecipe, base: type[Backbone]) -> str:
    """What the hub reads: YAML, of which JSON's strings and lists are a part."""
    about: dict[str, object] = {}
    if _is_toy(recipe):
        about |= APACHE_2.hub
    else:
        about |= {"base_model": _base_id(recipe, base), "base_model_relation": "adapter"}
        about |= base.licence.hub
    about |= {"library_name": "diffusers", "pipeline_tag": "image-to-image"}
    about |= {"tags": [*_TAGS, *(["toy"] if _is_toy(recipe) else [])]}
    lines = [f"{name}: {json.dumps(value)}" for name, value in about.items()]
    return "\n".join(["---", *lines, "---"])


def _description(recipe: LoraRecipe, base: type[Backbone]) -> str:
    shown = ", ".join(_PANELS[panel] for panel in recipe.panels)
    text = f"""# Sees through glass: a LoRA for {_base_title(recipe, base)}

Shown a photograph taken through glass, the base model with this LoRA draws, {recipe.direction}:
{shown}.
The in-context method is that of "SIRR-LMM: Single-image Reflection Removal via Large Multimodal Model". This LoRA
was trained with brewster, and not by the authors of the paper."""
    if _is_toy(recipe):
        text += f"""

**This is a toy.** Its base is a tiny twin of {base.hub_id} with random weights, made to test software.
It fits no model that can be downloaded, and it separates nothing."""
    return text


def _usage(recipe: LoraRecipe, base: type[Backbone]) -> str:
    return f"""## Use

This folder is `lora` below; `hf download OWNER/NAME --local-dir lora` fetches it from the hub.

```sh
brewster photo.jpg --model lora
```

```python
from brewster import Separator

separation = Separator.load("lora")("photo.jpg")
separation.transmission.save("clear.jpg")
```

{_stock_usage(recipe, base)}"""


def _stock_usage(recipe: LoraRecipe, base: type[Backbone]) -> str:
    """How stock diffusers makes the same picture, where it can."""
    if _is_toy(recipe):
        return "Stock diffusers loads the LoRA into the twin that `brewster.models.diffusion.backbones.tiny` builds."
    loads = 'Stock diffusers loads it with `pipe.load_lora_weights("lora")`'
    if recipe.objective == "one_step":
        return f"{loads}, but starts from noise, where this LoRA starts from the photo, and takes one step."
    stock = base.stock_use
    if isinstance(stock, str):
        return f"{loads}, {stock}."
    return f"""{loads}.
Shown the same at the same size, it makes the same composite: small, and without brewster's care for detail and colour.
Both sides of a panel are multiples of {base.multiple}. {stock.caution}

```python
{_stock_code(recipe, base, stock)}
```"""


def _stock_code(recipe: LoraRecipe, base: type[Backbone], stock: StockCall) -> str:
    fit = fit_panel(_SQUARE_PHOTO_PX, recipe.layout, budget_px=recipe.budget_px, multiple=base.multiple)
    (width, height), (whole, high) = fit.panel, recipe.layout.composite_size(fit.panel)
    corners = {
        panel: (index * width, 0) if recipe.layout.axis == -1 else (0, index * height)
        for index, panel in enumerate(recipe.panels)
    }
    x, y = corners["T"]
    shown = (
        f'shown = Image.new("RGB", ({whole}, {high}), "white")\nshown.paste(photo, {corners["I"]})'
        if "I" in corners
        else "shown = photo"
    )
    return f"""import torch
from diffusers import {base.classes["pipeline"]}
from PIL import Image
from safetensors.torch import load_file

pipe = {base.classes["pipeline"]}.from_pretrained(
    "{_base_id(recipe, base)}",
    dtype=torch.bfloat16, {stock.parts},
).to("cuda")
pipe.load_lora_weights("lora")
words = load_file("lora/{PROMPT_FILE}", device="cuda")
photo = Image.open("photo.jpg").convert("RGB").resize(({width}, {height}))  # for a square photo
{shown}
made = pipe(
    image=shown, prompt_embeds=words["embeds"], width={whole}, height={high},
    {stock.options.format(area=whole * high)}
    num_inference_steps={STEPS}, guidance_scale={GUIDANCE}, generator=torch.Generator().manual_seed(0),
).images[0]
transmission = made.crop(({x}, {y}, {x + width}, {y + height}))"""


def _data(recipe: LoraRecipe) -> str:
    data, lines = recipe.data, []
    rendered = data.rendered
    if rendered and data.rendered_share and data.pairs_share < 1:
        first = f"the first {rendered.count} samples of " if rendered.count else ""
        sets = "; ".join(_set_description(folder) for folder in rendered.sets)
        lines.append(
            f"- Rendered by `brewster render`, {1 - data.pairs_share:.0%} of what it saw: {first}{sets}."
        )
        mixed = "added as light" if rendered.mixing == "light" else "blended in 8 bits"
        lines.append(f"  T is the {rendered.target}; the layers are {mixed}.")
    if data.pairs_share:
        lines.append(
            f"- Real pairs, {data.pairs_share:.0%} of what it saw: {', '.join(map(_folder_name, data.pairs))}."
        )
        if recipe.reflections == "difference":
            lines.append(
                "  Where they have no reflection, it is what photo minus transmission leaves, in light."
            )
    lines.append(
        f"- {'Each also mirrored' if recipe.flip else 'Never mirrored'}; whole, in its own aspect ratio."
    )
    if data.validate_on:
        lines.append(
            f"- Looked at while training, not learnt from: {', '.join(map(_folder_name, data.validate_on))}."
        )
    return "\n".join(["## Data", "", *lines])


def _settings(recipe: LoraRecipe) -> str:
    one_step = recipe.objective == "one_step"
    rows = {
        "rank, alpha": f"{recipe.rank}, {recipe.alpha}",
        "steps, batch": f"{recipe.steps}, {recipe.batch}",
        "seed": recipe.seed,
        "panels": f"{' '.join(recipe.panels)}, {recipe.direction}, at most {recipe.budget_px} pixels together",
        "objective": "one step from the photo" if one_step else "flow matching",
        "guidance": f"{recipe.guidance:g} while learning",
        "made in": "one step" if one_step else f"{STEPS} steps at guidance {GUIDANCE:g}, by default",
        "learning rate": f"{recipe.learning_rate:g} after {recipe.warmup_steps} steps, AdamW, weight decay {recipe.weight_decay:g}",
        "base stored as": recipe.quantise or "it is",
    }
    return f"## Settings\n\n{_table(('what', 'value'), rows)}\n\n`recipe.json` has all of them."


def _scores(scores: Mapping[str, float]) -> str:
    rows = {
        _metric_title(name): f"{value:.4g}"
        for name, value in scores.items()
        if name not in {"step", "seconds"}
    }
    table = _table(("what", "value"), rows) if rows else "None were logged."
    return f"## Scores\n\nAt the last step of training, on a few pictures:\n\n{table}"


def _metric_title(name: str) -> str:
    if name.startswith("gain_db_"):
        return f"PSNR gained over the photo itself, {name.removeprefix('gain_db_')}, dB"
    return (
        f"loss, panel {name.removeprefix('panel_')}" if name.startswith("panel_") else name.replace("_", " ")
    )


def _licence(recipe: LoraRecipe, base: type[Backbone]) -> str:
    if _is_toy(recipe):
        return f"{APACHE_2.title}: nobody else's weights are in it."
    text = f"{base.licence.title}, that of the base."
    if not base.licence.is_commercial:
        text += " **Not for commercial use.** The base is gated: ask for access on its page."
    return text


def _table(head: tuple[str, str], rows: Mapping[str, object]) -> str:
    lines = [head, ("---", "---"), *rows.items()]
    return "\n".join(f"| {name} | {value} |" for name, value in lines)


def _is_toy(recipe: LoraRecipe) -> bool:
    return recipe.backbone.startswith(TINY)


def _base_id(recipe: LoraRecipe, base: type[Backbone]) -> str:
    """The base on the hub; a folder is taken for a copy of what its family is called there."""
    named = recipe.backbone
    is_hub_id = re.fullmatch(r"[\w.-]+/[\w.-]+", named) and not Path(named).exists()
    return named if is_hub_id and named not in BACKBONES else base.hub_id


def _base_title(recipe: LoraRecipe, base: type[Backbone]) -> str:
    if _is_toy(recipe):
        return f"a toy twin of {base.hub_id}"
    return f"[{_base_id(recipe, base)}](https://huggingface.co/{_base_id(recipe, base)})"


def _set_description(folder: Path) -> str:
    """A set's name, with its number of samples and their scenes if it is at hand."""
    with suppress(BrewsterError, OSError, ValueError, KeyError):
        (place,) = resolve_folders([folder])
        recipe = tomllib.loads((place / RECORD).read_text())["recipe"]
        count = sum(1 for _ in read_set(place))
        return f"`{_folder_name(folder)}` ({count} samples of the scenes `{recipe['name']}`, orders {recipe['orders']})"
    return f"`{_folder_name(folder)}`"


def _folder_name(folder: Path) -> str:
    """A folder's name, without the places of this machine."""
    return folder.name if folder.is_absolute() else folder.as_posix()
