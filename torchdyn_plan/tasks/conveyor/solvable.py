"""Which parts can be taken at all: by a Panda that knows the belt and moves at its joint limits."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.envs.conveyor.env import draw_parts
from torchdyn_plan.envs.conveyor.panda import PANDA_LINKS, panda_arm
from torchdyn_plan.envs.conveyor.scene import ConveyorScene
from torchdyn_plan.kinematics.quaternions import quat_multiply
from torchdyn_plan.nets.analytic_arrival import AnalyticArrival
from torchdyn_plan.planners.static.approach import TurnedToGoal
from torchdyn_plan.planners.static.ik import IKPlanner
from torchdyn_plan.tasks.task import Truth

EVERY = 4
"""Stride in control steps between candidate meetings."""
BEYOND = 200
"""Control steps beyond an episode's end for which paths are computed, for planners that read the truth."""
BLOCK = 256
"""Parts computed at once."""


def find_truth(settings: Any, *, episodes: int, seed: int, split: str, static: str = "", num_threads: int = 0) -> Truth:
    """Paths of the first parts, and whether every part of an episode can be taken by itself."""
    scene = ConveyorScene()
    how: dict[str, Any] = {"parts": settings.parts, "speed": settings.speed, "split": split, "seed": seed}
    place, yaw = draw_parts(scene, torch.arange(episodes), **how)
    solvable = parts_solvable(scene, place, yaw, speed=settings.speed)
    steps = torch.arange(scene.max_steps + 1 + BEYOND)
    start = torch.nn.functional.pad(place[:, :1].float(), (0, 1), value=scene.top)
    way = torch.nn.functional.pad((settings.speed * scene.control_step * steps).unsqueeze(-1), (1, 1))
    return Truth(start + way, solvable.all(-1))


def parts_solvable(scene: ConveyorScene, place: Tensor, yaw: Tensor, *, speed: float) -> Tensor:
    """Whether parts that start at ``place`` (E, K, 2) [m] with ``yaw`` (E, K) can be met: ``(E, K)`` bool.

    A part can be met if, at some control step early enough for the cups to attach before the part is gone and the
    episode is over, an arm that leaves its home pose at once can have its cups at the part, aligned with it, by the
    limits of its joints and on a straight line in joint space. Matching the belt's velocity is not required, so this is
    an upper bound.
    """
    arm = panda_arm(tool_length=scene.tool_length)
    limits: dict[str, Any] = {
        "speed": [link.speed for link in PANDA_LINKS],
        "acceleration": [link.acceleration for link in PANDA_LINKS],
    }
    joints = IKPlanner(arm, approach=TurnedToGoal(symmetry=2), control_step=scene.control_step)
    eta = AnalyticArrival(joints, **limits, control_step=scene.control_step)
    home = torch.tensor(scene.home).repeat(2)
    home[len(PANDA_LINKS) :] = 0.0
    steps = torch.arange(EVERY, scene.max_steps - scene.hold_steps, EVERY)
    found = []
    for where, turn in zip(place.reshape(-1, 2).split(BLOCK), yaw.reshape(-1).split(BLOCK), strict=True):
        y = where[:, 1:] + speed * scene.control_step * steps
        zero = torch.zeros_like(turn)
        quat = torch.stack([(turn / 2).cos(), zero, zero, (turn / 2).sin()], dim=-1)
        quat = quat_multiply(quat, quat.new_tensor([0.0, 1.0, 0.0, 0.0]).expand_as(quat))
        goal = torch.cat(
            [
                where[:, :1, None].expand(*y.shape, 1),
                y.unsqueeze(-1),
                torch.full_like(y, scene.top).unsqueeze(-1),
                quat.unsqueeze(1).expand(*y.shape, 4),
            ],
            dim=-1,
        ).float()
        with torch.no_grad():
            arrival = eta.arrival(home.expand(len(goal), 1, -1), goal)
        in_time = (arrival.steps <= steps) & ~arrival.never
        before_gone = y + scene.hold_steps * speed * scene.control_step <= scene.gone_y
        found.append((in_time & before_gone).any(-1))
    return torch.cat(found).view(yaw.shape)
