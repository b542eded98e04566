"""Runs of a static planner from goal to goal, and what they teach about arrival times."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdyn_plan.envs.reaching import ReachingTask
from torchdyn_plan.envs.scene import TrapperScene

STATES_PER_RUN = 5
"""Intermediate states taken from each run (paper, Section III-B.3)."""
SEQUENCE_STEPS = 400
"""Control steps of a sequence of runs, which starts at home."""
LONGEST = 240
"""Control steps after which a run that has neither arrived nor come to rest is given up, and teaches nothing."""
REDIRECTED = 0.35
"""Share of runs that are given another goal on their way, and teach nothing themselves."""
REDIRECTED_WITHIN = 90
"""A run that is redirected is so within this many control steps."""
AT_REST = 0.05
"""Joint speeds below this are rest [rad/s]: an arm that comes to rest elsewhere never arrives."""
STARTING = 15
"""Control steps within which a new goal sets an arm in motion."""


def record_runs(task: ReachingTask, draw: torch.Generator) -> dict[str, Tensor]:
    """One sequence of runs of every arm: a new goal when it arrives, comes to rest elsewhere, or is redirected.

    Args:
        task: arms driven by the static planner.
        draw: source of goals, redirections and sampled states.

    Returns:
        n samples, `STATES_PER_RUN` of each run, the first at its start: ``robot_state`` (n, S), ``goal`` (n, 3)
        [m, world], ``arrival`` (n,) control steps from the state to the goal or -1 for never, ``run`` (n,) numbers.
    """
    task.reset()
    count = task.simulation.num_envs
    states = torch.empty(SEQUENCE_STEPS + 1, count, task.robot_state.shape[-1])
    goal, given = draw_goals(task.scene, count, draw), torch.zeros(count, dtype=torch.int64)
    turning = _turning(count, draw)
    samples: list[dict[str, Tensor]] = []
    for step in range(SEQUENCE_STEPS + 1):
        states[step] = task.robot_state
        age = step - given
        arrived = task.is_reached(goal)
        still = (states[step, :, 6:12].abs() < AT_REST).all(-1) & (age > STARTING)
        ended = arrived | still | (age >= turning) | (age >= LONGEST)
        rows = ended.nonzero().squeeze(-1)
        if len(rows):
            teaches = rows[(arrived | still)[rows]]
            taken = given[teaches].unsqueeze(-1) + _within(step - given[teaches], draw)
            samples.append(
                {
                    "robot_state": states[taken, teaches.unsqueeze(-1)].flatten(0, 1),
                    "goal": goal[teaches].repeat_interleave(STATES_PER_RUN, 0),
                    "arrival": torch.where(arrived[teaches].unsqueeze(-1), step - taken, -1).flatten(),
                }
            )
            goal[rows], given[rows] = draw_goals(task.scene, len(rows), draw), step
            turning[rows] = _turning(len(rows), draw)
        # A goal's tensor belongs to the planner's memory from here on.
        task.step(goal.clone())
    whole = {name: torch.cat([sample[name] for sample in samples]) for name in samples[0]}
    whole["run"] = torch.arange(len(whole["goal"])) // STATES_PER_RUN + torch.randint(2**40, (1,), generator=draw)
    return whole


def _turning(count: int, draw: torch.Generator) -> Tensor:
    """Age at which each run is redirected, (count,); `LONGEST` for those that are not."""
    chance, when = torch.rand(2, count, generator=draw)
    return torch.where(chance < REDIRECTED, 1 + (when * REDIRECTED_WITHIN).long(), LONGEST)


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
