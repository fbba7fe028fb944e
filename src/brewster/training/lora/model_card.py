"""Writes the model card of a LoRA, a README.md for the hub: backbone, licence, prompt, use, data, settings, scores, limits.

    write_card(Path("out/kontext/lora"), recipe, {"psnr_gain_db_nature": 1.2}, Kontext)

The card depends only on the recipe, the prompt, the log and the records of the rendered datasets. It contains no absolute paths,
so that equal runs on different machines write the same card.
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
from brewster.models.diffusion.backbones.backbone import APACHE_2, Backbone, DiffusersUsage
from brewster.models.diffusion.backbones.registry import BACKBONES
from brewster.models.diffusion.panels import fit_panel
from brewster.models.diffusion.prompt import PROMPT, PROMPT_FILE, load_prompt
from brewster.models.zoo import TINY_PREFIX
from brewster.rendered.generation.job import RECORD_FILE
from brewster.rendered.store import read_dataset
from brewster.training.recipe import LoraRecipe
from brewster.training.streams import resolve_folders

_TAGS: Final = ("lora", "reflection-removal", "image-decomposition", "brewster")
_PANELS: Final = {
    "I": "the photo again (I)",
    "T": "the scene behind the glass (T, the transmission)",
    "R": "the mirrored scene (R, the reflection)",
}
_SQUARE_PHOTO_PX: Final = (4096, 4096)
"""A large square photo: its panels fill the pixel budget best."""
_BENCHMARK_HEADING: Final = "## Benchmark scores"
_NO_BENCHMARKS: Final = """This model has no benchmark scores yet. `brewster evaluate --benchmark NAME=FOLDER --model lora` scores the model, and
`brewster models card lora --scores out/evaluate/results.json` writes the tables here."""

_LIMITS: Final = """## Limits

- **Not for evidence.** The model generates the transmission and the reflection; it does not recover recorded light. Where a
  reflection hides the scene, the result is invented.
- **It generates the whole image**, at the size of a panel. Faces can become other faces, and small text other text. `brewster`
  takes fine detail from the photo instead, where the reflection allows it.
- **Reconstruction error.** Colours and edges of the generated photo can differ from the input. `brewster` measures this error,
  uses it for the confidence, and flags a result with a large error.
- **White areas.** The model can mistake a white area of the scene, such as a sign, for a reflection and remove it. It can also
  keep a white reflection as part of the scene. `brewster evaluate` measures both errors on rendered datasets, in the columns
  "Removed white" and "Kept reflection".
- The model works only for kinds of glass that are in its training data. Photos with rain, dirt, or curved or patterned panes may be separated incorrectly.
- Each seed gives a different result. The mean of several results contains less invented detail."""


def write_card(
    folder: Path, recipe: LoraRecipe, scores: Mapping[str, float], backbone_class: type[Backbone]
) -> None:
    """Writes or replaces the model card in a folder that contains the LoRA and its prompt.

    `scores` is the last line of the run's log.

    Raises:
        ModelError: the prompt is missing, damaged, or of another backbone.
        OutputError: the folder cannot be written.
    """
    prompt = load_prompt(folder / PROMPT_FILE, backbone_class.name).text
    text = card_text(recipe, scores=scores, backbone_class=backbone_class, prompt=prompt)
    write_atomically(folder / CARD_FILE, text.encode(), overwrite=True)


def card_text(
    recipe: LoraRecipe, *, scores: Mapping[str, float], backbone_class: type[Backbone], prompt: str = PROMPT
) -> str:
    """Returns the model card, Markdown, of a LoRA trained with this recipe; `scores` is the last line of the run's log."""
    parts = [
        _front_matter(recipe, backbone_class),
        _description(recipe, backbone_class),
        f"## Prompt\n\nThe model needs exactly this prompt; `{PROMPT_FILE}` contains it, encoded for the backbone.\n\n> {prompt}",
        _usage(recipe, backbone_class),
        _data(recipe),
        _settings(recipe),
        _scores(scores),
        f"{_BENCHMARK_HEADING}\n\n{_NO_BENCHMARKS}",
        _LIMITS,
        f"## Licence\n\n{_licence(recipe, backbone_class)}",
    ]
    return "\n\n".join(parts) + "\n"


def with_benchmark_tables(card: str, tables: str) -> str:
    """Returns the card with these Markdown tables under the heading for benchmarks, in place of earlier tables.

    Raises:
        ModelError: the card has no heading for benchmarks.
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


def _front_matter(recipe: LoraRecipe, backbone_class: type[Backbone]) -> str:
    """Returns the metadata for the hub in YAML. The values are JSON strings and lists, which are valid YAML."""
    about: dict[str, object] = {}
    if _is_tiny(recipe):
        about |= APACHE_2.hub
    else:
        about |= {"base_model": _base_id(recipe, backbone_class), "base_model_relation": "adapter"}
        about |= backbone_class.licence.hub
    about |= {"library_name": "diffusers", "pipeline_tag": "image-to-image"}
    about |= {"tags": [*_TAGS, *(["tiny"] if _is_tiny(recipe) else [])]}
    lines = [f"{name}: {json.dumps(value)}" for name, value in about.items()]
    return "\n".join(["---", *lines, "---"])


def _description(recipe: LoraRecipe, backbone_class: type[Backbone]) -> str:
    panels = ", ".join(_PANELS[panel] for panel in recipe.panels)
    text = f"""# Reflection removal: a LoRA for {_base_title(recipe, backbone_class)}

From a photo taken through glass, the backbone with this LoRA generates these panels, {recipe.direction}:
{panels}.
The method is that of the paper "SIRR-LMM: Single-image Reflection Removal via Large Multimodal Model" (Guo et al.,
arXiv 2601.07209). This LoRA was trained with brewster, not by the authors of the paper."""
    if _is_tiny(recipe):
        text += f"""

**This model is for software tests.** Its backbone is a tiny version of {backbone_class.hub_id} with random weights.
The LoRA does not work with any published model, and it does not separate photos."""
    return text


def _usage(recipe: LoraRecipe, backbone_class: type[Backbone]) -> str:
    return f"""## Use

In the examples, `lora` is this folder. The command `hf download OWNER/NAME --local-dir lora` downloads it from the hub.

```sh
brewster photo.jpg --model lora
```

```python
from brewster import Separator

separation = Separator.load("lora")("photo.jpg")
separation.transmission.save("clear.jpg")
```

{_diffusers_usage(recipe, backbone_class)}"""


def _diffusers_usage(recipe: LoraRecipe, backbone_class: type[Backbone]) -> str:
    """Explains how to generate the same image with diffusers alone, if that is possible."""
    if _is_tiny(recipe):
        return "diffusers alone can load the LoRA into the tiny version that `brewster.models.diffusion.backbones.registry.tiny` builds."
    loads = 'diffusers alone can load the LoRA with `pipe.load_lora_weights("lora")`'
    if recipe.objective == "one_step":
        return f"{loads}, but then starts from noise. This LoRA needs to start from the photo and to take one step."
    usage = backbone_class.diffusers_usage
    if isinstance(usage, str):
        return f"{loads}, {usage}."
    return f"""{loads}.
With the same input of the same size, diffusers generates the same composite image. This image is small. It lacks the
fine detail of the photo and the colour processing of brewster. Both sides of a panel are multiples of {backbone_class.size_divisor}. {usage.caution}

```python
{_diffusers_code(recipe, backbone_class, usage)}
```"""


def _diffusers_code(recipe: LoraRecipe, backbone_class: type[Backbone], usage: DiffusersUsage) -> str:
    fit = fit_panel(
        _SQUARE_PHOTO_PX,
        recipe.layout,
        max_composite_pixels=recipe.max_composite_pixels,
        size_divisor=backbone_class.size_divisor,
    )
    (width, height), (full_width, full_height) = fit.panel, recipe.layout.composite_size(fit.panel)
    corners = {
        panel: (index * width, 0) if recipe.layout.axis == -1 else (0, index * height)
        for index, panel in enumerate(recipe.panels)
    }
    x, y = corners["T"]
    make_input = (
        f'condition = Image.new("RGB", ({full_width}, {full_height}), "white")\ncondition.paste(photo, {corners["I"]})'
        if recipe.layout.has_white_space
        else "condition = photo"
    )
    return f"""import torch
from diffusers import {backbone_class.classes["pipeline"]}
from PIL import Image
from safetensors.torch import load_file

pipe = {backbone_class.classes["pipeline"]}.from_pretrained(
    "{_base_id(recipe, backbone_class)}",
    dtype=torch.bfloat16, {usage.parts},
).to("cuda")
pipe.load_lora_weights("lora")
prompt = {{name: tensor.to("cuda", torch.bfloat16) for name, tensor in load_file("lora/{PROMPT_FILE}").items()}}
photo = Image.open("photo.jpg").convert("RGB").resize(({width}, {height}))  # for a square photo
{make_input}
composite = pipe(
    image=condition, prompt_embeds=prompt["embeds"], width={full_width}, height={full_height},
    {usage.options.format(area=full_width * full_height)}
    num_inference_steps={recipe.task.steps}, guidance_scale={recipe.task.guidance}, generator=torch.Generator().manual_seed(0),
).images[0]
transmission = composite.crop(({x}, {y}, {x + width}, {y + height}))"""


def _data(recipe: LoraRecipe) -> str:
    data, lines = recipe.data, []
    rendered = data.rendered
    if rendered and data.rendered_share and data.pairs_share < 1:
        first = f"the first {rendered.count} samples of " if rendered.count else ""
        if first and len(rendered.datasets) > 1:
            first += "these datasets together, in this order: "
        datasets = "; ".join(_dataset_description(folder) for folder in rendered.datasets)
        lines.append(
            f"- Rendered by `brewster render`, {1 - data.pairs_share:.0%} of the samples: {first}{datasets}."
        )
        mixed = (
            "added in linear light" if rendered.blend_space == "linear" else "blended as 8-bit sRGB images"
        )
        lines.append(f"  T is the {rendered.target}; the layers are {mixed}.")
    if data.pairs_share:
        lines.append(
            f"- Real pairs, {data.pairs_share:.0%} of the samples: {', '.join(map(_folder_name, data.pairs))}."
        )
        if recipe.reflections == "difference":
            lines.append(
                "  If a pair has no reflection image, its reflection is photo minus transmission, in linear light."
            )
    lines.append(
        f"- {'Flipped left to right at random' if recipe.flip else 'Never flipped'}; each sample has its own aspect ratio."
    )
    if data.validate_on:
        lines.append(
            f"- Used for validation during training, not trained on: {', '.join(map(_folder_name, data.validate_on))}."
        )
    return "\n".join(["## Data", "", *lines])


def _settings(recipe: LoraRecipe) -> str:
    one_step = recipe.objective == "one_step"
    rows = {
        "rank, alpha": f"{recipe.rank}, {recipe.alpha}",
        "steps, batch": f"{recipe.steps}, {recipe.batch_size}",
        "seed": recipe.seed,
        "panels": f"{' '.join(recipe.panels)}, {recipe.direction}, at most {recipe.max_composite_pixels} pixels together",
        "objective": "one step from the photo" if one_step else "flow matching",
        "guidance": f"{recipe.guidance:g} during training",
        "inference": "one step"
        if one_step
        else f"{recipe.task.steps} steps at guidance {recipe.task.guidance:g}, by default",
        "learning rate": f"{recipe.learning_rate:g} after {recipe.warmup_steps} steps, {_decay(recipe)}",
        "optimiser": f"{'AdamW' if recipe.optimizer == 'adamw' else '8-bit AdamW'}, weight decay {recipe.weight_decay:g}",
        "adapted layers": ", ".join(recipe.target_modules) or "all linear layers of the blocks",
        "condition": "the photo and white space" if recipe.layout.has_white_space else "the photo",
        "quantization of the backbone": recipe.quantization or "none",
    }
    return f"## Settings\n\n{_table(('setting', 'value'), rows)}\n\n`recipe.json` contains all settings."


def _decay(recipe: LoraRecipe) -> str:
    return (
        f"cosine decay in the last {recipe.learning_rate_decay_share:.0%}"
        if recipe.learning_rate_decay_share
        else "then constant"
    )


def _scores(scores: Mapping[str, float]) -> str:
    rows = {
        _metric_title(name): f"{value:.4g}"
        for name, value in scores.items()
        if name not in {"step", "seconds"}
    }
    table = _table(("metric", "value"), rows) if rows else "No scores were logged."
    return f"## Validation during training\n\nThese values are from the last training step; the PSNR gains are measured on the validation pairs.\n\n{table}"


def _metric_title(name: str) -> str:
    if name.startswith("psnr_gain_db_"):
        return f"PSNR gain over the input, {name.removeprefix('psnr_gain_db_')}, dB"
    return (
        f"loss, panel {name.removeprefix('loss_panel_')}"
        if name.startswith("loss_panel_")
        else name.replace("_", " ")
    )


def _licence(recipe: LoraRecipe, backbone_class: type[Backbone]) -> str:
    if _is_tiny(recipe):
        return f"{APACHE_2.title}. It contains no weights of the backbone."
    text = f"{backbone_class.licence.title}, the licence of the backbone."
    if not backbone_class.licence.allows_commercial_use:
        text += " **Not for commercial use.** The backbone is gated: request access on its page."
    return text


def _table(head: tuple[str, str], rows: Mapping[str, object]) -> str:
    lines = [head, ("---", "---"), *rows.items()]
    return "\n".join(f"| {name} | {value} |" for name, value in lines)


def _is_tiny(recipe: LoraRecipe) -> bool:
    return recipe.backbone.startswith(TINY_PREFIX)


def _base_id(recipe: LoraRecipe, backbone_class: type[Backbone]) -> str:
    """Returns the hub id of the backbone. A local folder counts as a copy of its backbone on the hub."""
    name = recipe.backbone
    is_hub_id = re.fullmatch(r"[\w.-]+/[\w.-]+", name) and not Path(name).exists()
    return name if is_hub_id and name not in BACKBONES else backbone_class.hub_id


def _base_title(recipe: LoraRecipe, backbone_class: type[Backbone]) -> str:
    if _is_tiny(recipe):
        return f"a tiny version of {backbone_class.hub_id}"
    return f"[{_base_id(recipe, backbone_class)}](https://huggingface.co/{_base_id(recipe, backbone_class)})"


def _dataset_description(folder: Path) -> str:
    """Returns the name of a dataset and, if the dataset can be read, its number of samples and their scene recipe."""
    with suppress(BrewsterError, OSError, ValueError, KeyError):
        (path,) = resolve_folders([folder])
        recipe = tomllib.loads((path / RECORD_FILE).read_text())["recipe"]
        count = sum(1 for _ in read_dataset(path))
        return f"`{_folder_name(folder)}` ({count} samples of the scene recipe `{recipe['name']}`, orders {recipe['orders']})"
    return f"`{_folder_name(folder)}`"


def _folder_name(folder: Path) -> str:
    """Returns the relative path of a folder, or only the last part of an absolute path, which depends on the machine."""
    return folder.name if folder.is_absolute() else folder.as_posix()
