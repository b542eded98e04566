"""Dynamic FetchReach: a Fetch arm reaches for a goal that moves (paper, Section IV-D; Fang et al., ICLR 2019)."""

from torchdyn_plan.tasks.fetch_reach.task import TASK

__all__ = ["TASK"]
