"""Targets of an arm, a full pose or part of one, and the error of a pose."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdyn_plan.checks import check_same_device, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.precision import autocast_is_on, without_autocast

CONSTRAINTS = {"pose": 6, "axis": 5, "position": 3}
"""Dimension of each constraint: the full pose; position and direction of the tool's z axis; position."""


def as_pose(target: Tensor, arm: Arm, constraint: str, *, name: str = "target") -> Tensor:
    """``target`` as poses ``(*B, 4, 4)``, checked; ``(*B, 3)`` is allowed for the constraint "position"."""
    if constraint == "position" and isinstance(target, Tensor) and target.shape[-1:] == (3,):
        check_like(name, target, arm)
        place = target.unsqueeze(-1)
        eye = torch.eye(4, dtype=target.dtype, device=target.device).expand(*place.shape[:-2], 4, 4)
        return torch.cat([eye[..., :3], torch.cat([place, torch.ones_like(place[..., :1, :])], dim=-2)], dim=-1)
    check_trailing_shape(name, target, 4, 4)
    check_like(name, target, arm)
    return target


def as_rows(name: str, value: Tensor, arm: Arm, batch: torch.Size) -> Tensor:
    """Joint positions ``(*B, N)`` or ``(N,)`` as rows ``(M, N)``, checked."""
    check_trailing_shape(name, value, arm.num_joints)
    check_like(name, value, arm)
    if value.shape[:-1] not in (batch, torch.Size()):
        wanted = (*batch, arm.num_joints)
        raise InputError(f"{name} must have shape {wanted} or {wanted[-1:]}, got {tuple(value.shape)}")
    return value.detach().expand(*batch, arm.num_joints).reshape(-1, arm.num_joints)


def check_like(name: str, value: Tensor, arm: Arm) -> None:
    """Raise `InputError` unless ``value`` has the arm's device and precision."""
    check_same_device(name, value, arm.lower.device, "the arm")
    if value.dtype != arm.lower.dtype:
        raise InputError(f"{name} is {value.dtype}, but the arm is {arm.lower.dtype}: convert one of them")


def is_pose(target: Tensor, constraint: str) -> Tensor:
    """Whether targets ``(M, 4, 4)`` are finite, and their rotations orthonormal if the constraint uses them."""
    finite = target.isfinite().all(dim=-1).all(dim=-1)
    if constraint == "position":
        return finite
    rotation = target[:, :3, :3]
    off = rotation.mT @ rotation - torch.eye(3, dtype=target.dtype, device=target.device)
    right_handed = (torch.linalg.cross(rotation[..., 0], rotation[..., 1]) * rotation[..., 2]).sum(dim=-1) > 0.0
    return finite & (off.abs().amax(dim=(-2, -1)) < 1e-3) & right_handed


def constraint_error(pose: Tensor, target: Tensor, *, constraint: str = "pose", symmetry: int = 1) -> Tensor:
    """Error from ``pose`` to ``target``: position, then orientation.

    Args:
        pose: ``(*B, 4, 4)``, base frame.
        target: ``(*B, 4, 4)``, base frame.
        constraint: one of `CONSTRAINTS`.
        symmetry: order of the tool's rotational symmetry about its z axis: 4 for a square box.

    Returns:
        ``(*B, R)`` [m; rad]. For a pose the orientation error is a rotation vector in the base frame; for an axis, the
        rotation about the target's x and y axes that aligns the tool's z axis.
    """
    if autocast_is_on():
        return without_autocast(constraint_error, pose, target, constraint=constraint, symmetry=symmetry)
    way = target[..., :3, 3] - pose[..., :3, 3]
    if constraint == "position":
        return way
    turned, wanted = pose[..., :3, :3], target[..., :3, :3]
    if constraint == "axis":
        return torch.cat([way, _tilt(turned[..., 2], wanted)], dim=-1)
    if symmetry > 1:
        wanted = wanted @ nearest_turn(wanted.mT @ turned, symmetry)
    return torch.cat([way, rotation_vector(wanted @ turned.mT)], dim=-1)


def constraint_jacobian(jacobian: Tensor, target: Tensor, *, constraint: str = "pose") -> Tensor:
    """Rows of the Jacobian ``(*B, 6, N)`` for `constraint_error`: ``(*B, R, N)``."""
    if constraint == "pose":
        return jacobian
    if constraint == "position":
        return jacobian[..., :3, :]
    if autocast_is_on():
        return without_autocast(constraint_jacobian, jacobian, target, constraint=constraint)
    return torch.cat([jacobian[..., :3, :], target[..., :3, :2].mT @ jacobian[..., 3:, :]], dim=-2)


def rotation_vector(rotation: Tensor) -> Tensor:
    """Axis times angle in [0, π] of rotations ``(*B, 3, 3)``: ``(*B, 3)`` [rad].

    The antisymmetric part gives sin(θ)·axis, whose ratio to θ is smooth at 0. Within 0.06 rad of a half turn, where it
    vanishes, the axis comes from the symmetric part, where cos(θ) is -1. The gradient is exact near the identity.
    """
    sine = 0.5 * torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        dim=-1,
    )
    cosine = 0.5 * (rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True) - 1.0)
    vector = sine * _angle_over_sine(sine, cosine)
    return torch.where(cosine < -0.998, _near_half_turn(rotation, sine, cosine), vector)


def rotation_matrix(vector: Tensor) -> Tensor:
    """The rotation ``(*B, 3, 3)`` with rotation vector ``vector`` (*B, 3) [rad]: the inverse of `rotation_vector`."""
    angle = vector.norm(dim=-1).clamp_min(torch.finfo(vector.dtype).tiny)[..., None, None]
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    cross = torch.linalg.cross(vector.unsqueeze(-2).expand(*vector.shape, 3), eye.expand(*vector.shape, 3)).mT
    # sin(θ)/θ and (1 - cos(θ))/θ² = ½ (sin(½θ)/(½θ))².
    return eye + torch.sinc(angle / math.pi) * cross + 0.5 * torch.sinc(angle / (2.0 * math.pi)) ** 2 * cross @ cross


def _angle_over_sine(sine: Tensor, cosine: Tensor) -> Tensor:
    """θ / sin θ from ``sine`` (*B, 3), sin(θ)·axis, and ``cosine`` (*B, 1); 1 + sin²(θ)/6 where θ is small."""
    square = (sine * sine).sum(dim=-1, keepdim=True)
    small = (square < 1e-8) & (cosine > 0)
    norm = torch.where(square < 1e-30, 1e-30, square).sqrt()
    norm = torch.where(small, 1.0, norm)
    # tan(θ/2) = sin(θ) / (1 + cos(θ)); the rounding of atan2 depends on a row's position in the batch.
    return torch.where(small, 1.0 + square / 6.0, 2.0 * torch.atan(norm / (1.0 + cosine).clamp_min(1e-12)) / norm)


def _near_half_turn(rotation: Tensor, sine: Tensor, cosine: Tensor) -> Tensor:
    """Rotation vector from R + Rᵀ = 2 cos(θ) 1 + 2 (1 - cos(θ)) uuᵀ, whose largest column is best conditioned."""
    level = cosine.unsqueeze(-1) * torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    outer = 0.5 * (rotation + rotation.mT) - level
    # A mask and a sum, because indexing by a tensor cannot be traced through every transform.
    diagonal = outer.diagonal(dim1=-2, dim2=-1)
    chosen = (diagonal == diagonal.amax(dim=-1, keepdim=True)).to(outer.dtype)
    axis = (outer * chosen.unsqueeze(-2)).sum(dim=-1)
    axis = axis / (axis * axis).sum(dim=-1, keepdim=True).clamp_min(1e-30).sqrt()
    along = (axis * sine).sum(dim=-1, keepdim=True)
    return axis * (math.pi + torch.atan(along.abs() / cosine)) * torch.where(along < 0, -1.0, 1.0)


def _tilt(axis: Tensor, wanted: Tensor) -> Tensor:
    """Rotation ``(*B, 2)`` about x and y of ``wanted`` (*B, 3, 3) that brings ``axis`` (*B, 3) to its z axis."""
    x, y, z = (wanted.mT @ axis.unsqueeze(-1)).squeeze(-1).unbind(-1)
    # (x, y, z) × (0, 0, 1) = (y, -x, 0); exactly opposite axes may turn either way.
    sine = torch.stack([y, -x], dim=-1)
    opposite = ((sine * sine).sum(dim=-1) < 1e-12) & (z < 0)
    half_turn = sine.new_tensor([math.pi, 0.0])
    return torch.where(opposite.unsqueeze(-1), half_turn, sine * _angle_over_sine(sine, z.unsqueeze(-1)))


def nearest_turn(relative: Tensor, symmetry: int) -> Tensor:
    """The turn about z by a multiple of 2π/symmetry that is nearest to ``relative``, both ``(*B, 3, 3)``."""
    part = 2.0 * math.pi / symmetry
    sine, cosine = relative[..., 1, 0] - relative[..., 0, 1], relative[..., 0, 0] + relative[..., 1, 1]
    angle = part * torch.round(torch.atan2(sine, cosine) / part).detach()
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1.0]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
