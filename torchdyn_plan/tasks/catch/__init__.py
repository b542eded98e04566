"""Catch: a UR10 with a cup meets a ball that is thrown, with nothing trained."""

from torchdyn_plan.tasks.catch.task import TASK

__all__ = ["TASK"]
