"""Which balls can be caught at all: by a UR10 that knows the flight, and whose joints go as fast as they may."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.envs.catch.scene import GRAVITY, CatchScene
from torchdyn_plan.envs.catch.throws import draw_throws
from torchdyn_plan.envs.catch.ur10 import UR10_LINKS, ur10_arm
from torchdyn_plan.kinematics.flight import fly
from torchdyn_plan.planners.static.approach import TurnedToGoal
from torchdyn_plan.planners.static.ik import IKPlanner
from torchdyn_plan.planners.turn import AgainstVelocity
from torchdyn_plan.tasks.task import Truth

EVERY = 2
"""Every so many control steps are looked at as moments of meeting."""
BEYOND = 150
"""Control steps for which flights are known beyond an episode's end, for planners that are shown the truth."""
BLOCK = 256
"""Balls that are looked at at once."""


def find_truth(settings: Any, *, episodes: int, seed: int, split: str, static: str = "", num_threads: int = 0) -> Truth:
    """Flights through the air alone, and whether each ball can be caught."""
    scene = CatchScene()
    how: dict[str, Any] = {"flight": settings.flight, "drag": settings.drag, "split": split, "seed": seed}
    place, velocity = draw_throws(scene, torch.arange(episodes), **how)
    count, law = scene.max_steps + BEYOND, {"gravity": GRAVITY, "drag": settings.drag}
    path, _ = fly(place, velocity, step=scene.control_step, count=count, **law)
    future = torch.cat([place.unsqueeze(1), path], dim=1).float()
    return Truth(future, flights_solvable(scene, future))


def flights_solvable(scene: CatchScene, future: Tensor) -> Tensor:
    """Whether balls that fly along ``future`` (E, T, 3) [m, world], from their start on, can be met: ``(E,)`` bool.

    A ball can if at some control step before it touches the floor it is where an arm that left its home at once can
    have its cup by then, against the ball's velocity, without stopping there: by the limits of its joints alone, on
    the straight way in joint space, from a flight that is known from the start.
    """
    base_pos = (0.0, 0.0, scene.base_height)
    approach = TurnedToGoal(base_pos=base_pos, symmetry=0)
    joints = IKPlanner(ur10_arm(tool_length=scene.tool_length), approach=approach, control_step=scene.control_step)
    speed = torch.tensor([link.speed for link in UR10_LINKS])
    acceleration = torch.tensor([link.acceleration for link in UR10_LINKS])
    home = torch.tensor(scene.home)
    steps = torch.arange(EVERY, scene.max_steps - scene.hold_steps, EVERY)
    found = []
    for path in future.split(BLOCK):
        turn = AgainstVelocity()(path[:, 1:], path[:, 0], path[:, :1].expand(-1, 2, 3))
        goal = torch.cat([path[:, steps], turn[:, steps - 1]], dim=-1)
        with torch.no_grad():
            there, reached = joints.goal_joints(home.expand(len(goal), 1, -1), goal)
        time = passing_time((there - home).abs(), speed, acceleration).amax(-1)
        in_the_air = path[:, steps, 2] > scene.ball_radius
        found.append((reached & in_the_air & (time <= scene.control_step * steps)).any(-1))
    return torch.cat(found)


def passing_time(way: Tensor, speed: Tensor, acceleration: Tensor) -> Tensor:
    """Least time from rest until joints have gone ``way`` (*B, N), by limits (N,), without a stop: ``(*B, N)`` [s]."""
    ramp = 0.5 * speed.square() / acceleration
    return torch.where(way <= ramp, (2.0 * way / acceleration).sqrt(), (way + ramp) / speed)
