"""Where balls start and how fast: a pure function of an episode's split, seed and index."""

from __future__ import annotations

from torch import Tensor

from torchdyn_plan.envs.episodes import draw_uniform
from torchdyn_plan.envs.trapper.scene import TrapperScene

CLEARANCE = 0.005
"""Balls start at least this far from the cushions [m]."""


def draw_starts(
    scene: TrapperScene, indices: Tensor, *, velocity: float, split: str, seed: int
) -> tuple[Tensor, Tensor]:
    """Ball position and velocity, ``(M, 2)`` float64 each [m, m/s], of the episodes ``indices`` (M,).

    The place is uniform over the table. The components of the velocity are uniform within ±``velocity`` ("randomly
    selecting the x and y components", paper, Section IV).
    """
    draws = draw_uniform(indices, 4, split=split, seed=seed)
    room = scene.half_side - scene.ball_radius - CLEARANCE
    return draws[:, :2] * room, draws[:, 2:] * velocity
