"""Opens the training data of a recipe. Photos, maps and pairs are read at once, rendered samples
when needed.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from torch import Tensor

from brewster.training.data.data_recipe import DataRecipe, MixRecipe
from brewster.training.data.image_loading import read_maps, read_pairs, read_photos, source_weights
from brewster.training.data.mixtures import InterleavedStream, Mixtures, Pairs, Stream
from brewster.training.data.rendered import RenderedDatasets
from brewster.training.recipe import CompactRecipe, data_folder

_HELD_OUT_SEED: Final = 1811


def open_stream(recipe: CompactRecipe) -> Stream:
    """Opens the training data of a recipe as one stream. Raises RecipeError if data are missing,
    too few or do not match; PhotoError if an image or a map cannot be used.
    """
    data = recipe.data
    return _interleave(
        data.pairs_share,
        lambda: Pairs(
            read_pairs(resolve_folders(data.pairs)), recipe.mix.crop, seed=recipe.seed + 1
        ),
        lambda: _interleave(
            data.rendered_share, lambda: _open_rendered(recipe), lambda: _open_mixtures(recipe)
        ),
    )


def validation_pairs(data: DataRecipe) -> dict[str, list[tuple[Tensor, Tensor]]]:
    """Reads the pairs of `validate_on` as `read_pairs` does, by a short unique name of their
    folder.
    """
    folders = tuple(dict.fromkeys(data.validate_on))
    root = data_folder() if folders else Path()
    return {
        name: read_pairs([root / folder], data.max_validation_pairs)
        for name, folder in zip(_unique_names(folders), folders, strict=True)
    }


def held_out_mixtures(recipe: CompactRecipe) -> Stream | None:
    """Opens mixtures of the recipe's held-out photos and maps, for validation, or None without any.

    Seed and distributions are fixed, so that the metrics of runs with the same files can be
    compared. Raises RecipeError if no photo matches `held_out`.
    """
    data = recipe.data
    if not (data.held_out and data.photos):
        return None
    photos = read_photos(resolve_folders(data.photos), data.exclude, only=data.held_out)
    maps = read_maps(resolve_folders(data.maps), data.exclude, only=data.held_out)
    return Mixtures(photos, maps, MixRecipe(), seed=_HELD_OUT_SEED)


def _unique_names(folders: Sequence[Path]) -> list[str]:
    """Returns the last n parts of each path, with the smallest n for which the results are
    unique.
    """
    for length in range(1, max((len(folder.parts) for folder in folders), default=0)):
        names = ["/".join(folder.parts[-length:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return list(map(str, folders))


def _interleave(share: float, first: Callable[[], Stream], second: Callable[[], Stream]) -> Stream:
    """Interleaves two streams; `share` is the share of the first. A stream with a share of 0 is not
    opened.
    """
    if share in (0, 1):
        return first() if share else second()
    return InterleavedStream(first(), second(), share)


def _open_mixtures(recipe: CompactRecipe) -> Stream:
    """Opens mixtures. If the recipe has no data, the stream has no photos and is never called (see
    `loop.run`).
    """
    data = recipe.data
    folders = resolve_folders(data.photos)
    return Mixtures(
        read_photos(folders, data.excluded_files),
        read_maps(resolve_folders(data.maps), data.excluded_files),
        recipe.mix,
        seed=recipe.seed,
        weights=source_weights(folders, data.excluded_files),
    )


def _open_rendered(recipe: CompactRecipe) -> Stream:
    rendered = recipe.data.rendered
    assert rendered
    return RenderedDatasets(
        resolve_folders(rendered.datasets),
        seed=recipe.seed + 2,
        count=rendered.count,
        crop=recipe.mix.crop,
        target=rendered.target,
        blend_space=rendered.blend_space,
    )


def resolve_folders(folders: Sequence[Path]) -> list[Path]:
    """Returns the folders of a recipe as paths. Relative folders are in `data_folder`."""
    return [folder if folder.is_absolute() else data_folder() / folder for folder in folders]
