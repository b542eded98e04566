"""How balls are thrown: where from, and how fast, so that they fly through a place before the arm."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdyn_plan.envs.catch.scene import GRAVITY, CatchScene
from torchdyn_plan.envs.episodes import draw_uniform
from torchdyn_plan.kinematics.flight import fly

CORRECTIONS = 8
"""Times that a throw is corrected by where it misses its aim."""
FEWEST = 20
"""No flight to its aim takes fewer control steps."""


def draw_throws(
    scene: CatchScene, episodes: Tensor, *, flight: float | Tensor, drag: float | Tensor, split: str, seed: int
) -> tuple[Tensor, Tensor]:
    """Where the balls of ``episodes`` (M,) start, and how fast: ``(M, 3)`` each [m, m/s, world], float64.

    All of it is uniform: distance, direction and height of the start, the place that is aimed at, and the time of
    flight to there, ``flight`` [s] in the mean. ``drag`` is the ball's [1/m]: who throws knows it. Both are numbers, or
    one for each ball, flights ``(M,)`` and drags ``(M, 1)``.
    """
    share = 0.5 + 0.5 * draw_uniform(episodes, 7, split=split, seed=seed)
    distance = scene.throw_from + share[:, 0] * (scene.throw_to - scene.throw_from)
    angle = math.radians(scene.throw_angle) * (2.0 * share[:, 1] - 1.0)
    height = scene.throw_low + share[:, 2] * (scene.throw_high - scene.throw_low)
    start = torch.stack([distance * angle.cos(), distance * angle.sin(), height], dim=-1)
    low, high = share.new_tensor(scene.aim_low), share.new_tensor(scene.aim_high)
    aim = low + share[:, 3:6] * (high - low)
    time = flight + scene.flight_spread * (2.0 * share[:, 6] - 1.0)
    steps = (time / scene.control_step).round().long().clamp_min(FEWEST)
    return start, velocity_through(start, aim, steps, step=scene.control_step, drag=drag)


def velocity_through(start: Tensor, aim: Tensor, steps: Tensor, *, step: float, drag: float | Tensor) -> Tensor:
    """Velocity (M, 3) [m/s] by which a ball from ``start`` (M, 3) is at ``aim`` (M, 3) [m] after ``steps`` (M,).

    It is that of the parabola, corrected a few times by what the ball misses. ``step`` is the time of one [s].
    """
    time = (step * steps).unsqueeze(-1)
    velocity = (aim - start) / time - 0.5 * time * start.new_tensor(GRAVITY)
    # Without drag the parabola is exact.
    for _ in range(CORRECTIONS if isinstance(drag, Tensor) or drag else 0):
        path, _ = fly(start, velocity, step=step, count=int(steps.max()), gravity=GRAVITY, drag=drag)
        met = path.gather(-2, (steps - 1).view(-1, 1, 1).expand(-1, 1, 3)).squeeze(-2)
        velocity = velocity + (aim - met) / time
    return velocity
