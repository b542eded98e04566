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

    The place is uniform over the table, the direction is uniform, and the speed is ``velocity``.
    """
    check_choice("split", split, SPLITS)
    draws = np.stack([np.random.default_rng((SPLITS[split], seed, int(i))).random(3) for i in indices])
    room = scene.half_side - scene.ball_radius - 0.005
    place = torch.from_numpy((2.0 * draws[:, :2] - 1.0) * room)
    angle = torch.from_numpy(2.0 * np.pi * draws[:, 2])
    return place, velocity * torch.stack([angle.cos(), angle.sin()], dim=-1)
