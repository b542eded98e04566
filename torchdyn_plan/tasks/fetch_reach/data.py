"""Training data of Dynamic FetchReach: paths of goals, arrivals of the Fetch arm; and how networks are scored."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdyn_plan.envs.fetch_reach.arm_runner import FetchArmRunner
from torchdyn_plan.envs.fetch_reach.env import DHER_RANGE, MAX_STEPS, STATE_SIZE
from torchdyn_plan.envs.fetch_reach.goal_motion import CENTRE, HEIGHT, draw_goals, goal_places
from torchdyn_plan.envs.fetch_reach.simulation import compile_fetch, settle
from torchdyn_plan.nets.eta import ETAConfig
from torchdyn_plan.nets.forecaster import ForecasterConfig
from torchdyn_plan.planners import StaticPlanner
from torchdyn_plan.training.arrival_data import Arrivals
from torchdyn_plan.training.collect import SERIES
from torchdyn_plan.training.fitting import Fitting
from torchdyn_plan.training.metrics import arrival_groups
from torchdyn_plan.training.path_data import lay_end_to_end
from torchdyn_plan.training.runs import RunPlan, record_runs
from torchdyn_plan.training.windows import WindowConfig

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


def record_goal_paths(blocks: Sequence[Tensor], *, seed: int, num_threads: int = 0) -> dict[str, Tensor]:
    """Paths of goals, no gripper near.

    The velocity of each is uniform up to `FASTEST`, or from `FAST` on; `SHARES` says how many go each way.

    Args:
        blocks: numbers of the episodes of the split ``train``; all of them are drawn together.
        seed: which series of episodes.
        num_threads: of no use, as nothing is simulated.

    Returns:
        What `lay_end_to_end` does.
    """
    episodes = torch.cat([*blocks])
    tool_pos = settle(compile_fetch()).tool_pos
    draw = torch.Generator().manual_seed(seed * SERIES + int(episodes[0]))
    kind, share, hurry = torch.rand(3, len(episodes), generator=draw, dtype=torch.float64)
    velocity = FASTEST * share
    velocity = torch.where(hurry < HURRY, FAST + (FASTEST - FAST) * share, velocity)
    bounds = torch.tensor([*SHARES.values()], dtype=torch.float64).cumsum(0)[:-1].contiguous()
    group = torch.bucketize(kind, bounds)
    paths = torch.empty(len(episodes), PATH_STEPS + 1, 3)
    for index, motion in enumerate(SHARES):
        rows = (group == index).nonzero().squeeze(-1)
        if len(rows):
            starts = draw_goals(
                episodes[rows], tool_pos, motion=motion, goal_range=DHER_RANGE, split="train", seed=seed
            )
            for step in range(PATH_STEPS + 1):
                moves = torch.full((len(rows),), step)
                paths[rows, step] = goal_places(starts, moves, motion=motion, velocity=velocity[rows]).float()
    return lay_end_to_end(paths, velocity)


def record_fetch_runs(
    planner: StaticPlanner, *, num_envs: int, sequences: int, seed: int, num_threads: int = 0
) -> dict[str, Tensor]:
    """Runs of ``planner``: ``sequences`` times one sequence of each of ``num_envs`` arms, as `record_runs` returns."""
    runner = FetchArmRunner(planner, num_envs, threshold=ARRIVAL, num_threads=num_threads)
    plan = RunPlan(
        goals=draw_places,
        at_rest=lambda state: (state[:, 5:8].abs() < AT_REST).all(-1),
        sequence=100,
        longest=60,
        redirected_within=20,
        starting=6,
    )
    return record_runs(runner, plan, sequences=sequences, seed=seed)


def draw_places(count: int, draw: torch.Generator) -> Tensor:
    """Goals ``(count, 3)`` [m, world]: in front of the arm, around the circles, and all over and out of reach."""
    kind, height = torch.rand(2, count, generator=draw)
    flat = 2.0 * torch.rand(count, 2, generator=draw) - 1.0
    place = torch.tensor([1.4, 0.75]) + flat * torch.tensor([0.32, 0.25])
    place = torch.where((kind > 0.65).unsqueeze(-1), torch.tensor(CENTRE) + 0.25 * flat, place)
    place = torch.where((kind > 0.85).unsqueeze(-1), torch.tensor([1.4, 0.75]) + flat * torch.tensor([1.0, 0.6]), place)
    z = torch.where(height < 0.7, HEIGHT, 0.42 + 0.8 * (height - 0.7))
    return torch.cat([place, z.unsqueeze(-1)], dim=-1)


def fetch_reach_fitting() -> Fitting:
    """Networks for goals that are forecast from the first step on, and for the Fetch arm, with bins of one step."""

    def groups(held: Arrivals) -> dict[str, Tensor]:
        rest = held.robot_state[:, 5:8].abs().amax(-1) < AT_REST
        level = (held.goal[:, 2] - HEIGHT).abs() < LEVEL
        return arrival_groups(held.arrival, rest) | {"level": level, "elsewhere": ~level}

    return Fitting(
        forecaster=ForecasterConfig(
            history=8,
            horizon=50,
            channels=16,
            convolutions=2,
            hidden=128,
            rank=32,
            step_scale=0.05,
            change_scale=1e-4,
        ),
        eta=ETAConfig(robot_state_size=STATE_SIZE, tool_slice=(0, 3), bins=MAX_STEPS, bin_width=1, hidden=128),
        groups=groups,
        windows=WindowConfig(first_step=0, early_share=0.4, shortened_share=0.3),
        ahead=(5, 20, 50),
        fast=0.02,
    )


LEVEL = 1e-3
"""A goal within this of `HEIGHT` counts as level with the moving ones [m]."""
