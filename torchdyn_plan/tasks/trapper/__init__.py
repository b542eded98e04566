"""Trapper: a UR5 drops a box over a ball that rolls on a table with eight pockets (paper, Section IV)."""

from torchdyn_plan.tasks.trapper.task import TASK

__all__ = ["TASK"]
