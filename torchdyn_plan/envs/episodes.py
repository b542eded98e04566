"""How an episode starts: a pure function of its split, seed and index."""

import numpy as np
import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice
from torchdyn_plan.envs.scene import TrapperScene

SPLITS = {"test": 0, "dev": 1, "train": 2}
"""Tuning sees ``dev`` only, networks learn from ``train``, and results are reported on ``test``."""


def draw_starts(
    scene: TrapperScene, indices: Tensor, *, velocity: float, split: str, seed: int
) -> tuple[Tensor, Tensor]:
    """Ball position and velocity, ``(M, 2)`` float64 each [m, m/s], of the episodes ``indices`` (M,).

    The place is uniform over the table. The components of the velocity are uniform within ±``velocity`` ("randomly
    selecting the x and y components", paper, Section IV).
    """
    check_choice("split", split, SPLITS)
    draws = np.stack([np.random.default_rng((SPLITS[split], seed, int(i))).uniform(-1.0, 1.0, 4) for i in indices])
    room = scene.half_side - scene.ball_radius - 0.005
    return torch.from_numpy(draws[:, :2] * room), torch.from_numpy(draws[:, 2:] * velocity)
