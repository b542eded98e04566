"""Catch as a task: what varies, its planners, and where everything else of it is defined."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from torchdyn_plan.tasks.task import PlannerParts, Settings, Task, Truth, Verdict, Words, setting

HORIZON = 125
"""Control steps that forecasts look ahead: one second."""
DRAG = 0.0195
"""Drag that the forecast takes a ball to have: a tennis ball's [1/m]."""
MARGIN = 0.8
"""Share of the joints' acceleration limits by which the static planner brakes: servos lag a little."""


@dataclass(frozen=True, kw_only=True)
class CatchSettings(Settings):
    """How long balls fly, and how much the air slows them down."""

    flight: float = setting(
        0.7,
        text="Mean time of flight to the place before the arm that is aimed at",
        unit="s",
        minimum=0.4,
        maximum=1.2,
        sweep=(0.5, 0.6, 0.7, 0.8, 0.9),
    )
    drag: float = setting(
        DRAG,
        text="Drag of the ball, deceleration over speed squared; the forecast takes it for a tennis ball's",
        unit="1/m",
        minimum=0.0,
        maximum=0.2,
        sweep=(0.0, 0.01, 0.0195, 0.04, 0.08),
    )


@cache
def scene() -> Any:
    """Arm, cup, ball and throws."""
    from torchdyn_plan.envs.catch.scene import CatchScene

    return CatchScene()


def make_env(settings: CatchSettings, *, num_threads: int = 0, **batch: Any) -> Any:
    """The environment at these settings; ``batch`` as `Task.make_env` says."""
    from torchdyn_plan.envs.catch.env import CatchEnv

    return CatchEnv(flight=settings.flight, drag=settings.drag, num_threads=num_threads, **batch)


def ik(*, chunk: int | None = None, weights: Any = None) -> Any:
    """Brings the cup to a place, and its axis to a direction, by the joints' limits."""
    from torchdyn_plan.envs.catch.ur10 import UR10_LINKS, ur10_arm
    from torchdyn_plan.planners import IKPlanner, TurnedToGoal

    return IKPlanner(
        ur10_arm(tool_length=scene().tool_length),
        approach=TurnedToGoal(base_pos=(0.0, 0.0, scene().base_height), symmetry=0),
        control_step=scene().control_step,
        acceleration=tuple(MARGIN * link.acceleration for link in UR10_LINKS),
        chunk=chunk,
    )


def forecaster() -> Any:
    """The ball falls, and the air slows it down."""
    from torchdyn_plan.nets import Ballistic

    return Ballistic(horizon=HORIZON, control_step=scene().control_step, drag=DRAG)


def dynamic(parts: PlannerParts, forecaster: Any, eta: Any = None) -> Any:
    """The planner on that forecast, by those arrival times; by the joints' limits for None."""
    from torchdyn_plan.planners import AgainstVelocity, DynamicPlanner, ExactSearch, GoAndStay, ReplanSchedule

    return DynamicPlanner(
        parts.static,
        forecaster,
        eta,
        search=ExactSearch(stride=2, first=2, margin=10.0, switching_cost=0.1),
        schedule=ReplanSchedule.every(6),
        maneuver=GoAndStay(before=3, within=0.12),
        turn=AgainstVelocity(),
        chunk=parts.chunk,
        scene=scene().digest(),
    ).eval()


def meet(parts: PlannerParts) -> Any:
    """Holds the cup where the ball will come, against its velocity; nothing of it is trained."""
    return dynamic(parts, forecaster())


def learned(parts: PlannerParts) -> Any:
    """The same with trained networks: of what a tennis ball's flight leaves out, and of arrival times."""
    return dynamic(parts, parts.path_by_noise, parts.eta)


def oracle(parts: PlannerParts) -> Any:
    """The same on the true flight."""
    from torchdyn_plan.planners import RecordedFuture

    return dynamic(parts, RecordedFuture(HORIZON))


def pursuit(parts: PlannerParts) -> Any:
    """Runs after the ball, with the cup against its velocity."""
    from torchdyn_plan.planners import AgainstVelocity, TargetPursuit

    return TargetPursuit(parts.static, turn=AgainstVelocity(), scene=scene().digest()).eval()


def truth(settings: CatchSettings, **episodes: Any) -> Truth:
    """As `Task.truth` says: solvable is what the joints' limits let an arm reach that knows the flight."""
    from torchdyn_plan.tasks.catch.solvable import find_truth

    return find_truth(settings, **episodes)


def judge(settings: CatchSettings, log: Any, truth: Truth) -> Verdict:
    """As `Task.judge` says."""
    import torch

    cause = torch.where(truth.solvable, 1, 0).masked_fill(log.success, -1)
    return Verdict(cause, {}, {})


def record_paths(blocks: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_paths` says: flights that nothing interrupts."""
    from torchdyn_plan.tasks.catch.data import record_flights

    return record_flights(blocks, **how)


def record_arrivals(planner: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_arrivals` says: the cup sent to places on flights, turned against the ball."""
    from torchdyn_plan.tasks.catch.data import record_arm_runs

    return record_arm_runs(planner, **how)


def fitting() -> Any:
    """Sizes of its networks, and how they are scored."""
    from torchdyn_plan.tasks.catch.data import catch_fitting

    return catch_fitting()


TASK = Task(
    name="catch",
    summary="A UR10 with a cup meets a thrown ball in the air.",
    settings=CatchSettings,
    words=Words(success="caught", steps="steps to hold", target="ball"),
    max_steps=220,
    control_step=0.008,
    make_env=make_env,
    digest=lambda: scene().digest(),
    static_planners={"ik": ik},
    planners={"pursuit": pursuit, "meet": meet, "oracle": oracle, "learned": learned},
    rivals=("learned",),
    rows_at_once=(32, 64),
    truth=truth,
    causes=("out of reach", "missed"),
    judge=judge,
    record_paths=record_paths,
    record_arrivals=record_arrivals,
    fitting=fitting,
)
