"""Dynamic FetchReach as a task: what varies, its planners, and where everything else of it is defined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchdyn_plan.tasks.task import PaperCurves, PlannerParts, PolicyTraining, Settings, Task, Truth, Words, setting

NAME = "fetch_reach"
FETCH_GAIN = 31.0
"""Gain of the proportional controller [1/m]: an action of 1 moves the gripper by 3.1 to 3.3 cm."""
TOP_SPEED = 0.2
"""No goal moves faster than this [m per control step]."""


@dataclass(frozen=True, kw_only=True)
class FetchReachSettings(Settings):
    """The goal's motion, by default as in DHER."""

    velocity: float = setting(
        0.011,
        text="How far the goal moves",
        unit="m per control step",
        minimum=0.0,
        maximum=TOP_SPEED,
        sweep=(0.001, 0.006, 0.011, 0.016, 0.021, 0.026, 0.031, 0.036, 0.041, 0.046, 0.051),
    )
    motion: str = setting(
        "straight",
        text="How the goal moves: straight along x, on a circle, or random (straight in any level direction)",
        choices=("straight", "circle", "random"),
    )
    goal_range: float = setting(
        0.1,
        text="Goals on lines start within this of the gripper along either axis, 0.15 in FetchReach",
        unit="m",
        minimum=0.0,
    )
    threshold: float = setting(
        0.01, text="A gripper within this of its goal is there, 0.05 in FetchReach", unit="m", minimum=1e-6
    )


@dataclass(frozen=True, kw_only=True)
class NoOptions:
    """None."""


@dataclass(frozen=True, kw_only=True)
class DHEROptions:
    """Of a policy that learns on moving goals."""

    velocity: float = 0.011
    """How far the goals move [m per control step]."""

    def __post_init__(self) -> None:
        from torchdyn_plan.checks import check_number

        check_number("velocity", self.velocity, minimum=0.0, maximum=TOP_SPEED)


def make_env(settings: FetchReachSettings, **batch: Any) -> Any:
    """The environment at these settings; ``batch`` as `Task.make_env` says."""
    from torchdyn_plan.envs.fetch_reach.env import DynamicReachEnv

    return DynamicReachEnv(
        velocity=settings.velocity,
        motion=settings.motion,
        goal_range=settings.goal_range,
        threshold=settings.threshold,
        **batch,
    )


def digest() -> str:
    """Hash of the arm's model."""
    from torchdyn_plan.envs.fetch_reach.simulation import fetch_digest

    return fetch_digest()


def proportional(*, chunk: int | None = None, weights: Any = None) -> Any:
    """Pulls the gripper straight to the goal; a row's action depends on that row alone. There are no ``weights``."""
    from torchdyn_plan.planners import ProportionalController

    return ProportionalController(gain=FETCH_GAIN, action_size=4)


def policy_planner(*, chunk: int | None = None, weights: Any = None) -> Any:
    """The learned static planner; ``weights`` ship by default."""
    from torchdyn_plan.planners import PolicyPlanner

    return PolicyPlanner.from_pretrained(weights or NAME, chunk=chunk)


def common(parts: PlannerParts) -> dict[str, Any]:
    """What all planners that plan share: a plan at every step, from the first on."""
    from torchdyn_plan.planners import ReplanSchedule

    return {"schedule": ReplanSchedule.every(1, first_step=0), "chunk": parts.chunk, "scene": digest()}


def pursuit(parts: PlannerParts) -> Any:
    """Runs after the goal."""
    from torchdyn_plan.planners import TargetPursuit

    return TargetPursuit(parts.static, scene=digest()).eval()


def corner(parts: PlannerParts) -> Any:
    """The paper's planner."""
    from torchdyn_plan.planners import DynamicPlanner

    return DynamicPlanner.paper(parts.static, parts.forecaster, parts.eta, **common(parts)).eval()


def oracle(parts: PlannerParts) -> Any:
    """The paper's planner on the recorded future."""
    from torchdyn_plan.planners import oracle_trajectory

    horizon = fitting().forecaster.horizon
    return oracle_trajectory(parts.static, parts.eta, horizon=horizon, **common(parts)).eval()


def exact(parts: PlannerParts) -> Any:
    """A search of the whole forecast; with bins of one step every step is a candidate."""
    from torchdyn_plan.planners import DynamicPlanner, ExactSearch

    search = ExactSearch(stride=1, first=1)
    return DynamicPlanner(parts.static, parts.forecaster, parts.eta, search=search, **common(parts)).eval()


def dher(parts: PlannerParts) -> Any:
    """The rival: a policy that learned on moving goals (Fang et al., ICLR 2019) runs after the goal."""
    from torchdyn_plan.planners import PolicyPlanner, TargetPursuit

    return TargetPursuit(PolicyPlanner.from_pretrained("dher", chunk=parts.chunk), scene=digest()).eval()


def truth(settings: FetchReachSettings, **episodes: Any) -> Truth:
    """As `Task.truth` says: solvable is what a search that knows the goal's path solves."""
    from torchdyn_plan.tasks.fetch_reach.ceiling import find_truth

    return find_truth(settings, **episodes)


def record_paths(blocks: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_paths` says: goals, no gripper near."""
    from torchdyn_plan.tasks.fetch_reach.data import record_goal_paths

    return record_goal_paths(blocks, **how)


def record_arrivals(planner: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_arrivals` says: the gripper pulled from goal to goal."""
    from torchdyn_plan.tasks.fetch_reach.data import record_fetch_runs

    return record_fetch_runs(planner, **how)


def fitting() -> Any:
    """Sizes of its networks, and how they are scored."""
    from torchdyn_plan.tasks.fetch_reach.data import fetch_reach_fitting

    return fetch_reach_fitting()


def resting_goals(options: NoOptions, *, num_threads: int = 0) -> Any:
    """Goals at rest, as a policy's training sees them."""
    from torchdyn_plan.tasks.fetch_reach.policy import FetchGoalTask

    return FetchGoalTask(num_threads=num_threads)


def moving_goals(options: DHEROptions, *, num_threads: int = 0) -> Any:
    """Goals that move, as DHER's training sees them."""
    from torchdyn_plan.tasks.fetch_reach.policy import FetchGoalTask

    return FetchGoalTask(velocity=options.velocity, num_threads=num_threads)


def recipe() -> Any:
    """How its policy is trained."""
    from torchdyn_plan.training.goal_task import DDPGRecipe

    return DDPGRecipe()


def dher_recipe() -> Any:
    """How DHER's authors train."""
    from torchdyn_plan.tasks.fetch_reach.policy import DHER

    return DHER


def paper() -> PaperCurves:
    """The paper's Figure 5."""
    from torchdyn_plan.tasks.fetch_reach.paper import FetchReachCurves

    return FetchReachCurves()


TASK = Task(
    name=NAME,
    summary="A Fetch arm reaches for a goal that moves.",
    settings=FetchReachSettings,
    words=Words(success="reached", steps="steps to reach", target="goal"),
    max_steps=50,
    control_step=0.04,
    make_env=make_env,
    digest=digest,
    static_planners={"proportional": proportional, "rl": policy_planner},
    planners={"pursuit": pursuit, "corner": corner, "oracle": oracle, "exact": exact, "dher": dher},
    rivals=("dher",),
    # Every row plans at every step.
    rows_at_once=(256, 64),
    truth=truth,
    record_paths=record_paths,
    record_arrivals=record_arrivals,
    fitting=fitting,
    policies={
        "policy": PolicyTraining(
            summary="A goal-conditioned policy for resting goals, by DDPG and hindsight experience replay.",
            options=NoOptions,
            goal_task=resting_goals,
            recipe=recipe,
            score_every=10,
        ),
        "dher": PolicyTraining(
            summary="A policy for moving goals, by DDPG and dynamic hindsight experience replay.",
            options=DHEROptions,
            goal_task=moving_goals,
            recipe=dher_recipe,
            score_every=10,
        ),
    },
    paper=paper,
)
