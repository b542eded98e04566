"""Tasks: a folder each, and what all of them look like from outside.

A folder here is a task by being here: its module has a ``TASK``.
"""

from torchdyn_plan.tasks.task import (
    PaperCurves,
    PlannerParts,
    PolicyTraining,
    Settings,
    Task,
    Truth,
    Verdict,
    Words,
    import_place,
    import_planner,
    load_task,
    register,
    setting,
    task_names,
)

DEFAULT = "trapper"
"""The task of commands that name none."""

__all__ = [
    "DEFAULT",
    "PaperCurves",
    "PlannerParts",
    "PolicyTraining",
    "Settings",
    "Task",
    "Truth",
    "Verdict",
    "Words",
    "import_place",
    "import_planner",
    "load_task",
    "register",
    "setting",
    "task_names",
]
