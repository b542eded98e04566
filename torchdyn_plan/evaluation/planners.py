"""The planners that the command line names, for each task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchdyn_plan.planners import (
    STATIC_PLANNERS,
    DynamicPlanner,
    ExactSearch,
    MeetingPlanner,
    OracleTrajectory,
    PolicyPlanner,
    TargetPursuit,
    WaitAtEnd,
)
from torchdyn_plan.planners.protocol import GoalSearch

Planner = Callable[[TensorDictBase], TensorDictBase]

CHUNK = 32
"""Rows that a network sees at once, whatever the number of environments: few, as few plan at the same step."""
REACH_CHUNK = 256
"""The same where every row plans at every step."""
STATIC_CHUNK = 64
"""Rows that a static planner sees at once, whatever the number of environments."""

EXACT = {"trapper": ExactSearch(), "reach": ExactSearch(stride=1, first=1)}
"""The search of the whole forecast, by task: with bins of one step every step is a candidate."""


class PlannerMaker(Protocol):
    """What makes a planner for a moving target on a static planner of a given name."""

    def __call__(self, static: str, task: str = ..., /) -> Planner:
        """The planner, for ``task``."""
        ...


PLANNERS: dict[str, PlannerMaker] = {
    "pursuit": lambda static, task="trapper": TargetPursuit(static_planner(static, task)),
    "wait": lambda static, task="trapper": _pretrained(WaitAtEnd, static, task),
    "corner": lambda static, task="trapper": _pretrained(DynamicPlanner, static, task),
    "oracle": lambda static, task="trapper": _pretrained(OracleTrajectory, static, task),
    "exact": lambda static, task="trapper": _pretrained(DynamicPlanner, static, task, search=EXACT[task]),
    "meet": lambda static, task="trapper": _pretrained(MeetingPlanner, static, task),
    "dher": lambda static, task="reach": TargetPursuit(PolicyPlanner.from_pretrained("dher", chunk=REACH_CHUNK)),
}
"""The planners for a moving target by name."""


def static_planner(name: str, task: str = "trapper") -> TensorDictModuleBase:
    """The static planner of that name, whose results do not depend on the number of environments."""
    return STATIC_PLANNERS[task][name](chunk=STATIC_CHUNK)


def _pretrained(
    kind: type[DynamicPlanner], static: str, task: str, *, search: GoalSearch | None = None
) -> DynamicPlanner:
    planner = kind.from_pretrained(f"{task}-{static}", chunk=REACH_CHUNK if task == "reach" else CHUNK)
    planner.static, planner.search = static_planner(static, task), search or planner.search
    return planner
