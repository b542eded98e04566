"""Catch: a UR10 with a cup meets a ball that is thrown, by known laws or by trained networks."""

from torchdyn_plan.tasks.catch.task import TASK

__all__ = ["TASK"]
