"""Chase as a task: what varies, its planners, and where everything else of it is defined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchdyn_plan.tasks.task import PlannerParts, Settings, Task, Truth, Verdict, Words, setting

HORIZON = 300
"""Control steps that forecasts look ahead."""
LEAST = "least_steps"
"""Evidence: the first control step at which a base that knows all could have met the walker; -1 for never."""


@dataclass(frozen=True, kw_only=True)
class ChaseSettings(Settings):
    """How people walk."""

    speed: float = setting(
        1.0, text="Speed of the walker", unit="m/s", minimum=0.0, maximum=3.0, sweep=(0.0, 0.4, 0.8, 1.2)
    )
    turning: float = setting(
        0.0,
        text="How fast the walker turns, to either side",
        unit="deg/s",
        minimum=0.0,
        maximum=360.0,
        sweep=(0.0, 15.0, 30.0),
    )


def world() -> Any:
    """The base and where walkers start."""
    from torchdyn_plan.envs.chase.env import ChaseWorld

    return ChaseWorld()


def make_env(settings: ChaseSettings, *, num_threads: int = 0, **batch: Any) -> Any:
    """The environment at these settings; ``batch`` as `Task.make_env` says. It simulates in one thread."""
    from torchdyn_plan.envs.chase.env import ChaseEnv

    return ChaseEnv(speed=settings.speed, turning=settings.turning, **batch)


def drive(*, chunk: int | None = None, weights: Any = None) -> Any:
    """Straight to the goal at full speed, and past it; there are no ``weights``, and rows do not depend on others."""
    from torchdyn_plan.planners import PointPlanner

    base = world()
    return PointPlanner(
        speed=base.base_speed,
        acceleration=base.base_acceleration,
        control_step=base.control_step,
        stops=False,
        radius=base.radius,
    )


def forecaster() -> Any:
    """Who walks goes straight on."""
    from torchdyn_plan.nets import ConstantVelocity

    return ConstantVelocity(horizon=HORIZON, control_step=world().control_step)


def parts_of(parts: PlannerParts) -> dict[str, Any]:
    """What all planners that plan share."""
    return {"chunk": parts.chunk, "scene": world().digest()}


def pursuit(parts: PlannerParts) -> Any:
    """Runs after the walker."""
    from torchdyn_plan.planners import TargetPursuit

    return TargetPursuit(parts.static, scene=world().digest()).eval()


def meet(parts: PlannerParts) -> Any:
    """`DynamicPlanner` with its defaults: nothing is trained or tuned."""
    from torchdyn_plan.planners import DynamicPlanner

    return DynamicPlanner(parts.static, forecaster(), **parts_of(parts)).eval()


def corner(parts: PlannerParts) -> Any:
    """The paper's configuration."""
    from torchdyn_plan.planners import DynamicPlanner

    static = parts.static
    return DynamicPlanner.paper(static, forecaster(), static.arrival_model(), **parts_of(parts)).eval()


def oracle(parts: PlannerParts) -> Any:
    """`DynamicPlanner` with its defaults, on the true future."""
    from torchdyn_plan.planners import DynamicPlanner, RecordedFuture

    return DynamicPlanner(parts.static, RecordedFuture(HORIZON), **parts_of(parts)).eval()


def truth(settings: ChaseSettings, **episodes: Any) -> Truth:
    """As `Task.truth` says: solvable is what a base that knows the walk can meet."""
    from torchdyn_plan.tasks.chase.optimum import find_truth

    return find_truth(settings, **episodes)


def judge(settings: ChaseSettings, log: Any, truth: Truth) -> Verdict:
    """As `Task.judge` says; the evidence is when the best base would have met the walker."""
    import torch

    from torchdyn_plan.tasks.chase.optimum import earliest_meeting

    cause = torch.where(truth.solvable, 1, 0).masked_fill(log.success, -1)
    return Verdict(cause, {}, {LEAST: earliest_meeting(world(), truth.future)})


def measure(outcomes: Any) -> dict[str, float | None]:
    """Time to meet by that of the best base, in the mean over the episodes in which both have met."""
    both = outcomes.success & (outcomes.evidence[LEAST] > 0)
    if not both.any():
        return {"time_by_least": None}
    return {"time_by_least": (outcomes.steps[both] / outcomes.evidence[LEAST][both]).mean().item()}


TASK = Task(
    name="chase",
    summary="A base on wheels meets somebody who walks past.",
    settings=ChaseSettings,
    words=Words(success="met", steps="steps to meet", target="walker"),
    max_steps=450,
    control_step=0.02,
    make_env=make_env,
    digest=lambda: world().digest(),
    static_planners={"drive": drive},
    planners={"pursuit": pursuit, "corner": corner, "meet": meet, "oracle": oracle},
    rows_at_once=(256, 256),
    truth=truth,
    causes=("out of reach", "late"),
    judge=judge,
    measure=measure,
)
