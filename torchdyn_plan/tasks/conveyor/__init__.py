"""Conveyor: a Panda picks parts off a moving belt, by known laws or by trained networks."""

from torchdyn_plan.tasks.conveyor.task import TASK

__all__ = ["TASK"]
