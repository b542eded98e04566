"""Planners for static targets, made to meet moving ones.

Everything named here is imported when it is first used, so that importing the package costs nothing.
"""

# Importing typing for this name would cost more than all the rest; type checkers know it by its name.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from torchdyn_plan.evaluation import evaluate
    from torchdyn_plan.evaluation.sweep import sweep
    from torchdyn_plan.planners import DynamicPlanner, IKPlanner
    from torchdyn_plan.tasks import Settings, Task, Words, load_task, register, setting, task_names
    from torchdyn_plan.training.collect import collect
    from torchdyn_plan.training.train import train

__version__ = "0.2.0"

__all__ = [
    "DynamicPlanner",
    "IKPlanner",
    "Settings",
    "Task",
    "Words",
    "__version__",
    "collect",
    "evaluate",
    "load_task",
    "register",
    "setting",
    "sweep",
    "task_names",
    "train",
]

_HOMES = {
    "DynamicPlanner": "torchdyn_plan.planners",
    "IKPlanner": "torchdyn_plan.planners",
    "Settings": "torchdyn_plan.tasks",
    "Task": "torchdyn_plan.tasks",
    "Words": "torchdyn_plan.tasks",
    "collect": "torchdyn_plan.training.collect",
    "evaluate": "torchdyn_plan.evaluation",
    "load_task": "torchdyn_plan.tasks",
    "register": "torchdyn_plan.tasks",
    "setting": "torchdyn_plan.tasks",
    "sweep": "torchdyn_plan.evaluation.sweep",
    "task_names": "torchdyn_plan.tasks",
    "train": "torchdyn_plan.training.train",
}
"""Module of each name."""


def __getattr__(name: str) -> object:
    import importlib

    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
