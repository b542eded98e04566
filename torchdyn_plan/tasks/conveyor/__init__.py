"""Conveyor: a Panda picks parts off a moving belt, with nothing trained."""

from torchdyn_plan.tasks.conveyor.task import TASK

__all__ = ["TASK"]
