"""Ways to train a policy by trial, by name. Nothing heavy is imported here: help answers at once."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchdyn_plan.training.goal_task import DDPGRecipe

ALGORITHMS = {
    "ddpg": ("torchdyn_plan.training.ddpg:DDPG", "torchdyn_plan.training.goal_task:DDPGRecipe"),
    "averaged": ("torchdyn_plan.training.averaged:AveragedDDPG", "torchdyn_plan.training.averaged:AveragedRecipe"),
}
"""Where what learns, and its recipe, are defined. The first one is the paper's."""


def learner_type(name: str) -> Any:
    """What learns by algorithm ``name``: `DDPG`, or a subclass of it."""
    return _load(ALGORITHMS[name][0])


def recipe_for(name: str, recipe: DDPGRecipe) -> DDPGRecipe:
    """``recipe``, if it is one of algorithm ``name``; else what stands for it there.

    Raises:
        InputError: there is no such algorithm.
    """
    from torchdyn_plan.checks import check_choice

    check_choice("algorithm", name, ALGORITHMS)
    return recipe if recipe.algorithm == name else _load(ALGORITHMS[name][1]).like(recipe)


def _load(place: str) -> Any:
    module, name = place.split(":")
    return getattr(import_module(module), name)
