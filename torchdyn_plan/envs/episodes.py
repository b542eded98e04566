"""How an episode starts: a pure function of its split, seed and index."""

import numpy as np
import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice
from torchdyn_plan.envs.scene import TrapperScene

SPLITS = {"test": 0, "dev": 1, "train": 2}
"""Tuning sees ``dev`` only, networks learn from ``train``, and results are reported on ``test``."""

SLOWEST = 0.5
"""Least speed at the start, as a share of the episode's velocity."""


def draw_starts(
    scene: TrapperScene, indices: Tensor, *, velocity: float, split: str, seed: int
) -> tuple[Tensor, Tensor]:
    """Ball position and velocity, ``(M, 2)`` float64 each [m, m/s], of the episodes ``indices`` (M,).

    The place is uniform over the table. The components of the velocity v are uniform within ±v (the paper's "randomly
    selecting the x and y components"), drawn anew until the ball is no slower than `SLOWEST` of v.
    """
    check_choice("split", split, SPLITS)
    draws = np.stack([_draw(SPLITS[split], seed, int(index)) for index in indices])
    room = scene.half_side - scene.ball_radius - 0.005
    return torch.from_numpy(draws[:, 0] * room), torch.from_numpy(draws[:, 1] * velocity)


def _draw(split: int, seed: int, index: int) -> np.ndarray:
    """Place and velocity of one episode, ``(2, 2)`` within ±1."""
    random = np.random.default_rng((split, seed, index))
    place, velocity = random.uniform(-1.0, 1.0, (2, 2))
    while np.hypot(*velocity) < SLOWEST:
        velocity = random.uniform(-1.0, 1.0, 2)
    return np.stack([place, velocity])
