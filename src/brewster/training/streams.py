"""Opens what a recipe learns from: photos, maps and pairs are read into memory, rendered samples are not.

stream = open_stream(read_recipe(Path("recipes/train/tiny.toml")))
batch = stream(step=0, count=2, size=64)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from brewster.environments.assets import Assets
from brewster.environments.catalog import read_catalog
from brewster.errors import RecipeError
from brewster.scene.recipe import SceneRecipe, read_scene_recipe
from brewster.training.data.data_recipe import DataRecipe, RenderedRecipe
from brewster.training.data.image_loading import read_maps, read_pairs, read_photos, source_weights
from brewster.training.data.mixtures import InterleavedStream, Mixtures, Pairs, Stream, TrainingBatch
from brewster.training.data.online import OnlineRendered
from brewster.training.data.rendered import CachedRendered, RenderedSets
from brewster.training.recipe import CompactRecipe, data_folder


def open_stream(recipe: CompactRecipe, device: torch.device | str = "cpu") -> Stream:
    """The recipe's training data: photos, maps and pairs in memory; what is rendered live is so on the device.

    Raises:
        RecipeError: a folder is missing or empty, pairs do not fit together, or too few samples are rendered.
        PhotoError: a picture cannot be read, or a map cannot light a scene.
    """
    return _shared(
        recipe.data.pairs_share, partial(_open_pairs, recipe), partial(_open_others, recipe, device)
    )


def validation_pairs(data: DataRecipe) -> dict[str, list[tuple[Tensor, Tensor]]]:
    """Aligned (photo, transmission) pairs, uint8 sRGB (H, W, 3), by names that tell their folders apart.

    Raises:
        RecipeError: a folder is missing or empty, or pairs do not fit together.
        PhotoError: a picture cannot be read.
    """
    folders = tuple(dict.fromkeys(data.validate_on))
    root = data_folder() if folders else Path()
    return {
        name: read_pairs([root / folder], data.validate_at_most)
        for name, folder in zip(_short(folders), folders, strict=True)
    }


def held_out_mixtures(recipe: CompactRecipe) -> Stream | None:
    """Mixtures of the recipe's held-out photos and maps, distributed as in training; None if none are held out.

    Raises:
        RecipeError, PhotoError: no photo is held out, or one cannot be read.
    """
    data = recipe.data
    if not (data.held_out and data.photos):
        return None
    photos = read_photos(found(data.photos), data.exclude, only=data.held_out)
    maps = read_maps(found(data.maps), data.exclude, only=data.held_out)
    return Mixtures(photos, maps, recipe.mix, seed=recipe.seed + 3)


def _short(folders: Sequence[Path]) -> list[str]:
    """Names for different folders: as much of the end of their paths as tells them apart."""
    for length in range(1, max((len(folder.parts) for folder in folders), default=0)):
        names = ["/".join(folder.parts[-length:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return list(map(str, folders))


def _open_others(recipe: CompactRecipe, device: torch.device | str) -> Stream:
    return _shared(
        recipe.data.rendered_share, partial(_open_rendered, recipe, device), partial(_open_mixtures, recipe)
    )


def _shared(share: float, first: Callable[[], Stream], second: Callable[[], Stream]) -> Stream:
    """Opens only what has a share."""
    if share in (0, 1):
        return first() if share else second()
    return InterleavedStream(first(), second(), share)


def _open_mixtures(recipe: CompactRecipe) -> Stream:
    data = recipe.data
    if data.is_empty:
        return _refuse
    folders = found(data.photos)
    return Mixtures(
        read_photos(folders, data.excluded_files),
        read_maps(found(data.maps), data.excluded_files),
        recipe.mix,
        seed=recipe.seed,
        weights=source_weights(folders, data.excluded_files),
    )


def _open_pairs(recipe: CompactRecipe) -> Stream:
    return Pairs(read_pairs(found(recipe.data.pairs)), recipe.mix.crop, seed=recipe.seed + 1)


def _open_rendered(recipe: CompactRecipe, device: torch.device | str) -> Stream:
    wanted, choices = recipe.data.rendered, recipe.seed + 2
    assert wanted
    if wanted.sets:
        return RenderedSets(
            found(wanted.sets),
            seed=choices,
            count=wanted.count,
            crop=recipe.mix.crop,
            target=wanted.target,
            mixing=wanted.mixing,
        )
    live = _open_live(recipe, wanted, device)
    return live if wanted.count is None else CachedRendered(live, wanted.count, seed=choices)


def _open_live(recipe: CompactRecipe, wanted: RenderedRecipe, device: torch.device | str) -> OnlineRendered:
    maps, photos = found(wanted.maps), found(wanted.photos)
    catalog, refused = read_catalog(maps, photos, recipe.data.excluded_files)
    if refused:  # a run of hours has nobody to tell that it learns from less than was asked
        raise refused[0]
    return OnlineRendered(
        _scenes(wanted),
        catalog,
        Assets([*maps, *photos]),
        seed=recipe.seed if wanted.seed is None else wanted.seed,
        device=device,
        target=wanted.target,
        mixing=wanted.mixing,
    )


def _scenes(wanted: RenderedRecipe) -> SceneRecipe:
    scenes = read_scene_recipe(wanted.recipe or "")
    return scenes.model_copy(update={"orders": wanted.orders}) if wanted.orders else scenes


def _refuse(step: int, count: int, size: int) -> TrainingBatch:  # noqa: ARG001  (a Stream)
    raise RecipeError(
        "the recipe has nothing to learn from",
        "a share above 0, and a count of rendered samples above 0",
        "raise data.rendered.count, data.rendered.share or data.pairs_share",
    )


def found(named: Sequence[Path]) -> list[Path]:
    """Where a recipe's folders lie; BREWSTER_DATA is not asked for where no path starts from it.

    Raises:
        RecipeError: it is asked for and names no folder.
    """
    return [folder if folder.is_absolute() else data_folder() / folder for folder in named]
