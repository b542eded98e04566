"""One episode played by one planner, recorded step by step, for the page and for pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number, check_seed
from torchdyn_plan.envs.look import Look
from torchdyn_plan.envs.moving_target import MovingTargetEnv
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.evaluation.episodes import EpisodeLog, ShownTruth, find_truth
from torchdyn_plan.evaluation.study import Study
from torchdyn_plan.evaluation.traces import true_target
from torchdyn_plan.planners import Delivery, Track, TrackedPlanner, TrackState
from torchdyn_plan.planners.tracked import NAMES
from torchdyn_plan.tasks.task import Settings, Task, Truth
from torchdyn_plan.threads import one_thread
from torchdyn_plan.view.insight import GRID, Insight, Watch

NOTHING = -1
"""Code for a missing value: no plan, no status."""
LAST_EPISODE = 9999
"""Highest episode number, because the truth about an episode is computed together with all earlier ones."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """An episode of a task and its planner; the same as episode N of an evaluation with these settings."""

    task: Task
    planner: str
    """One of the task's planners."""
    static: str = ""
    """One of its static planners; the default one for an empty name."""
    settings: Settings | None = None
    """The task's settings; its defaults for None."""
    episode: int = 0
    seed: int = 0
    split: str = "test"
    weights: Path | None = None
    """Folder of the planner's networks, as written by ``train``; the shipped ones for None."""
    delivery: Delivery | None = None
    """When plans become available; at once for None."""
    sensor: Sensor | None = None
    """How the target is measured; exactly for None."""
    track: Track | None = None
    """Filter of the measurements; None for none."""

    def __post_init__(self) -> None:
        check_number("episode", self.episode, minimum=0, maximum=LAST_EPISODE, integer=True)
        check_seed(self.seed)

    @property
    def chosen(self) -> Settings:
        """The settings in use."""
        return self.task.default_settings() if self.settings is None else self.settings

    def make_planner(self) -> Any:
        """The planner, made as in an evaluation."""
        study = Study.of(
            self.task,
            (self.planner,),
            static=self.static or None,
            weights=self.weights,
            delivery=self.delivery,
            split=self.split,
            sensor=self.sensor,
            track=self.track,
            progress=False,
        )
        return study.planners[self.planner]

    def make_env(self) -> MovingTargetEnv:
        """The environment; the next reset starts the episode."""
        batch: dict[str, Any] = {"num_envs": 1, "seed": self.seed, "split": self.split, "num_threads": 1}
        if self.sensor is not None and not self.sensor.is_exact:
            batch["sensor"] = self.sensor
        env = self.task.make_env(self.chosen, **batch)
        env.start_from(self.episode)
        return env

    def find_truth(self) -> Truth:
        """The truth about this episode and all earlier ones."""
        series: dict[str, Any] = {"episodes": self.episode + 1, "seed": self.seed, "split": self.split}
        return find_truth(self.task, self.chosen, static=self.static or None, num_threads=1, **series)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """An episode of T control steps; entries 0 … T hold the observations and plans of each step, T being its end.

    Positions have 3 coordinates; for tasks in a plane the last is 0 [m, world]. Missing values are NaN or `NOTHING`.
    """

    scenario: Scenario
    look: Look
    posture: np.ndarray[Any, Any]
    """``(T + 1, nq)`` generalised positions of the look's model."""
    tool_pos: np.ndarray[Any, Any]
    """``(T + 1, 3)``"""
    target_pos: np.ndarray[Any, Any]
    """``(T + 1, 3)``: the true position, also with a sensor."""
    believed_pos: np.ndarray[Any, Any]
    """``(T + 1, 3)``: the planner's estimate of the target's position; NaN if it sees the true one."""
    measured_pos: np.ndarray[Any, Any]
    """``(T + 1, M, 3)``: measurements that arrived at the step."""
    goal: np.ndarray[Any, Any]
    """``(T + 1, 3)`` goal of the plan in use."""
    countdown: np.ndarray[Any, Any]
    """``(T + 1,)`` control steps until the planned meeting; `NOTHING` for a planner without plans."""
    status: np.ndarray[Any, Any]
    """``(T + 1,)`` `torchdyn_plan.planners.PlanStatus`; `NOTHING` for a planner without plans."""
    replans: np.ndarray[Any, Any]
    """``(T + 1,)`` plans made so far."""
    insights: Sequence[Insight]
    """What each plan was based on, in order."""
    insight_at: np.ndarray[Any, Any]
    """``(T + 1,)`` index of the latest of ``insights``; `NOTHING` for none."""
    success: bool
    cause: str
    """Why the episode failed, one of the task's causes; empty for a success, or if the task defines no causes."""

    @property
    def length(self) -> int:
        """Control steps T of the episode."""
        return len(self.tool_pos) - 1

    def insight(self, step: int) -> Insight | None:
        """What the latest plan at control step ``step`` was based on."""
        number = int(self.insight_at[step])
        return None if number == NOTHING else self.insights[number]


@torch.no_grad()
def record_episode(scenario: Scenario, progress: Callable[[int], object] | None = None) -> Recording:
    """Play the episode to its end.

    Args:
        scenario: the episode and its planner.
        progress: called at each control step; an exception from it ends the recording.

    Raises:
        InputError: an unknown name, a number out of range, or a planner that belongs to another scene.
        WeightsError: weights are missing or damaged.
    """
    with one_thread():
        env, watch = scenario.make_env(), Watch(scenario.make_planner())
        truth, log = None, EpisodeLog.empty(scenario.episode + 1, scenario.task, env)
        if keys.TARGET_FUTURE in read_by(watch.planner) or keys.TRUE_FUTURE in read_by(watch.planner):
            truth = scenario.find_truth()
        shown = ShownTruth(watch.planner, env, None if truth is None else truth.future)
        roll, seen = Roll(env, watch), env.reset()
        while True:
            shown.show(seen)
            posture = env.posture(0)
            seen = watch.planner(seen)
            roll.add(seen, posture)
            if progress is not None:
                progress(len(roll.steps))
            stepped = env.step(seen)
            log.add(stepped)
            if bool(stepped["next", "done"].item()):
                break
            seen = step_mdp(stepped)
        roll.end(stepped, env.posture(0))
        success = bool(log.success[scenario.episode])
        cause = "" if success else find_cause(scenario, log, truth)
        return roll.recording(scenario, success=success, cause=cause)


def read_by(planner: Any) -> Sequence[Any]:
    """Keys that ``planner`` reads; none for a plain function."""
    return getattr(planner, "in_keys", ())


def find_cause(scenario: Scenario, log: EpisodeLog, truth: Truth | None) -> str:
    """Why the episode failed, by the task's verdict; empty if the task gives none."""
    task = scenario.task
    if task.judge is None:
        return ""
    truth = scenario.find_truth() if truth is None else truth
    cause = int(task.judge(scenario.chosen, log, truth).cause[scenario.episode])
    return task.causes[cause] if cause >= 0 else ""


class Roll:
    """Collects the recording while an episode is played, one row for each control step."""

    def __init__(self, env: MovingTargetEnv, watch: Watch) -> None:
        """Start empty."""
        self.env, self.watch, self.look = env, watch, env.look()
        self.steps: list[dict[str, Any]] = []
        self.insights: list[Insight] = []
        self.grid = grid_about(self.look, env.coordinates)

    def add(self, planned: TensorDictBase, posture: np.ndarray[Any, Any]) -> None:
        """Add a step that is ``planned`` but not executed yet, with the world in that ``posture``."""
        plan, step = planned.get(keys.PLAN, None), int(planned[keys.STEP_COUNT].item())
        if plan is not None and plan.get("replanned", None) is not None and bool(plan["replanned"].item()):
            if self.env.coordinates == 3:
                self.grid[:, 2] = planned[keys.TARGET_POS][0, 2]
            insight = self.watch.insight(planned[keys.ROBOT_STATE], self.grid, step)
            self.insights += [] if insight is None else [insight]
        row = self._seen(planned, posture)
        row["goal"] = in_space(planned[keys.GOAL][0]) if keys.GOAL in planned.keys() else row["goal"]  # noqa: SIM118
        if plan is not None and plan.get("status", None) is not None:
            row["countdown"], row["status"] = int(plan["arrival_steps"].item()), int(plan["status"].item())
            row["replans"] = int(plan["replans"].item())
        row["believed_pos"] = self._believed(planned, row["target_pos"])
        self.steps.append(row)

    def end(self, stepped: TensorDictBase, posture: np.ndarray[Any, Any]) -> None:
        """Add the end of the episode, with the last plan."""
        last, seen = self.steps[-1], self._seen(stepped["next"], posture)
        self.steps.append(last | {name: seen[name] for name in ("posture", "tool_pos", "target_pos", "measured_pos")})

    def recording(self, scenario: Scenario, **outcome: Any) -> Recording:
        """The finished recording."""
        columns = {name: np.stack([row[name] for row in self.steps]) for name in self.steps[0]}
        return Recording(scenario=scenario, look=self.look, insights=tuple(self.insights), **columns, **outcome)

    def _seen(self, seen: TensorDictBase, posture: np.ndarray[Any, Any]) -> dict[str, Any]:
        """A step's observations, with empty plan entries."""
        measured = seen.get(keys.MEASURED_POS, None)
        nowhere = np.full(3, np.nan)
        return {
            "posture": posture,
            "tool_pos": in_space(seen[keys.TOOL_POS][0]),
            "target_pos": in_space(true_target(seen)[0]),
            "measured_pos": np.full((1, 3), np.nan) if measured is None else in_space(measured[0]),
            "believed_pos": nowhere,
            "goal": nowhere,
            "countdown": NOTHING,
            "status": NOTHING,
            "replans": 0,
            "insight_at": len(self.insights) - 1,
        }

    def _believed(self, planned: TensorDictBase, true_pos: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """The planner's estimate of the target's position, NaN if it sees the true one, ``true_pos`` (3)."""
        planner = self.watch.planner
        if not isinstance(planner, TrackedPlanner):
            held = in_space(planned[keys.TARGET_POS][0])
            return np.full(3, np.nan) if np.allclose(held, true_pos) else held
        state = TrackState(*(planned[keys.PLAN, name] for name in NAMES))
        now = planned[keys.STEP_COUNT].reshape(-1) * planner.control_step
        return in_space(planner.track.at(state, now).pos[0])


def grid_about(look: Look, coordinates: int) -> Tensor:
    """Grid points ``(GRID², D)`` in the horizontal square around the camera's focus [m, world]."""
    side = torch.linspace(-look.half_side, look.half_side, GRID)
    level = torch.cartesian_prod(side + look.lookat[0], side + look.lookat[1])
    return torch.nn.functional.pad(level, (0, coordinates - 2))


def in_space(place: Tensor) -> np.ndarray[Any, Any]:
    """Positions ``(*B, 3)`` from (*B, 2 or 3), at height 0 for 2 coordinates."""
    return torch.nn.functional.pad(place, (0, 3 - place.shape[-1])).double().numpy()
