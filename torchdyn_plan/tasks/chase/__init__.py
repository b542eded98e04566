"""Chase: a base on wheels meets somebody who walks past, with nothing trained."""

from torchdyn_plan.tasks.chase.task import TASK

__all__ = ["TASK"]
