"""Training data of Conveyor: paths of parts on belts, arrivals of the Panda at poses; and how networks are scored."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdyn_plan.envs.arm_runner import EnvRunner
from torchdyn_plan.envs.conveyor.env import ConveyorEnv, draw_parts
from torchdyn_plan.nets.eta import ETAConfig
from torchdyn_plan.nets.forecaster import ForecasterConfig
from torchdyn_plan.planners import StaticPlanner
from torchdyn_plan.tasks.conveyor.task import HORIZON, REACH, ik, maneuver, scene, turn
from torchdyn_plan.training.arrival_data import Arrivals
from torchdyn_plan.training.collect import SERIES
from torchdyn_plan.training.fitting import Fitting
from torchdyn_plan.training.metrics import arrival_groups
from torchdyn_plan.training.optimise import Recipe
from torchdyn_plan.training.path_data import lay_end_to_end
from torchdyn_plan.training.runs import RunPlan, record_runs
from torchdyn_plan.training.windows import WindowConfig

PATH_STEPS = 600
"""Control steps of a recorded path."""
FASTEST = 1.0
"""Belts move by up to this [m/s]."""
CLEARING = 2.0
"""Belt speed while arrivals are recorded, at which parts are soon gone [m/s]."""
ABOVE, WITHIN = 0.7, 0.85
"""Share of the arm's goals that are above a part by the height at which the planner hovers; share of them that are
where meetings are allowed."""
HIGHEST, BEYOND = 0.25, 3.0
"""The other goals are up to this far above a part [m], and up to so many times as far along the belt."""
AT_REST = 0.05
"""An arm whose joints are slower than this is at rest [rad/s]."""


def record_belts(blocks: Sequence[Tensor], *, seed: int, num_threads: int = 0) -> dict[str, Tensor]:
    """Paths of parts that nobody takes, each on a belt at its own constant speed, uniform up to `FASTEST`.

    Args:
        blocks: numbers of the episodes of the split ``train``; all of them are drawn together.
        seed: which series of episodes.
        num_threads: of no use, as nothing is simulated.

    Returns:
        What `lay_end_to_end` does; the velocity is the belt's [m/s].
    """
    episodes = torch.cat([*blocks])
    draw = torch.Generator().manual_seed(seed * SERIES + int(episodes[0]))
    speed = FASTEST * torch.rand(len(episodes), generator=draw, dtype=torch.float64)
    place, _ = draw_parts(scene(), episodes, parts=1, speed=0.0, split="train", seed=seed)
    way = speed.unsqueeze(-1) * scene().control_step * torch.arange(PATH_STEPS + 1)
    x, y = place[:, 0, :1].expand(way.shape), place[:, 0, 1:] + way
    return lay_end_to_end(torch.stack([x, y, torch.full_like(y, scene().top)], dim=-1).float(), speed)


def record_arm_runs(
    planner: StaticPlanner, *, num_envs: int, sequences: int, seed: int, num_threads: int = 0
) -> dict[str, Tensor]:
    """Runs of ``planner``: ``sequences`` times one sequence of each of ``num_envs`` arms, as `record_runs` returns."""
    env = ConveyorEnv(num_envs, speed=CLEARING, scene=scene(), seed=seed, split="train", num_threads=num_threads)
    runner = EnvRunner(planner, env, at_goal=ik().is_at)
    return record_runs(runner, run_plan(), sequences=sequences, seed=seed)


def run_plan() -> RunPlan:
    """How runs follow one another: goals of `draw_poses`; an arm whose joints are slower than `AT_REST` is at rest."""
    return RunPlan(
        goals=draw_poses,
        at_rest=lambda state: (state[:, 7:14].abs() < AT_REST).all(-1),
        sequence=200,
        longest=80,
        states=8,
        comes_to_rest=False,
        redirected_within=30,
        starting=6,
    )


def draw_poses(count: int, draw: torch.Generator) -> Tensor:
    """Goals ``(count, 7)`` [m, wxyz, world]: above parts at any yaw, aligned with them, along the belt."""
    across, along, yaw, up, height, where = torch.rand(6, count, generator=draw)
    low, high = -REACH[0], REACH[1]
    y = low + along * (high - low)
    y = torch.where(where < WITHIN, y, BEYOND * y)
    x = scene().belt_x + scene().lane_half_width * (2.0 * across - 1.0)
    z = scene().top + torch.where(up < ABOVE, maneuver().hover, HIGHEST * height)
    half, zero = math.pi * (yaw - 0.5), torch.zeros_like(yaw)
    place = torch.stack([x, y, z], dim=-1)
    quat = torch.stack([half.cos(), zero, zero, half.sin()], dim=-1)
    return torch.cat([place, turn()(place.unsqueeze(1), place, quat).squeeze(1)], dim=-1)


def conveyor_fitting() -> Fitting:
    """Networks for parts that are forecast from the first step on, and for the arrivals of cups that are turned."""

    def groups(held: Arrivals) -> dict[str, Tensor]:
        return arrival_groups(held.arrival, held.robot_state[:, 7:14].abs().amax(-1) < AT_REST)

    return Fitting(
        forecaster=ForecasterConfig(
            history=8, horizon=HORIZON, channels=16, convolutions=2, hidden=128, rank=16, step_scale=0.02
        ),
        eta=ETAConfig(robot_state_size=17, tool_slice=(14, 17), bins=60, bin_width=2, hidden=128, turned=True),
        groups=groups,
        windows=WindowConfig(first_step=1, early_share=0.2, shortened_share=0.2),
        ahead=(25, 100, HORIZON),
        fast=0.01,
        recipes={
            "forecaster": Recipe(steps=4_000, batch=256, lr=2e-3, validations=4),
            "eta": Recipe(steps=8_000, batch=512, lr=2e-3, validations=4),
        },
    )
