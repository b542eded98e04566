"""Collected data, fits of networks to it, and policies that learn by trial: for any task.

What a task needs to say of its data and networks is imported from here, when it is asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchdyn_plan.training.averaged import AveragedRecipe
    from torchdyn_plan.training.fitting import ExtraCoverage, Fitting
    from torchdyn_plan.training.goal_task import DDPGRecipe, GoalTask
    from torchdyn_plan.training.optimise import Recipe
    from torchdyn_plan.training.path_data import lay_end_to_end
    from torchdyn_plan.training.runs import RunPlan, record_runs
    from torchdyn_plan.training.sighted_data import Sighting
    from torchdyn_plan.training.sightings import SensorRange
    from torchdyn_plan.training.windows import WindowConfig

_PLACES = {
    "AveragedRecipe": "averaged",
    "DDPGRecipe": "goal_task",
    "ExtraCoverage": "fitting",
    "Fitting": "fitting",
    "GoalTask": "goal_task",
    "Recipe": "optimise",
    "RunPlan": "runs",
    "SensorRange": "sightings",
    "Sighting": "sighted_data",
    "WindowConfig": "windows",
    "lay_end_to_end": "path_data",
    "record_runs": "runs",
}
"""Module of this folder that defines each name."""

__all__ = [
    "AveragedRecipe",
    "DDPGRecipe",
    "ExtraCoverage",
    "Fitting",
    "GoalTask",
    "Recipe",
    "RunPlan",
    "SensorRange",
    "Sighting",
    "WindowConfig",
    "lay_end_to_end",
    "record_runs",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
