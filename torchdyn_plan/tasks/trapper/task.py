"""Trapper as a task: what varies, its planners, and where everything else of it is defined."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from torchdyn_plan.envs.trapper.scene import TrapperScene

    Scene = TrapperScene | str

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


def make_env(scene: Scene, settings: TrapperSettings, **batch: Any) -> Any:
    """The environment at these settings in ``scene``; ``batch`` as `Task.make_env` says."""
    from torchdyn_plan.envs.trapper.env import TrapperEnv

    return TrapperEnv(velocity=settings.velocity, friction=settings.friction, scene=scene, **batch)


def digest(scene: Scene) -> str:
    """Hash of ``scene``."""
    from torchdyn_plan.envs.trapper.scene import trapper_scene

    return trapper_scene(scene).digest()


def ik_planner(scene: Any = None, *, chunk: int | None = None, weights: Any = None, **settings: Any) -> Any:
    """The static planner by inverse kinematics, for the arm, the box and the table of ``scene``, or of that name.

    ``settings`` are those of `IKPlanner`; there are no ``weights``.
    """
    from torchdyn_plan.envs.trapper.scene import trapper_scene
    from torchdyn_plan.kinematics import Arm
    from torchdyn_plan.planners import IKPlanner
    from torchdyn_plan.tasks.trapper.approach import BoxApproach

    scene = trapper_scene(scene)
    arm = Arm.ur5(tool_length=scene.tool_length, speed_limit=scene.joint_speed)
    own = {"noisy_damping": 0.1, "control_step": scene.control_step, "chunk": chunk}
    return IKPlanner(arm, approach=BoxApproach.of(scene), **(own | settings))


def policy_planner(scene: Any = None, *, chunk: int | None = None, weights: Any = None, **settings: Any) -> Any:
    """The learned static planner, that keeps within the reach of the arm of ``scene``, or of that name.

    ``weights`` are those that ship for the scene of that name by default; ``settings`` are those of `PolicyPlanner`.
    """
    from torchdyn_plan.envs.trapper.scene import trapper_scene
    from torchdyn_plan.planners import PolicyPlanner
    from torchdyn_plan.tasks.trapper.approach import BoxApproach

    approach = BoxApproach.of(trapper_scene(scene))
    ships = trapper_task(scene).weights_name if isinstance(scene, str) else NAME
    return PolicyPlanner.from_pretrained(weights or ships, approach=approach, chunk=chunk, **settings)


def ball_lost(scene: Any) -> Any:
    """When a ball in ``scene`` is lost: in a pocket."""
    from torchdyn_plan.planners import LostBelow

    # A ball that is seen is lost a whole diameter down; a forecast that is unsure lies between table and pocket.
    return LostBelow(seen_below=-scene.ball_radius, forecast_below=0.0)


def common(parts: PlannerParts) -> dict[str, Any]:
    """What all planners that plan share."""
    from torchdyn_plan.envs.trapper.scene import trapper_scene

    scene = trapper_scene(parts.task.scene)
    return {"lost": ball_lost(scene), "chunk": parts.chunk, "scene": scene.digest()}


def going(parts: PlannerParts) -> dict[str, Any]:
    """What planners share that go to the meeting place."""
    from torchdyn_plan.envs.trapper.scene import trapper_scene
    from torchdyn_plan.tasks.trapper.keep import GoToAndKeep

    return common(parts) | {"maneuver": GoToAndKeep.of(trapper_scene(parts.task.scene))}


def pursuit(parts: PlannerParts) -> Any:
    """Runs after the ball (paper, Section IV-A.1)."""
    from torchdyn_plan.planners import TargetPursuit

    return TargetPursuit(parts.static, scene=parts.task.digest()).eval()


def wait(parts: PlannerParts) -> Any:
    """Goes to where the forecast ends (paper, III-B.4)."""
    from torchdyn_plan.planners import wait_at_end

    return wait_at_end(parts.static, parts.forecaster, parts.eta, **going(parts)).eval()


def corner(parts: PlannerParts) -> Any:
    """The paper's planner, with arrival times as the paper has them: none is *never*."""
    from torchdyn_plan.planners import DynamicPlanner

    return DynamicPlanner.paper(parts.static, parts.forecaster, parts.nearest_eta, **going(parts)).eval()


def corner_never(parts: PlannerParts) -> Any:
    """The paper's planner, with arrival times that know *never*."""
    from torchdyn_plan.planners import DynamicPlanner

    return DynamicPlanner.paper(parts.static, parts.forecaster, parts.eta, **going(parts)).eval()


def oracle(parts: PlannerParts) -> Any:
    """The paper's planner on the true future, simulated again after the ball was touched (paper, Section IV-A.2)."""
    from torchdyn_plan.planners import oracle_trajectory

    return oracle_trajectory(parts.static, parts.nearest_eta, recorded=False, **going(parts)).eval()


def recorded_oracle(parts: PlannerParts) -> Any:
    """The paper's planner on the recorded future, which is true until the ball is touched."""
    from torchdyn_plan.planners import oracle_trajectory

    return oracle_trajectory(parts.static, parts.nearest_eta, **going(parts)).eval()


def exact(parts: PlannerParts) -> Any:
    """The paper's planner with a search of the whole forecast."""
    from torchdyn_plan.planners import DynamicPlanner, ExactSearch

    return DynamicPlanner.paper(parts.static, parts.forecaster, parts.eta, search=ExactSearch(), **going(parts)).eval()


def wait_and_drop(parts: PlannerParts) -> Any:
    """Waits above the most promising meeting, and drops in time: the best that there is."""
    return waits_and_drops(parts, parts.forecaster_by_noise, parts.eta, parts.capture)


def untrained(parts: PlannerParts) -> Any:
    """The same without any training: with the mechanics of the ball, and the limits of the arm's joints."""
    from torchdyn_plan.envs.trapper.scene import trapper_scene
    from torchdyn_plan.tasks.trapper.untrained import arm_arrival, billiard

    scene = trapper_scene(parts.task.scene)
    return waits_and_drops(parts, billiard(scene), arm_arrival(scene, ik_planner(scene)))


def pace_and_path(parts: PlannerParts) -> Any:
    """A rival without training or forecast, by a published idea: the static plan at another pace, and shifted."""
    from torchdyn_plan.envs.trapper.scene import trapper_scene
    from torchdyn_plan.tasks.trapper.untrained import pace_and_path

    return pace_and_path(trapper_scene(parts.task.scene), parts.static).eval()


def waits_and_drops(parts: PlannerParts, forecaster: Any, eta: Any, capture: Any = None) -> Any:
    """A planner that waits and drops, by this forecaster and these models of arrivals and captures."""
    from torchdyn_plan.envs.trapper.scene import trapper_scene
    from torchdyn_plan.planners import DynamicPlanner, ReplanSchedule
    from torchdyn_plan.tasks.trapper.wait_and_drop import WaitAndDrop, waiting_search

    scene = trapper_scene(parts.task.scene)
    # Candidates are 5 steps apart: a plan every 5 steps keeps them on the same places, and so the waiting tool still.
    own = {
        "capture": capture,
        "search": waiting_search(scene, by_capture=capture is not None),
        "schedule": ReplanSchedule.every(5, first_step=3),
        "maneuver": WaitAndDrop.of(scene),
    }
    return DynamicPlanner(parts.static, forecaster, eta, **own, **common(parts)).eval()


def truth(scene: Scene, settings: TrapperSettings, **episodes: Any) -> Truth:
    """As `Task.truth` says: recorded rolls, and which balls the arm can be at in time (paper, Section IV-B)."""
    from torchdyn_plan.tasks.trapper.solvable import record_truth

    return record_truth(settings.velocity, settings.friction, scene=scene, **episodes)


def judge(scene: Scene, settings: TrapperSettings, log: Any, truth: Truth) -> Verdict:
    """As `Task.judge` says: the cause of each failure, from what was recorded step by step."""
    from torchdyn_plan.envs.trapper.scene import trapper_scene
    from torchdyn_plan.tasks.trapper.causes import judge_episodes

    return judge_episodes(log, truth, trapper_scene(scene))


def measure(outcomes: Any) -> dict[str, float | None]:
    """As `Task.measure` says: how far the joints pass their speed limits."""
    from torchdyn_plan.tasks.trapper.causes import measure

    return measure(outcomes)


def record_paths(scene: Scene, blocks: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_paths` says: balls rolled alone."""
    from torchdyn_plan.tasks.trapper.data import record_rolls

    return record_rolls(blocks, scene=scene, **how)


def record_arrivals(scene: Scene, planner: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_arrivals` says: the arm driven from goal to goal."""
    from torchdyn_plan.tasks.trapper.data import record_arm_runs

    return record_arm_runs(planner, scene=scene, **how)


def record_captures(scene: Scene, static: str, blocks: Any, **how: Any) -> dict[str, Any]:
    """As `Task.record_captures` says: attempts of *wait and drop*, which explores."""
    from torchdyn_plan.tasks.trapper.attempts import record_attempts

    planner = trapper_task(scene).planner("wait_and_drop", static)
    return record_attempts(planner, blocks, scene=scene, **how)


def fitting(scene: Scene) -> Any:
    """Sizes of its networks, and how they are scored."""
    from torchdyn_plan.tasks.trapper.data import trapper_fitting

    return trapper_fitting(scene)


def goal_task(scene: Scene, options: PolicyOptions, *, num_threads: int = 0) -> Any:
    """Trapper at rest, as a policy's training sees it."""
    from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask

    return TrapperGoalTask(period=options.period, num_threads=num_threads, scene=scene)


def recipe() -> Any:
    """How its policy is trained."""
    from torchdyn_plan.training.goal_task import DDPGRecipe

    return DDPGRecipe()


def paper() -> PaperCurves:
    """The paper's Figure 4."""
    from torchdyn_plan.tasks.trapper.paper import TrapperCurves

    return TrapperCurves()


SCENES = ("ur5", "paper")
"""Names of its scenes, as `torchdyn_plan.envs.trapper.scene.SCENES` has them."""


def trapper_task(scene: Scene) -> Task:
    """Trapper in ``scene``, or in the scene of that name."""
    return Task(
        name=NAME,
        summary="A UR5 drops a box over a ball that rolls on a table with eight pockets.",
        settings=TrapperSettings,
        words=Words(success="trapped", steps="steps to trap", target="ball"),
        max_steps=500,
        control_step=0.004,
        scene=scene,
        scenes={name: partial(trapper_task, name) for name in SCENES},
        # Only the arm differs from scene to scene.
        path_weights=NAME,
        make_env=partial(make_env, scene),
        digest=partial(digest, scene),
        static_planners={"ik": partial(ik_planner, scene), "rl": partial(policy_planner, scene)},
        planners={
            "pursuit": pursuit,
            "wait": wait,
            "corner": corner,
            "oracle": oracle,
            "exact": exact,
            "wait_and_drop": wait_and_drop,
            "corner_never": corner_never,
            "recorded_oracle": recorded_oracle,
            "untrained": untrained,
            "pace_and_path": pace_and_path,
        },
        rivals=("corner_never", "recorded_oracle", "untrained", "pace_and_path"),
        truth=partial(truth, scene),
        causes=CAUSES,
        judge=partial(judge, scene),
        measure=measure,
        record_paths=partial(record_paths, scene),
        record_arrivals=partial(record_arrivals, scene),
        record_captures=partial(record_captures, scene),
        fitting=partial(fitting, scene),
        policies={
            "policy": PolicyTraining(
                summary="A goal-conditioned policy for the arm, by DDPG and hindsight experience replay.",
                options=PolicyOptions,
                goal_task=partial(goal_task, scene),
                recipe=recipe,
                score_every=5,
            )
        },
        paper=paper,
    )


CAUSES = ("unreachable", "planner_too_slow", "forecast", "eta", "early_contact", "pocketed", "late")
"""Causes of failure, in the order in which they are asked."""
TASK = trapper_task(SCENES[0])
