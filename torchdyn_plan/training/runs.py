"""Runs of a static planner from goal to goal, and what they teach about arrival times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchdyn_plan.envs.scene import TrapperScene

STATES_PER_RUN = 5
"""Intermediate states taken from each run (paper, Section III-B.3)."""


class RunningTask(Protocol):
    """Arms that a static planner drives to goals, as `torchdyn_plan.envs.reaching.ReachingTask` does."""

    @property
    def robot_state(self) -> Tensor:
        """What an ETA network reads, ``(N, S)``."""
        ...

    def reset(self) -> None:
        """Put every arm at its start."""
        ...

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each arm is at ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""
        ...

    def step(self, goal: Tensor) -> None:
        """One control step of every arm towards ``goal`` (N, 3) [m, world]."""
        ...


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """How runs follow one another; times are control steps. By default as for Trapper."""

    goals: Callable[[int, torch.Generator], Tensor]
    """Draws so many goals, ``(count, 3)`` [m, world]."""
    at_rest: Callable[[Tensor], Tensor]
    """Which robot states (N, S) are at rest, ``(N,)``: an arm that comes to rest elsewhere never arrives."""
    sequence: int = 400
    """Length of a sequence of runs, which begins at the start."""
    longest: int = 240
    """A run that has neither arrived nor come to rest by then is given up."""
    restless: bool = False
    """The arm never comes to rest: a run that is given up never arrives. Otherwise such a run teaches nothing."""
    redirected: float = 0.35
    """Share of runs that are given another goal on their way, and teach nothing themselves."""
    redirected_within: int = 90
    """A run that is redirected is so by then."""
    starting: int = 15
    """By then a new goal has set an arm in motion."""


def trapper_runs(scene: TrapperScene, *, restless: bool = False) -> RunPlan:
    """Goals of `draw_goals`; a UR5 whose joints are slower than `AT_REST` is at rest."""
    return RunPlan(
        restless=restless,
        goals=lambda count, draw: draw_goals(scene, count, draw),
        at_rest=lambda state: (state[:, 6:12].abs() < AT_REST).all(-1),
    )


AT_REST = 0.05
"""Joint speeds below this are rest [rad/s]."""


def record_runs(task: RunningTask, plan: RunPlan, draw: torch.Generator) -> dict[str, Tensor]:
    """One sequence of runs of every arm: a new goal when it arrives, comes to rest elsewhere, or is redirected.

    Args:
        task: arms driven by the static planner.
        plan: goals, and how runs follow one another.
        draw: source of goals, redirections and sampled states.

    Returns:
        n samples, `STATES_PER_RUN` of each run, the first at its start: ``robot_state`` (n, S), ``goal`` (n, 3)
        [m, world], ``arrival`` (n,) control steps from the state to the goal or -1 for never, ``run`` (n,) numbers.
    """
    task.reset()
    count, size = task.robot_state.shape
    states = torch.empty(plan.sequence + 1, count, size)
    goal, given = plan.goals(count, draw), torch.zeros(count, dtype=torch.int64)
    turning = _turning(plan, count, draw)
    samples: list[dict[str, Tensor]] = []
    for step in range(plan.sequence + 1):
        states[step] = task.robot_state
        age = step - given
        arrived = task.is_reached(goal)
        still = plan.at_rest(states[step]) & (age > plan.starting)
        given_up = age >= plan.longest
        ended = arrived | still | (age >= turning) | given_up
        rows = ended.nonzero().squeeze(-1)
        if len(rows):
            teaches = rows[(arrived | still | (given_up & plan.restless))[rows]]
            taken = given[teaches].unsqueeze(-1) + _within(step - given[teaches], draw)
            samples.append(
                {
                    "robot_state": states[taken, teaches.unsqueeze(-1)].flatten(0, 1),
                    "goal": goal[teaches].repeat_interleave(STATES_PER_RUN, 0),
                    "arrival": torch.where(arrived[teaches].unsqueeze(-1), step - taken, -1).flatten(),
                }
            )
            goal[rows], given[rows] = plan.goals(len(rows), draw), step
            turning[rows] = _turning(plan, len(rows), draw)
        # A goal's tensor belongs to the planner's memory from here on.
        task.step(goal.clone())
    whole = {name: torch.cat([sample[name] for sample in samples]) for name in samples[0]}
    whole["run"] = torch.arange(len(whole["goal"])) // STATES_PER_RUN + torch.randint(2**40, (1,), generator=draw)
    return whole


def _turning(plan: RunPlan, count: int, draw: torch.Generator) -> Tensor:
    """Age at which each run is redirected, (count,); the longest age for those that are not."""
    chance, when = torch.rand(2, count, generator=draw)
    return torch.where(chance < plan.redirected, 1 + (when * plan.redirected_within).long(), plan.longest)


def _within(length: Tensor, draw: torch.Generator) -> Tensor:
    """`STATES_PER_RUN` steps of each run of ``length`` (M,), its ends included and the first its start: (M, 5)."""
    share = torch.rand(len(length), STATES_PER_RUN, generator=draw)
    share[:, 0] = 0.0
    return (share * (length + 1).unsqueeze(-1)).long()


def draw_goals(scene: TrapperScene, count: int, draw: torch.Generator) -> Tensor:
    """Goals ``(count, 3)`` [m, world]: on the table and above it, near the arm, all over, and beyond the rails."""
    kind, height = torch.rand(2, count, generator=draw)
    flat = 2.0 * torch.rand(count, 2, generator=draw) - 1.0
    # The arm stands behind the middle of a wall and reaches about as far as the middle of the table.
    near = scene.half_side * torch.stack([flat[:, 0], 0.6 * flat[:, 1] - 0.4], -1)
    place = torch.where((kind < 0.85).unsqueeze(-1), near, flat * scene.half_side)
    place = torch.where((kind > 0.95).unsqueeze(-1), flat * 3.0, place)
    low = scene.ball_radius + 0.005 * (2.0 * torch.rand(count, generator=draw) - 1.0)
    high = scene.ball_radius + 0.015 + 0.25 * torch.rand(count, generator=draw)
    sunk = -0.1 * torch.rand(count, generator=draw)
    z = torch.where(height < 0.7, low, torch.where(height < 0.97, high, sunk))
    return torch.cat([place, z.unsqueeze(-1)], dim=-1)
