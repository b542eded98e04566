"""The best that any base could do that knows the walk: the earliest moment of meeting, in closed form."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.envs.chase.env import ChaseWorld, Walks
from torchdyn_plan.tasks.task import Truth

BEYOND = 300
"""Control steps for which walks are known beyond an episode's end, for planners that are shown the truth."""


def reach(world: ChaseWorld, time: Tensor) -> Tensor:
    """How far from its start a base that was at rest can be after ``time`` (*B,) [s]: ``(*B,)`` [m].

    At full acceleration a t²/2, and from v/a on, at full speed, v t - v²/2a; any place within can be had.
    """
    speed, acceleration = world.base_speed, world.base_acceleration
    faster = time.clamp(max=speed / acceleration)
    return 0.5 * acceleration * faster.square() + speed * (time - faster)


def earliest_meeting(world: ChaseWorld, path: Tensor) -> Tensor:
    """First control step at which base and walker can have met, ``(E,)`` int64; -1 for none within an episode.

    Args:
        world: where the base is at rest in the origin.
        path: ``(E, T, 2)`` of walkers at steps 0 … T-1 [m].
    """
    steps = torch.arange(min(world.max_steps + 1, path.shape[1]))
    near = path[:, : len(steps)].norm(dim=-1) <= reach(world, world.control_step * steps) + world.radius
    # A step passes before anything counts.
    near[:, 0] = False
    return torch.where(near.any(-1), near.int().argmax(-1), -1)


def find_truth(settings: Any, *, episodes: int, seed: int, split: str, static: str = "", num_threads: int = 0) -> Truth:
    """Walks, and whether walkers can be met within an episode at all, for any static planner."""
    world = ChaseWorld()
    how: dict[str, Any] = {"speed": settings.speed, "turning": settings.turning, "split": split, "seed": seed}
    walks = Walks.draw(world, torch.arange(episodes), **how)
    steps = torch.arange(world.max_steps + 1 + BEYOND).expand(episodes, -1)
    path = walks.at(world.control_step * steps)
    return Truth(path, earliest_meeting(world, path) > 0)
