"""Creates the trainer that a recipe needs."""

from __future__ import annotations

from brewster.errors import RecipeError
from brewster.training import distributed
from brewster.training.loop import Trainer
from brewster.training.recipe import CompactRecipe, LoraRecipe


def open_trainer(recipe: CompactRecipe | LoraRecipe, device: str = "auto") -> Trainer:
    """Creates the trainer of a recipe, for `loop.run`. Joins the process group if there are several processes.

    `device` is "auto" or "cpu". A diffusion backbone is trained on a CPU only if "cpu" is chosen explicitly.
    """
    distributed.initialize()
    if isinstance(recipe, LoraRecipe):
        from brewster.training.lora.trainer import LoraTrainer  # noqa: PLC0415  (imports diffusers)

        return LoraTrainer(recipe, device)
    if distributed.world_size() > 1:
        raise RecipeError(
            f"training of a compact network was started with {distributed.world_size()} processes",
            "expected one process",
            "start it without torchrun",
        )
    from brewster.training.compact.trainer import CompactTrainer  # noqa: PLC0415

    return CompactTrainer(recipe, device=device)
