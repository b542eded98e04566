"""Episodes with a planner in the loop: their outcomes, sweeps, tables and figures."""

from torchdyn_plan.evaluation.evaluation import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]
