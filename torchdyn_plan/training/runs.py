"""Runs of a static planner from goal to goal, as training data for arrival times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number

STATES_PER_RUN = 5
"""Intermediate states taken from each run (paper, Section III-B.3)."""
AS_NEAR = 0.015
"""A tool within this distance of its closest approach to the goal counts as being there [m]."""


class Runner(Protocol):
    """Robots that a static planner drives to goals; `torchdyn_plan.envs.ArmRunner` is one."""

    @property
    def robot_state(self) -> Tensor:
        """Input of an ETA network, ``(N, S)``."""
        ...

    @property
    def tool_pos(self) -> Tensor:
        """Tool positions, ``(N, 3)`` [m, world]."""
        ...

    def reset(self) -> None:
        """Put every robot at its start pose."""
        ...

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each robot is at ``goal`` (N, 3) [m, world], or at a pose (N, 7): ``(N,)`` bool."""
        ...

    def step(self, goal: Tensor) -> None:
        """One control step of every robot towards ``goal`` (N, 3) [m, world], or towards a pose (N, 7)."""
        ...


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """How runs follow one another; times are control steps."""

    goals: Callable[[int, torch.Generator], Tensor]
    """Draws the given number of goals, ``(count, 3)`` [m, world], or ``(count, 7)`` for poses like ``goal_pose``."""
    sequence: int
    """Length of a sequence of runs, which begins at the start pose."""
    longest: int
    """A run that has neither arrived nor come to rest by then is abandoned."""
    redirected_within: int
    """Latest time at which a run is redirected."""
    at_rest: Callable[[Tensor], Tensor] | None = None
    """Which robot states (N, S) are at rest, ``(N,)``: a robot that comes to rest elsewhere than at its goal never
    arrives. None if this cannot be read from the state."""
    starting: int = 0
    """Time by which a new goal has set a robot in motion."""
    redirected: float = 0.35
    """Share of runs that get another goal on their way; these give no samples."""
    states: int = STATES_PER_RUN
    """Samples taken from each run."""
    comes_to_rest: bool = True
    """Whether the robot comes to rest where it cannot get nearer to its goal: then an abandoned run gives no samples.
    Otherwise such a run counts as never arriving."""

    def __post_init__(self) -> None:
        for name in ("sequence", "longest", "redirected_within", "states"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_number("longest", self.longest, maximum=self.sequence)
        check_number("starting", self.starting, minimum=0, integer=True)
        check_number("redirected", self.redirected, minimum=0.0, maximum=1.0)


def record_runs(runner: Runner, plan: RunPlan, *, sequences: int, seed: int) -> dict[str, Tensor]:
    """``sequences`` sequences of runs of every robot, one after another; see `record_sequence`.

    ``seed`` determines every draw.
    """
    draw = torch.Generator().manual_seed(seed)
    parts = [record_sequence(runner, plan, draw) for _ in range(sequences)]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def record_sequence(runner: Runner, plan: RunPlan, draw: torch.Generator) -> dict[str, Tensor]:
    """A sequence of runs of every robot: a new goal when it arrives, comes to rest elsewhere, or is redirected.

    Args:
        runner: robots driven by the static planner.
        plan: goals, and how runs follow one another.
        draw: source of goals, redirections and sampled states.

    Returns:
        n samples, ``plan.states`` of each run, the first at its start: ``robot_state`` (n, S), ``goal`` (n, 3 or 7)
        [m, world], ``arrival`` (n,) control steps from the state to the goal or -1 for never, ``nearest`` (n,) control
        steps until the tool was nearest to the goal, ``run`` (n,) numbers.
    """
    runner.reset()
    count, size = runner.robot_state.shape
    states, tools = (torch.empty(plan.sequence + 1, count, width) for width in (size, runner.tool_pos.shape[-1]))
    goal, given = plan.goals(count, draw), torch.zeros(count, dtype=torch.int64)
    turning = _turning(plan, count, draw)
    samples: list[dict[str, Tensor]] = []
    for step in range(plan.sequence + 1):
        states[step] = runner.robot_state
        tools[step] = runner.tool_pos
        age = step - given
        arrived = runner.is_reached(goal)
        still = torch.zeros_like(arrived)
        if plan.at_rest is not None:
            still = plan.at_rest(states[step]) & (age > plan.starting)
        given_up = age >= plan.longest
        ended = arrived | still | (age >= turning) | given_up
        rows = ended.nonzero().squeeze(-1)
        if len(rows):
            teaches = rows[(arrived | still | (given_up & (not plan.comes_to_rest)))[rows]]
            taken = given[teaches].unsqueeze(-1) + _within(step - given[teaches], plan.states, draw)
            place = goal[teaches, : tools.shape[-1]]
            nearest = first_as_near(tools[: step + 1, teaches], place, given[teaches])
            nearest = torch.where(arrived[teaches], step, nearest)
            samples.append(
                {
                    "robot_state": states[taken, teaches.unsqueeze(-1)].flatten(0, 1),
                    "goal": goal[teaches].repeat_interleave(plan.states, 0),
                    "arrival": torch.where(arrived[teaches].unsqueeze(-1), step - taken, -1).flatten(),
                    "nearest": (nearest.unsqueeze(-1) - taken).clamp_min(0).flatten(),
                }
            )
            goal[rows], given[rows] = plan.goals(len(rows), draw), step
            turning[rows] = _turning(plan, len(rows), draw)
        # From here on the goal's tensor belongs to the planner's memory.
        runner.step(goal.clone())
    whole = {name: torch.cat([sample[name] for sample in samples]) for name in samples[0]}
    whole["run"] = torch.arange(len(whole["goal"])) // plan.states + torch.randint(2**40, (1,), generator=draw)
    return whole


def first_as_near(tool_pos: Tensor, goal: Tensor, given: Tensor | None = None) -> Tensor:
    """First step ``(M,)`` at which tools are within `AS_NEAR` of their closest approach to the goal.

    Args:
        tool_pos: ``(T, M, 3)`` at steps 0 … T-1 [m, world].
        goal: ``(M, 3)`` [m, world].
        given: ``(M,)`` first step considered; 0 for None.
    """
    away = (tool_pos - goal).norm(dim=-1)
    before = torch.zeros_like(away, dtype=torch.bool)
    if given is not None:
        before = torch.arange(len(away)).unsqueeze(-1) < given
    nearest = away.masked_fill(before, torch.inf).argmin(0)
    place = tool_pos[nearest, torch.arange(len(nearest))]
    return (((tool_pos - place).norm(dim=-1) <= AS_NEAR) & ~before).int().argmax(0)


def _turning(plan: RunPlan, count: int, draw: torch.Generator) -> Tensor:
    """Age at which each run is redirected, (count,); the longest age for those that are not."""
    chance, when = torch.rand(2, count, generator=draw)
    return torch.where(chance < plan.redirected, 1 + (when * plan.redirected_within).long(), plan.longest)


def _within(length: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """``count`` steps of each run of ``length`` (M,), its ends included and the first its start: ``(M, count)``."""
    share = torch.rand(len(length), count, generator=draw)
    share[:, 0] = 0.0
    return (share * (length + 1).unsqueeze(-1)).long()
