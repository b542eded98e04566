"""Data collection, network fits and policy training, for any task.

A task takes from here what it needs to describe its data and networks.
"""

from typing import TYPE_CHECKING

from torchdyn_plan.lazy import lazy_names

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

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "averaged": ("AveragedRecipe",),
        "fitting": ("ExtraCoverage", "Fitting"),
        "goal_task": ("DDPGRecipe", "GoalTask"),
        "optimise": ("Recipe",),
        "path_data": ("lay_end_to_end",),
        "runs": ("RunPlan", "record_runs"),
        "sighted_data": ("Sighting",),
        "sightings": ("SensorRange",),
        "windows": ("WindowConfig",),
    },
)
