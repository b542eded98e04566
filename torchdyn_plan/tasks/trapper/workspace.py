# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""Which places of the table the arm can cover: a question to the scene, whatever a planner can do."""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.kinematics import UR5_LINKS, Arm, dls_step, limited_step, upright_error

RESTARTS = 64
"""Random configurations from which a pose is sought."""
ITERATIONS = 120
"""Damped least squares steps from each."""
TOLERANCE = 1e-3
"""Error of position [m] and orientation [rad] that counts as a solution."""
CLEARANCE = 0.001
"""Gap between box and cushion [m]."""
OFFSETS = (-0.99, 0.0, 0.99)
"""Places of the box along each axis from which it may cover a ball, as shares of the room that it leaves the ball."""
DOWN = 0.006
"""Height of the box mouth when it is down [m]."""


@torch.no_grad()
def is_reachable(scene: TrapperScene, place: Tensor, *, seed: int = 0) -> Tensor:
    """Whether a collision-free pose exists with the box down and square on the table, over a ball at ``place``.

    By the cushions the box stands as near to them as it can, and covers the ball off its middle if it still can.
    Poses are sought by inverse kinematics from `RESTARTS` random configurations and checked for contacts by MuJoCo.

    Args:
        scene: the arm, its box and the table.
        place: ``(M, 2)`` ball positions [m, world].
        seed: of the restarts.

    Returns:
        ``(M,)`` bool.
    """
    return _can_stand(scene, place.double(), place, seed)


@torch.no_grad()
def is_coverable(scene: TrapperScene, place: Tensor, *, seed: int = 0) -> Tensor:
    """Whether a pose as of `is_reachable` exists in which the box covers a ball at ``place``, off its middle or not.

    Beside the middle, `OFFSETS` of what the box leaves the ball to move are tried. Arguments and result as of
    `is_reachable`: every ball within reach can be covered.
    """
    found = is_reachable(scene, place, seed=seed)
    rest = (~found).nonzero().squeeze(-1)
    share = torch.tensor(OFFSETS, dtype=torch.float64)
    offset = torch.cartesian_prod(share, share) * (scene.box_half_width - scene.ball_radius)
    around = (place[rest].double().unsqueeze(1) + offset).flatten(0, 1)
    stands = _can_stand(scene, around, place[rest].repeat_interleave(len(offset), 0), seed)
    found[rest] = stands.view(len(rest), -1).any(-1)
    return found


def _can_stand(scene: TrapperScene, wanted: Tensor, place: Tensor, seed: int) -> Tensor:
    """Whether the box can stand as near to ``wanted`` (M, 2) as cushions let it, over a ball at ``place``: ``(M,)``."""
    limit = scene.half_side - scene.box_outer - CLEARANCE
    box = wanted.clamp(-limit, limit)
    room = scene.box_half_width - scene.ball_radius
    covered = ((box - place).abs() <= room).all(-1)
    joint_pos, solved = _solve(scene, box, seed)
    solved &= covered.unsqueeze(-1)
    found = torch.zeros_like(solved)
    found[solved] = ~_collides(scene, joint_pos[solved])
    return found.any(-1)


def _solve(scene: TrapperScene, box: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Configurations ``(M, R, 6)`` from random starts, and which of them stand where they should, ``(M, R)``."""
    arm = Arm.ur5(tool_length=scene.tool_length, dtype=torch.float64)
    base = torch.tensor(scene.base_pos, dtype=torch.float64)
    target = torch.cat([box, torch.full((len(box), 1), DOWN)], dim=-1).unsqueeze(1) - base
    draw = torch.Generator().manual_seed(seed)
    start = torch.rand(len(box), RESTARTS, 6, generator=draw, dtype=torch.float64) * 2.0 - 1.0
    joint_pos, stride = start * torch.pi, torch.full((6,), 0.3, dtype=torch.float64)
    for _ in range(ITERATIONS):
        pose, jacobian = arm.pose_and_jacobian(joint_pos)
        error = torch.cat([target - pose[..., :3, 3], _upright(pose)], dim=-1)
        joint_pos = joint_pos + limited_step(dls_step(jacobian, error, 0.02), stride, 1.0)
    pose = arm(joint_pos)
    missed = torch.cat([target - pose[..., :3, 3], _upright(pose)], dim=-1).abs().amax(-1)
    inside = ((joint_pos >= arm.lower) & (joint_pos <= arm.upper)).all(-1)
    downwards = pose[..., 2, 2] < 0
    return joint_pos, (missed < TOLERANCE) & inside & downwards


def _upright(pose: Tensor) -> Tensor:
    """Rotation vector to upright, as long as the angle also where the box stands on its head."""
    error = upright_error(pose[..., :3, :3])
    flipped = (pose[..., 2, 2] > 0).unsqueeze(-1)
    tilt = error[..., :2]
    size = tilt.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return torch.cat([torch.where(flipped, tilt / size, tilt), error[..., 2:]], dim=-1)


def _collides(scene: TrapperScene, joint_pos: Tensor) -> Tensor:
    """Whether arm or box touch anything in configurations (M, 6), the ball taken away: ``(M,)`` bool."""
    model = scene.compile()
    data = mujoco.MjData(model)
    first = int(model.joint(UR5_LINKS[0].joint).qposadr[0])
    ball = int(model.joint("ball").qposadr[0])
    result = torch.zeros(len(joint_pos), dtype=torch.bool)
    for row, angles in enumerate(joint_pos.numpy()):
        data.qpos[first : first + 6] = angles
        data.qpos[ball : ball + 3] = (0.0, 0.0, 5.0)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        result[row] = data.ncon > 0
    return result
