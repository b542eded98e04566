"""Reinforcement learning algorithms by name. Imports nothing heavy, so that ``--help`` is fast."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchdyn_plan.training.goal_task import DDPGRecipe

ALGORITHMS = {
    "ddpg": ("torchdyn_plan.training.ddpg:DDPG", "torchdyn_plan.training.goal_task:DDPGRecipe"),
    "averaged": ("torchdyn_plan.training.averaged:AveragedDDPG", "torchdyn_plan.training.averaged:AveragedRecipe"),
}
"""Where each algorithm and its recipe are defined. The first one is the paper's."""


def learner_type(name: str) -> Any:
    """The class of algorithm ``name``: `DDPG`, or a subclass of it."""
    return _load(ALGORITHMS[name][0])


def recipe_for(name: str, recipe: DDPGRecipe) -> DDPGRecipe:
    """``recipe`` if it belongs to algorithm ``name``, otherwise its equivalent for that algorithm.

    Raises:
        InputError: there is no such algorithm.
    """
    from torchdyn_plan.checks import check_choice

    check_choice("algorithm", name, ALGORITHMS)
    return recipe if recipe.algorithm == name else _load(ALGORITHMS[name][1]).like(recipe)


def _load(place: str) -> Any:
    module, name = place.split(":")
    return getattr(import_module(module), name)
