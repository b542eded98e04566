"""Base class of the static planners of this package."""

from __future__ import annotations

from typing import ClassVar

from torchdyn_plan.planners.memory import Remembering


class StaticPlannerModule(Remembering):
    """A planner for a static goal that reads and writes tensordicts, see `StaticPlanner`."""

    comes_to_rest: ClassVar[bool] = True
    """Whether the robot comes to rest where it cannot get nearer to its goal."""
