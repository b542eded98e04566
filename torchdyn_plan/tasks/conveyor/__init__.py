"""Conveyor: a base on wheels meets somebody who walks past, with nothing trained."""

from torchdyn_plan.tasks.conveyor.task import TASK

__all__ = ["TASK"]
