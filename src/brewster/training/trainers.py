"""From a recipe to what learns it."""

from __future__ import annotations

from brewster.errors import RecipeError
from brewster.training import distributed
from brewster.training.loop import Trainer
from brewster.training.recipe import CompactRecipe, LoraRecipe


def open_trainer(recipe: CompactRecipe | LoraRecipe) -> Trainer:
    """The recipe's network and data, ready for `loop.run`; meets the other processes, where there are some.

    Raises:
        RecipeError, PhotoError: data are missing or damaged, or cannot be divided among the processes.
        DownloadError, ModelError, DeviceError, MissingExtra: a backbone cannot be loaded.
    """
    distributed.initialize()
    if isinstance(recipe, LoraRecipe):
        from brewster.training.lora.trainer import LoraTrainer  # noqa: PLC0415  (one network is enough to wake)

        return LoraTrainer(recipe)
    if distributed.world_size() > 1:
        raise RecipeError(
            f"{distributed.world_size()} processes are to train the compact network",
            "one",
            "start it without torchrun",
        )
    from brewster.training.compact.trainer import CompactTrainer  # noqa: PLC0415

    return CompactTrainer(recipe)
