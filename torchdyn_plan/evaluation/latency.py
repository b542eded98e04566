"""Latency as the world has it: plans that come late, whether or not their planner knows."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase

from torchdyn_plan.planners import DynamicPlanner
from torchdyn_plan.planners.latency import Delayed

Planner = Callable[[TensorDictBase], TensorDictBase]


def delay_plans(planner: Planner, steps: int, *, told: bool) -> Planner:
    """Let every plan of ``planner`` come into use ``steps`` control steps after what it was made from was seen.

    What is delayed are plans: forecast, goal and meeting time. What is cheap goes on at every step: the static
    planner's servo, and the choice of the moment to drop, which looks at the newest forecast that has arrived. Target
    pursuit plans nothing, so nothing of it is delayed.

    Args:
        planner: its latency is changed in place.
        steps: 0 leaves it as it is.
        told: the planner plans for the moment when the plan comes into use; otherwise it takes what comes for new.
    """
    if steps and isinstance(planner, DynamicPlanner):
        planner.set_latency(steps if told else 0, Delayed(steps))
    return planner
