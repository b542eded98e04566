"""Planners for static targets, made to meet moving ones."""

from torchdyn_plan.lazy import lazy_names

# Importing typing for this constant would cost more than all the rest; type checkers know it by its name.
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

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "evaluation": ("evaluate",),
        "evaluation.sweep": ("sweep",),
        "planners": ("DynamicPlanner", "IKPlanner"),
        "tasks": ("Settings", "Task", "Words", "load_task", "register", "setting", "task_names"),
        "training.collect": ("collect",),
        "training.train": ("train",),
    },
    packages=("envs", "evaluation", "kinematics", "nets", "planners", "tasks", "training"),
)
