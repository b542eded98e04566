"""Conveyor as a task: its settings, its planners, and where the rest is defined."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from torchdyn_plan.tasks.task import PlannerParts, Settings, Task, Truth, Verdict, Words, setting

HORIZON = 200
"""Control steps that forecasts look ahead: four seconds."""
REACH = (0.4, 0.45)
"""Limits of meetings upstream and downstream [m]; the tool moves along with a part before and after."""
MARGIN = 0.8
"""Share of the joints' acceleration limits used for braking, because the servos lag a little."""


@dataclass(frozen=True, kw_only=True)
class ConveyorSettings(Settings):
    """Speed of the belt and number of parts."""

    speed: float = setting(
        0.35, text="Speed of the belt", unit="m/s", minimum=0.05, maximum=1.0, sweep=(0.1, 0.2, 0.35, 0.6, 0.8)
    )
    parts: int = setting(1, text="Parts on the belt", minimum=1, maximum=8, sweep=(1, 2, 3, 4))


@cache
def scene() -> Any:
    """Belt, parts and arm."""
    from torchdyn_plan.envs.conveyor.scene import ConveyorScene

    return ConveyorScene()


def make_env(settings: ConveyorSettings, *, num_threads: int = 0, **batch: Any) -> Any:
    """The environment at these settings; for ``batch`` see `Task.make_env`."""
    from torchdyn_plan.envs.conveyor.env import ConveyorEnv

    return ConveyorEnv(speed=settings.speed, parts=settings.parts, num_threads=num_threads, **batch)


def arm() -> Any:
    """The Panda with its cups."""
    from torchdyn_plan.envs.conveyor.panda import panda_arm

    return panda_arm(tool_length=scene().tool_length)


def ik(*, chunk: int | None = None, weights: Any = None) -> Any:
    """Brings the cups to a pose within the joint limits."""
    from torchdyn_plan.envs.conveyor.panda import PANDA_LINKS
    from torchdyn_plan.planners import IKPlanner, TurnedToGoal

    return IKPlanner(
        arm(),
        approach=TurnedToGoal(),
        control_step=scene().control_step,
        acceleration=tuple(MARGIN * link.acceleration for link in PANDA_LINKS),
        chunk=chunk,
    )


def gain(*, chunk: int | None = None, weights: Any = None) -> Any:
    """The same with a gain only, for goals at rest: it lags behind a moving goal."""
    from torchdyn_plan.planners import IKPlanner, TurnedToGoal

    return IKPlanner(arm(), approach=TurnedToGoal(), control_step=scene().control_step, gain=0.1, chunk=chunk)


def turn() -> Any:
    """Aligns the cups with the part, up to a half turn, with the last joint as near to mid-range as possible."""
    from torchdyn_plan.planners import WithTarget

    return WithTarget(symmetry=2, facing=(1.0, 1.0, 0.0))


def maneuver() -> Any:
    """Hovers, descends at the belt's speed, holds until the cups attach, and lifts."""
    from torchdyn_plan.planners import MatchVelocity

    how: dict[str, Any] = {"along_by": 0.8, "down_after": 0.3, "early_steps": 12}
    return MatchVelocity(hover=0.1, descent_steps=40, hold_steps=8, lift_steps=20, **how)


def dynamic(parts: PlannerParts, forecaster: Any, eta: Any = None) -> Any:
    """The planner for one part, with that forecaster and those arrival times; by the joint limits for None."""
    from torchdyn_plan.planners import DynamicPlanner, MetWithin, ReplanSchedule

    own = maneuver()
    return DynamicPlanner(
        parts.static,
        forecaster,
        eta,
        search=own.search(stride=5, first=5, margin=5.0, arrival_radius=0.06),
        schedule=ReplanSchedule.every(5),
        maneuver=own,
        lost=MetWithin(low=(0.0, -REACH[0], 0.0), high=(1.0, REACH[1], 1.0)),
        turn=turn(),
        chunk=parts.chunk,
        scene=scene().digest(),
    ).eval()


def forecaster() -> Any:
    """Constant velocity: exact on a belt."""
    from torchdyn_plan.nets import ConstantVelocity

    return ConstantVelocity(horizon=HORIZON, control_step=scene().control_step)


def meet(parts: PlannerParts) -> Any:
    """Takes the part that can be met soonest, then the next; nothing is trained."""
    from torchdyn_plan.planners import ChoosingPlanner

    return ChoosingPlanner(dynamic(parts, forecaster())).eval()


def learned(parts: PlannerParts) -> Any:
    """The same with a trained forecaster and trained arrival times."""
    from torchdyn_plan.planners import ChoosingPlanner

    return ChoosingPlanner(dynamic(parts, parts.forecaster, parts.eta)).eval()


def first(parts: PlannerParts) -> Any:
    """Takes the part farthest downstream, regardless of the others."""
    return dynamic(parts, forecaster())


def pursuit(parts: PlannerParts) -> Any:
    """Pursues the part farthest downstream."""
    from torchdyn_plan.planners import TargetPursuit

    return TargetPursuit(parts.static, turn=turn(), scene=scene().digest()).eval()


def truth(settings: ConveyorSettings, **episodes: Any) -> Truth:
    """See `Task.truth`: a part is solvable if an arm that knows the belt can meet it within its joint limits."""
    from torchdyn_plan.tasks.conveyor.solvable import find_truth

    return find_truth(settings, **episodes)


def judge(settings: ConveyorSettings, log: Any, truth: Truth) -> Verdict:
    """See `Task.judge`."""
    import torch

    cause = torch.where(truth.solvable, 1, 0).masked_fill(log.success, -1)
    return Verdict(cause, {}, {})


def record_paths(blocks: Any, **how: Any) -> dict[str, Any]:
    """See `Task.record_paths`: parts that nobody takes."""
    from torchdyn_plan.tasks.conveyor.data import record_belts

    return record_belts(blocks, **how)


def record_arrivals(planner: Any, **how: Any) -> dict[str, Any]:
    """See `Task.record_arrivals`: the cups sent to poses along the belt."""
    from torchdyn_plan.tasks.conveyor.data import record_arm_runs

    return record_arm_runs(planner, **how)


def fitting() -> Any:
    """Sizes of its networks, and how they are scored."""
    from torchdyn_plan.tasks.conveyor.data import conveyor_fitting

    return conveyor_fitting()


TASK = Task(
    name="conveyor",
    summary="A Panda picks parts off a belt.",
    settings=ConveyorSettings,
    words=Words(success="taken", steps="steps to take", target="part"),
    max_steps=500,
    control_step=0.02,
    make_env=make_env,
    digest=lambda: scene().digest(),
    static_planners={"ik": ik, "gain": gain},
    planners={"pursuit": pursuit, "meet": meet, "first": first, "learned": learned},
    rivals=("first", "learned"),
    rows_at_once=(32, 64),
    truth=truth,
    causes=("out of reach", "missed"),
    judge=judge,
    record_paths=record_paths,
    record_arrivals=record_arrivals,
    fitting=fitting,
)
