"""Training data of the task Reach: paths of goals, and arrivals of the Fetch arm."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.envs.fetch import compile_fetch, settle
from torchdyn_plan.envs.fetch_reaching import FetchReachingTask
from torchdyn_plan.envs.goal_motion import CENTRE, HEIGHT, draw_goals, goal_places
from torchdyn_plan.training.runs import RunPlan, record_runs

PATH_STEPS = 100
"""Control steps of a recorded path: twice an episode."""
FASTEST = 0.055
"""Goals move by up to this in a control step [m]."""
HURRY, FAST = 0.8, 0.05
"""Share of the goals that move by at least this in a step [m]. Nothing tells the velocity at the first step, where a
forecaster learns to expect the usual one: to expect a fast goal costs nothing, as a slow one is caught later anyway."""
SHARES = {"straight": 0.6, "circle": 0.3, "random": 0.1}
"""Share of the paths that go each way."""
ARRIVAL = 0.008
"""Arrival means within this distance of the goal [m]: a little less than what counts as success."""
AT_REST = 0.001
"""A gripper slower than this along every axis is at rest [m per control step]."""


def record_goal_paths(episodes: Tensor, *, seed: int) -> dict[str, Tensor]:
    """Paths of the goals of ``episodes`` (M,) of the split ``train``, no gripper near; laid end to end.

    The velocity of each is uniform up to `FASTEST`, or from `FAST` on; `SHARES` says how many go each way.
    """
    tool_pos = settle(compile_fetch()).tool_pos
    draw = torch.Generator().manual_seed(seed * 1_000_003 + int(episodes[0]))
    kind, share, hurry = torch.rand(3, len(episodes), generator=draw, dtype=torch.float64)
    velocity = FASTEST * share
    velocity = torch.where(hurry < HURRY, FAST + (FASTEST - FAST) * share, velocity)
    bounds = torch.tensor([*SHARES.values()], dtype=torch.float64).cumsum(0)[:-1].contiguous()
    group = torch.bucketize(kind, bounds)
    paths = torch.empty(len(episodes), PATH_STEPS + 1, 3)
    for index, motion in enumerate(SHARES):
        rows = (group == index).nonzero().squeeze(-1)
        if len(rows):
            starts = draw_goals(episodes[rows], tool_pos, motion=motion, goal_range=0.1, split="train", seed=seed)
            for step in range(PATH_STEPS + 1):
                moves = torch.full((len(rows),), step)
                paths[rows, step] = goal_places(starts, moves, motion=motion, velocity=velocity[rows]).float()
    length = torch.full((len(episodes),), PATH_STEPS + 1)
    return {
        "positions": paths.flatten(0, 1), "start": length.cumsum(0) - length, "length": length,
        "pocketed": torch.zeros(len(episodes), dtype=torch.bool), "velocity": velocity.float(),
    }  # fmt: skip


def record_fetch_runs(
    planner: Callable[[TensorDictBase], TensorDictBase], num_envs: int, sequences: int, *, seed: int, num_threads: int
) -> dict[str, Tensor]:
    """Runs of ``planner``: ``sequences`` times one sequence of every arm, as `record_runs` returns them."""
    task = FetchReachingTask(planner, num_envs, threshold=ARRIVAL, num_threads=num_threads)
    draw = torch.Generator().manual_seed(seed)
    plan = RunPlan(
        goals=draw_places, at_rest=lambda state: (state[:, 5:8].abs() < AT_REST).all(-1),
        sequence=100, longest=60, redirected_within=20, starting=6,
    )  # fmt: skip
    parts = [record_runs(task, plan, draw) for _ in range(sequences)]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def draw_places(count: int, draw: torch.Generator) -> Tensor:
    """Goals ``(count, 3)`` [m, world]: in front of the arm, around the circles, and all over and out of reach."""
    kind, height = torch.rand(2, count, generator=draw)
    flat = 2.0 * torch.rand(count, 2, generator=draw) - 1.0
    place = torch.tensor([1.4, 0.75]) + flat * torch.tensor([0.32, 0.25])
    place = torch.where((kind > 0.65).unsqueeze(-1), torch.tensor(CENTRE) + 0.25 * flat, place)
    place = torch.where((kind > 0.85).unsqueeze(-1), torch.tensor([1.4, 0.75]) + flat * torch.tensor([1.0, 0.6]), place)
    z = torch.where(height < 0.7, HEIGHT, 0.42 + 0.8 * (height - 0.7))
    return torch.cat([place, z.unsqueeze(-1)], dim=-1)
