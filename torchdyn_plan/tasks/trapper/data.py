"""Training data of Trapper: paths of rolling balls, and arrivals of the arm; and how its networks are scored."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.envs.trapper.contact import is_pocketed
from torchdyn_plan.envs.trapper.scene import TrapperScene, trapper_scene
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.nets.eta import ETAConfig
from torchdyn_plan.nets.forecaster import ForecasterConfig
from torchdyn_plan.planners import StaticPlanner
from torchdyn_plan.planners.static.base import StaticPlannerModule
from torchdyn_plan.tasks.trapper.attempts import CONFIG
from torchdyn_plan.tasks.trapper.solvable import record_path
from torchdyn_plan.tasks.trapper.task import ball_lost
from torchdyn_plan.tasks.trapper.wait_and_drop import waiting_search
from torchdyn_plan.training.arrival_data import Arrivals
from torchdyn_plan.training.collect import SERIES
from torchdyn_plan.training.fitting import ExtraCoverage, Fitting
from torchdyn_plan.training.metrics import arrival_groups
from torchdyn_plan.training.path_data import lay_end_to_end
from torchdyn_plan.training.runs import RunPlan, record_runs
from torchdyn_plan.training.windows import Paths, WindowConfig, Windows, cut_windows

PATH_STEPS = 2000
"""Control steps of a recorded path: four times an episode (paper, Section IV)."""
FASTEST = 5.0
"""Balls start with velocities up to this [m/s]."""
AT_REST = 0.05
"""An arm whose joints are slower than this is at rest [rad/s]."""
FRICTIONS = (0.0, 5.0, 9.5)
"""Friction losses at which a spread's coverage is reported [N]; only the first is in the data."""
ROLLED, ROLLED_VELOCITY = 512, 3.0
"""Balls rolled at each of them, and their velocity [m/s]."""
PRESENTS = (40, 100, 200)
"""Control steps of each such ball at which it is forecast."""


def record_rolls(
    blocks: Sequence[Tensor], *, seed: int, num_threads: int = 0, scene: TrapperScene | str | None = None
) -> dict[str, Tensor]:
    """Balls rolled alone (the arm at home touches none), each at a different velocity up to `FASTEST`.

    Args:
        blocks: numbers of the episodes of the split ``train``, those that roll side by side in one tensor each.
        seed: which series of episodes.
        num_threads: of the simulation, 0 for all cores.
        scene: that the balls roll in, or its name; that with a real UR5's limits by default.

    Returns:
        What `lay_end_to_end` does.
    """
    scene, paths, speeds = trapper_scene(scene), [], []
    for episodes in blocks:
        place, direction = draw_starts(scene, episodes, velocity=1.0, split="train", seed=seed)
        draw = torch.Generator().manual_seed(seed * SERIES + int(episodes[0]))
        speed = FASTEST * torch.rand(len(episodes), generator=draw, dtype=torch.float64)
        velocity = direction * speed.unsqueeze(-1)
        paths.append(record_path(scene, place, velocity, steps=PATH_STEPS, num_threads=num_threads))
        speeds.append(speed)
    path = torch.cat(paths)
    return lay_end_to_end(path, torch.cat(speeds), is_pocketed(scene, path))


def record_arm_runs(
    planner: StaticPlanner,
    *,
    num_envs: int,
    sequences: int,
    seed: int,
    num_threads: int = 0,
    scene: TrapperScene | str | None = None,
) -> dict[str, Tensor]:
    """Runs of ``planner``: ``sequences`` times one sequence of each of ``num_envs`` arms, as `record_runs` returns."""
    scene = trapper_scene(scene)
    runner = TrapperArmRunner(planner, num_envs, scene=scene, num_threads=num_threads)
    comes_to_rest = not isinstance(planner, StaticPlannerModule) or planner.comes_to_rest
    return record_runs(runner, run_plan(scene, comes_to_rest=comes_to_rest), sequences=sequences, seed=seed)


def run_plan(scene: TrapperScene, *, comes_to_rest: bool = True) -> RunPlan:
    """How runs follow one another: goals of `draw_goals`; an arm whose joints are slower than `AT_REST` is at rest."""
    return RunPlan(
        goals=lambda count, draw: draw_goals(scene, count, draw),
        at_rest=lambda state: (state[:, 6:12].abs() < AT_REST).all(-1),
        sequence=400,
        longest=240,
        redirected_within=90,
        starting=15,
        comes_to_rest=comes_to_rest,
    )


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


def trapper_fitting(scene: TrapperScene | str | None = None) -> Fitting:
    """Sizes of the networks for the ball and the UR5 of ``scene``, or of that name, and how they are scored."""
    scene = trapper_scene(scene)

    def groups(held: Arrivals) -> dict[str, Tensor]:
        rest = held.robot_state[:, 6:12].abs().amax(-1) < AT_REST
        low = held.goal[:, 2] <= scene.goal_on_table_below
        return arrival_groups(held.arrival, rest) | {"on table": low, "above table": ~low}

    return Fitting(
        forecaster=ForecasterConfig(square_symmetry=True, half_extent=scene.half_side - scene.ball_radius),
        noisy_forecaster=ForecasterConfig(
            history=48, stride=2, tracked=True, square_symmetry=True, half_extent=scene.half_side - scene.ball_radius
        ),
        eta=ETAConfig(),
        capture=CONFIG,
        spread=True,
        near=waiting_search(scene).footprint,
        lost=ball_lost(scene),
        groups=groups,
        extra_coverage=lambda drawing: other_frictions(scene, drawing),
    )


def other_frictions(scene: TrapperScene, drawing: WindowConfig) -> ExtraCoverage:
    """Windows of balls of the split ``dev`` that roll at each of `FRICTIONS`."""
    windows = [({"friction": friction}, rolled_windows(scene, drawing, friction=friction)) for friction in FRICTIONS]
    return ExtraCoverage(f"Coverage at other frictions [N], {ROLLED_VELOCITY:g} m/s, dev episodes", windows)


def rolled_windows(scene: TrapperScene, drawing: WindowConfig, *, friction: float) -> Windows:
    """Windows of `ROLLED` dev episodes at ``friction`` [N], at each of `PRESENTS` that the ball is on the table at."""
    place, speed = draw_starts(scene, torch.arange(ROLLED), velocity=ROLLED_VELOCITY, split="dev", seed=0)
    steps = PRESENTS[-1] + drawing.horizon
    path = record_path(scene, place, speed, steps=steps, friction=friction, num_threads=1)
    shard = lay_end_to_end(path, torch.full((ROLLED,), ROLLED_VELOCITY), is_pocketed(scene, path))
    paths = Paths(shard["positions"], shard["start"], shard["length"], shard["pocketed"])
    parts = []
    for present in PRESENTS:
        episodes = (paths.length > present + 1).nonzero().squeeze(-1)
        now = torch.full_like(episodes, present)
        parts.append(cut_windows(paths, episodes, now, now.clamp(max=drawing.history), drawing))
    return Windows.joined(parts)
