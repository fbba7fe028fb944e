"""From a recipe to what learns it."""

from __future__ import annotations

from brewster.errors import RecipeError
from brewster.train import crew
from brewster.train.loop import Learner
from brewster.train.recipe import CompactRecipe, LargeRecipe


def open_learner(recipe: CompactRecipe | LargeRecipe) -> Learner:
    """The recipe's network and data, ready for `loop.run`; meets the other processes, where there are some.

    Raises:
        RecipeError, PhotoError: data are missing or damaged, or cannot be divided among the processes.
        DownloadError, ModelError, DeviceError, MissingExtra: a backbone cannot be loaded.
    """
    crew.assemble()
    if isinstance(recipe, LargeRecipe):
        from brewster.train.large.learner import LoraLearner  # noqa: PLC0415  (one network is enough to wake)

        return LoraLearner(recipe)
    if crew.size() > 1:
        raise RecipeError(
            f"{crew.size()} processes are to train the compact network", "one", "start it without torchrun"
        )
    from brewster.train.compact.learner import CompactLearner  # noqa: PLC0415

    return CompactLearner(recipe)
