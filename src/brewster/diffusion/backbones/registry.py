"""The table of diffusion backbones, and backbones without real weights: tiny versions, and on the
device "meta".
"""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch
from torch import nn

from brewster.diffusion.backbones.backbone import Architecture, Backbone
from brewster.diffusion.backbones.klein import Klein
from brewster.diffusion.backbones.kontext import Kontext
from brewster.diffusion.backbones.qwen import Qwen
from brewster.diffusion.hub_download import cached_model_folder, resolve_model_folder
from brewster.diffusion.lazy_imports import diffusers_class, suppress_log_messages
from brewster.diffusion.memory import BACKBONE_COSTS, BackboneCost
from brewster.diffusion.model_table import TINY_PREFIX
from brewster.diffusion.offloading import explain_out_of_memory
from brewster.diffusion.prompt import PromptEmbedding
from brewster.diffusion.tensors import read_json
from brewster.errors import ModelError

BACKBONES: Final[dict[str, type[Backbone]]] = {
    "kontext": Kontext,
    "klein": Klein,
    "qwen": Qwen,
}
"""name -> Backbone class, which has the hub id, the licence and the architecture."""

INDEX_FILE: Final = "model_index.json"
CONFIG_FILES: Final = {
    "transformer": "config.json",
    "vae": "config.json",
    "scheduler": "scheduler_config.json",
}
"""Part of a backbone -> the file with its configuration, in the folder of the part."""
DESCRIPTION_FILES: Final = (INDEX_FILE, *(f"{part}/{file}" for part, file in CONFIG_FILES.items()))
"""The files without weights that `build_on_meta` reads."""
MEMORY_HINT: Final = "a GPU with more memory"
_STATISTICS_SPREAD: Final = 0.2
"""The spread of the random batch-norm statistics of a built VAE. With 0 and 1, tests would miss an
error.
"""


def tiny(name: str, seed: int = 0) -> tuple[Backbone, PromptEmbedding]:
    """Builds a tiny version of a backbone, with seeded random weights, and a random prompt."""
    backbone_class = find_backbone_class(name)
    backbone = build(name, backbone_class.tiny, seed=seed)
    return backbone, backbone_class.random_prompt(backbone.transformer, seed)


def build(
    name: str,
    architecture: Architecture | None = None,
    *,
    seed: int = 0,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Backbone:
    """Builds a backbone with seeded random weights, by default in full size. Device "meta" needs no
    memory.
    """
    backbone_class = find_backbone_class(name)
    architecture = architecture or backbone_class.full_size
    part_classes = {part: diffusers_class(backbone_class.classes[part]) for part in CONFIG_FILES}
    with (
        torch.random.fork_rng(devices=[]),
        torch.device(device),
        _default_dtype(dtype),
        explain_out_of_memory(f"use {MEMORY_HINT}"),
    ):
        torch.manual_seed(seed)
        transformer = part_classes["transformer"](**architecture["transformer"])
        vae = part_classes["vae"](**architecture["vae"])
        for module in vae.modules():
            if isinstance(module, nn.BatchNorm2d) and module.running_mean is not None:
                assert module.running_var is not None
                module.running_mean.normal_(0, _STATISTICS_SPREAD)
                module.running_var.uniform_(1 - _STATISTICS_SPREAD, 1 + _STATISTICS_SPREAD)
    return backbone_class(transformer, vae, part_classes["scheduler"](**architecture["scheduler"]))


def build_on_meta(source: str, *, dtype: torch.dtype = torch.float32) -> Backbone:
    """The backbone on the device "meta": the names and shapes of its weights, which need no memory.
    For `source`, see `load_backbone`. For a hub id, only configuration files are downloaded.
    """
    backbone_class, folder = find_backbone(source)
    if folder is None:
        architecture = (
            backbone_class.tiny if source.startswith(TINY_PREFIX) else backbone_class.full_size
        )
        return build(backbone_class.name, architecture, device="meta", dtype=dtype)
    _, index = read_index(folder)
    parts = {}
    for part, file in CONFIG_FILES.items():
        class_name = backbone_class.classes[part]
        config_file = folder / part / file
        part_class = diffusers_class(class_name)
        config = read_json(config_file)
        try:
            # diffusers warns about settings that the class does not have
            with torch.device("meta"), _default_dtype(dtype), suppress_log_messages():
                parts[part] = part_class.from_config(config)
        except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
            raise ModelError(
                f"{config_file} has invalid settings ({' '.join(str(error).split())[:200]})",
                f"expected the settings of a {class_name}",
                "copy the model again",
            ) from error
    return backbone_class(**parts, distilled=bool(index.get("is_distilled")))


def find_backbone(source: str) -> tuple[type[Backbone], Path | None]:
    """The class that `load_backbone` would use for this source, and the folder with its
    description: None for a name in the table or a tiny version. The description of a hub id is
    downloaded, but no weights.
    """
    if is_registered(source):
        return find_backbone_class(source.removeprefix(TINY_PREFIX)), None
    folder = resolve_model_folder(source, list(DESCRIPTION_FILES))
    return read_index(folder)[0], folder


def backbone_cost(source: str, backbone_class: type[Backbone]) -> BackboneCost:
    """The cost of a backbone. A folder, or a hub id in the cache, is counted by its configuration;
    another source by its class. The transformer of a tiny version counts as 0.
    """
    cost = BACKBONE_COSTS[backbone_class.name]
    if source.startswith(TINY_PREFIX):
        return replace(cost, transformer=0)
    folder = None if is_registered(source) else cached_model_folder(source, list(DESCRIPTION_FILES))
    if folder is None or not (
        Path(source).is_dir() or all((folder / name).is_file() for name in DESCRIPTION_FILES)
    ):
        return cost
    backbone = build_on_meta(str(folder))
    vae = sum(parameter.numel() for parameter in backbone.vae.parameters())
    return replace(cost, transformer=int(backbone.transformer.num_parameters()), vae=vae)


def find_backbone_class(name: str) -> type[Backbone]:
    """The Backbone class of this name in the table."""
    if name in BACKBONES:
        return BACKBONES[name]
    raise ModelError(
        f"there is no backbone {name!r}",
        f"expected one of {', '.join(BACKBONES)}",
        "choose one of them",
    )


def is_registered(source: str) -> bool:
    """Whether the source of a backbone is a name in the table, or "tiny:" and a name, and not a
    folder or a hub id.
    """
    return source in BACKBONES or source.startswith(TINY_PREFIX)


def local_folder(source: str) -> Path | None:
    """The folder of a backbone on this machine, or None for a name in the table, a tiny version or
    a hub id.
    """
    return Path(source).resolve() if Path(source).is_dir() and not is_registered(source) else None


def hub_id_of(source: str) -> str:
    """The hub id for a name in the table; any other source unchanged."""
    return BACKBONES[source].hub_id if source in BACKBONES else source


def read_index(folder: Path) -> tuple[type[Backbone], dict[str, Any]]:
    """The Backbone class of a folder in diffusers' layout, and the content of its index."""
    index = read_json(folder / INDEX_FILE)
    class_name = index.get("_class_name")
    by_pipeline = {
        name: backbone_class
        for backbone_class in BACKBONES.values()
        for name in (backbone_class.classes["pipeline"], *backbone_class.other_pipelines)
    }
    if class_name in by_pipeline:
        return by_pipeline[class_name], index
    raise ModelError(
        f"{folder} contains a {class_name}"
        if class_name
        else f"{folder / INDEX_FILE} has no _class_name",
        f"expected one of {', '.join(by_pipeline)}",
        f"use {', '.join(backbone_class.hub_id for backbone_class in BACKBONES.values())} or a "
        "finetune of one",
    )


@contextlib.contextmanager
def _default_dtype(dtype: torch.dtype) -> Iterator[None]:
    previous_dtype = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(previous_dtype)
