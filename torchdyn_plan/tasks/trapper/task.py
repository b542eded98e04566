"""Trapper as a task: what varies, its planners, and where everything else of it is defined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchdyn_plan.tasks.task import (
    PaperCurves,
    PlannerParts,
    PolicyTraining,
    Settings,
    Task,
    Truth,
    Verdict,
    Words,
    setting,
)

NAME = "trapper"


@dataclass(frozen=True, kw_only=True)
class TrapperSettings(Settings):
    """The ball's motion."""

    velocity: float = setting(
        3.0, text="Velocity of the ball at the start", unit="m/s", minimum=0.0, maximum=20.0, sweep=(0, 1, 2, 3, 4, 5)
    )
    friction: float = setting(
        0.0, text="Friction loss of the ball", unit="N", minimum=0.0, maximum=1000.0, sweep=(0, 2.5, 5, 7.5, 9.5)
    )


@dataclass(frozen=True, kw_only=True)
class PolicyOptions:
    """Of a policy."""

    period: int = 5
    """Control steps for which an action holds while it learns."""

    def __post_init__(self) -> None:
        from torchdyn_plan.checks import check_number

        check_number("period", self.period, minimum=1, integer=True)


def make_env(settings: TrapperSettings, **batch: Any) -> Any:
    """The environment at these settings; ``batch`` as `Task.make_env` says."""
    from torchdyn_plan.envs.trapper.env import TrapperEnv

    return TrapperEnv(velocity=settings.velocity, friction=settings.friction, **batch)


def digest() -> str:
    """Hash of the scene."""
    from torchdyn_plan.envs.trapper.scene import TrapperScene

    return TrapperScene().digest()


def ik_planner(scene: Any = None, *, chunk: int | None = None, weights: Any = None, **settings: Any) -> Any:
    """The static planner by inverse kinematics, for the arm, the box and the table of ``scene``.

    ``settings`` are those of `IKPlanner`; there are no ``weights``.
    """
    from torchdyn_plan.envs.trapper.scene import TrapperScene
    from torchdyn_plan.kinematics import Arm
    from torchdyn_plan.planners import IKPlanner
    from torchdyn_plan.tasks.trapper.approach import BoxApproach

    scene = scene or TrapperScene()
    arm = Arm.ur5(tool_length=scene.tool_length)
    return IKPlanner(arm, approach=BoxApproach.of(scene), control_step=scene.control_step, chunk=chunk, **settings)


def policy_planner(scene: Any = None, *, chunk: int | None = None, weights: Any = None, **settings: Any) -> Any:
    """The learned static planner, that keeps within the reach of the arm of ``scene``; ``weights`` ship by default.

    ``settings`` are those of `PolicyPlanner`.
    """
    from torchdyn_plan.envs.trapper.scene import TrapperScene
    from torchdyn_plan.planners import PolicyPlanner
    from torchdyn_plan.tasks.trapper.approach import BoxApproach

    approach = BoxApproach.of(scene or TrapperScene())
    return PolicyPlanner.from_pretrained(weights or NAME, approach=approach, chunk=chunk, **settings)


def ball_lost(scene: Any) -> Any:
    """When a ball in ``scene`` is lost: in a pocket."""
    from torchdyn_plan.planners import LostBelow

    # A ball that is seen is lost a whole diameter down; a forecast that is unsure lies between table and pocket.
    return LostBelow(seen_below=-scene.ball_radius, forecast_below=0.0)


def common(parts: PlannerParts) -> dict[str, Any]:
    """What all planners that plan share."""
    from torchdyn_plan.envs.trapper.scene import TrapperScene

    scene = TrapperScene()
    return {"lost": ball_lost(scene), "chunk": parts.chunk, "scene": scene.digest()}


def pursuit(parts: PlannerParts) -> Any:
    """Runs after the ball (paper, Section IV-A.1)."""
    from torchdyn_plan.planners import TargetPursuit

    return TargetPursuit(parts.static, scene=digest()).eval()


def wait(parts: PlannerParts) -> Any:
    """Goes to where the forecast ends (paper, III-B.4)."""
    from torchdyn_plan.planners import wait_at_end

    return wait_at_end(parts.static, parts.forecaster, parts.eta, **common(parts)).eval()


def corner(parts: PlannerParts) -> Any:
    """The paper's planner."""
    from torchdyn_plan.planners import DynamicPlanner

    return DynamicPlanner(parts.static, parts.forecaster, parts.eta, **common(parts)).eval()


def oracle(parts: PlannerParts) -> Any:
    """The paper's planner on the recorded future (paper, Section IV-A.2)."""
    from torchdyn_plan.planners import oracle_trajectory

    return oracle_trajectory(parts.static, parts.eta, **common(parts)).eval()


def exact(parts: PlannerParts) -> Any:
    """The paper's planner with a search of the whole forecast."""
    from torchdyn_plan.planners import DynamicPlanner, ExactSearch

    return DynamicPlanner(parts.static, parts.forecaster, parts.eta, search=ExactSearch(), **common(parts)).eval()


def wait_and_drop(parts: PlannerParts) -> Any:
    """Waits above the most promising meeting, and drops in time: the best that there is."""
    return waits_and_drops(parts, parts.spread_forecaster, parts.eta)


def untrained(parts: PlannerParts) -> Any:
    """The same without any training: with the mechanics of the ball, and the limits of the arm's joints."""
    from torchdyn_plan.envs.trapper.scene import TrapperScene
    from torchdyn_plan.tasks.trapper.untrained import arm_arrival, billiard

    scene = TrapperScene()
    return waits_and_drops(parts, billiard(scene), arm_arrival(scene, ik_planner(scene)))


def waits_and_drops(parts: PlannerParts, forecaster: Any, eta: Any) -> Any:
    """A planner that waits and drops, by this forecaster and this model of arrivals."""
    from torchdyn_plan.envs.trapper.scene import TrapperScene
    from torchdyn_plan.planners import DynamicPlanner, ReplanSchedule
    from torchdyn_plan.tasks.trapper.wait_and_drop import WaitAndDrop, waiting_search

    scene = TrapperScene()
    # Candidates are 5 steps apart: a plan every 5 steps keeps them on the same places, and so the waiting tool still.
    own = {"search": waiting_search(scene), "schedule": ReplanSchedule.every(5), "maneuver": WaitAndDrop.of(scene)}
    return DynamicPlanner(parts.static, forecaster, eta, **own, **common(parts)).eval()


def truth(settings: TrapperSettings, **episodes: Any) -> Truth:
    """As `Task.truth` says: recorded rolls, and which balls the arm can be at in time (paper, Section IV-B)."""
    from torchdyn_plan.tasks.trapper.solvable import record_truth

    return record_truth(settings.velocity, settings.friction, **episodes)


def judge(settings: TrapperSettings, log: Any, truth: Truth) -> Verdict:
    """As `Task.judge` says: the cause of each failure, from what was recorded step by step."""
    from torchdyn_plan.tasks.trapper.causes import judge_episodes

    return judge_episodes(log, truth)


def record_paths(blocks: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_paths` says: balls rolled alone."""
    from torchdyn_plan.tasks.trapper.data import record_rolls

    return record_rolls(blocks, **how)


def record_arrivals(planner: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_arrivals` says: the arm driven from goal to goal."""
    from torchdyn_plan.tasks.trapper.data import record_arm_runs

    return record_arm_runs(planner, **how)


def fitting() -> Any:
    """Sizes of its networks, and how they are scored."""
    from torchdyn_plan.tasks.trapper.data import trapper_fitting

    return trapper_fitting()


def goal_task(options: PolicyOptions, *, num_threads: int = 0) -> Any:
    """Trapper at rest, as a policy's training sees it."""
    from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask

    return TrapperGoalTask(period=options.period, num_threads=num_threads)


def recipe() -> Any:
    """How its policy is trained."""
    from torchdyn_plan.training.goal_task import DDPGRecipe

    return DDPGRecipe()


def paper() -> PaperCurves:
    """The paper's Figure 4."""
    from torchdyn_plan.tasks.trapper.paper import TrapperCurves

    return TrapperCurves()


TASK = Task(
    name=NAME,
    summary="A UR5 drops a box over a ball that rolls on a table with eight pockets.",
    settings=TrapperSettings,
    words=Words(success="trapped", steps="steps to trap", target="ball"),
    max_steps=500,
    control_step=0.004,
    make_env=make_env,
    digest=digest,
    static_planners={"ik": ik_planner, "rl": policy_planner},
    planners={
        "pursuit": pursuit,
        "wait": wait,
        "corner": corner,
        "oracle": oracle,
        "exact": exact,
        "wait_and_drop": wait_and_drop,
        "untrained": untrained,
    },
    rivals=("untrained",),
    truth=truth,
    causes=("unreachable", "planner_too_slow", "forecast", "eta", "early_contact", "pocketed", "late"),
    judge=judge,
    record_paths=record_paths,
    record_arrivals=record_arrivals,
    fitting=fitting,
    policies={
        "policy": PolicyTraining(
            summary="A goal-conditioned policy for the arm, by DDPG and hindsight experience replay.",
            options=PolicyOptions,
            goal_task=goal_task,
            recipe=recipe,
            score_every=5,
        )
    },
    paper=paper,
)
