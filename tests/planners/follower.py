"""An arm that does exactly what a planner says: the smallest world for a static planner."""

import math

import torch
from tensordict import TensorDict

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import IKPlanner
from torchdyn_plan.tasks.trapper.approach import BoxApproach
from torchdyn_plan.tasks.trapper.task import ik_planner

SCENE = TrapperScene()
APPROACH = BoxApproach.of(SCENE)
BASE = torch.tensor(APPROACH.base_pos)
DOUBLE = IKPlanner(Arm.ur5(tool_length=SCENE.tool_length, dtype=torch.float64), approach=APPROACH)
SINGLE = ik_planner(SCENE)
MIDDLE = torch.tensor([0.1, -0.2, 0.0])
"""A goal on the table, well within reach."""


def home(*batch, dtype=torch.float32, spread=0.0, seed=0):
    noise = torch.randn(*batch, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (torch.tensor(SCENE.home, dtype=torch.float64) + spread * noise).to(dtype)


def goals(count, height=0.0, seed=0, margin=0.0):
    """Goals within the planner's reach, by ``margin`` [m], (count, 3)."""
    random = torch.Generator().manual_seed(seed)
    place = (torch.rand(20 * count, 2, generator=random) * 2 - 1) * APPROACH.half_extent
    radius = (place - BASE[:2]).norm(dim=-1)
    place = place[(radius >= APPROACH.min_radius) & (radius <= APPROACH.max_radius - margin)][:count]
    return torch.cat([place, torch.full((count, 1), height)], dim=-1)


def observe(joint_pos, goal, step=0):
    batch = joint_pos.shape[:-1]
    entries = {"joint_pos": joint_pos, "goal": goal.expand(*batch, 3), "step_count": torch.full(batch, step)}
    return TensorDict(entries, batch_size=batch)


def after(td, planner, steps=1, goal=None):
    """The arm as a perfect follower: joint angles (steps, *B, 6) under ``planner``, from the tensordict ``td``."""
    path = []
    for _ in range(steps):
        td = planner(td)
        joint_pos = td["joint_pos"] + td["action"] * math.pi * SCENE.control_step
        path.append(joint_pos)
        entries = {"joint_pos": joint_pos, "step_count": td["step_count"] + 1, "plan": td["plan"]}
        td = TensorDict({**entries, "goal": td["goal"] if goal is None else goal}, td.batch_size)
    return torch.stack(path), td


def tool(joint_pos):
    return DOUBLE.arm(joint_pos.double())[..., :3, 3] + BASE
