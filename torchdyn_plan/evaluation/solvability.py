"""Which episodes can be solved at all, by the paper's definition with measured arrival times (Section IV-B)."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.envs.reaching import ReachingTask
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.trapping import SLACK
from torchdyn_plan.files import write_whole
from torchdyn_plan.planners.ik import IKPlanner

GRID = 0.02
"""Spacing of the map [m]."""
LONGEST = 500
"""Control steps after which an arm that has not arrived never does."""
SHIPPED = Path(__file__).parent.parent / "weights"
NEVER = 2**20


class ArrivalMap:
    """Measured steps from the home pose, at rest, to covering a ball at each place of the table."""

    def __init__(self, scene: TrapperScene, steps: Tensor) -> None:
        """Wrap ``steps`` (n, n) int64, x by y over the places where a box can stand over a ball; `NEVER` for never."""
        self.scene, self.steps = scene, steps

    @staticmethod
    def limit(scene: TrapperScene) -> float:
        """Greatest |x| or |y| at which a ball can be covered [m]: nearer to a cushion the box would touch it."""
        approach = IKPlanner.default_approach(scene_free=True) if False else None
        del approach
        return scene.half_side - scene.box_outer - CLEARANCE + scene.box_half_width - scene.ball_radius + SLACK

    def at(self, place: Tensor) -> Tensor:
        """Steps to the nearest point of the map, ``(*B,)`` int64, for places ``(*B, 2 or 3)`` [m, world]."""
        limit, count = self.limit(self.scene), len(self.steps)
        index = ((place[..., :2] + limit) / (2 * limit) * (count - 1)).round().long()
        inside = ((index >= 0) & (index < count)).all(-1)
        index = index.clamp(0, count - 1)
        return torch.where(inside, self.steps[index[..., 0], index[..., 1]], NEVER)
