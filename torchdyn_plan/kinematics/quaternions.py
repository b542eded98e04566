"""Unit quaternions wxyz as tensors ``(*B, 4)``."""

from __future__ import annotations

import torch
from torch import Tensor

SHORTEST = 1e-6
"""A quaternion shorter than this defines no rotation."""


def quat_multiply(first: Tensor, second: Tensor) -> Tensor:
    """Rotation by ``second``, then by ``first``, quaternions ``(*B, 4)`` each: R₁R₂ in matrices."""
    first, second = torch.broadcast_tensors(first, second)
    w, v = first[..., :1], first[..., 1:]
    u, x = second[..., :1], second[..., 1:]
    scalar = w * u - (v * x).sum(-1, keepdim=True)
    return torch.cat([scalar, w * x + u * v + torch.linalg.cross(v, x)], dim=-1)


def quat_matrix(quat: Tensor) -> Tensor:
    """Rotation matrices ``(*B, 3, 3)`` of quaternions ``(*B, 4)`` of any length; the identity for zeros."""
    square = quat.square().sum(-1, keepdim=True)
    known = square > SHORTEST**2
    quat = torch.where(known, quat, quat.new_tensor([1.0, 0.0, 0.0, 0.0]))
    w, x, y, z = (quat / torch.where(known, square, 1.0).sqrt()).unbind(-1)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quat_between(start: Tensor, end: Tensor) -> Tensor:
    """Smallest rotation from directions ``start`` (*B, 3) to ``end`` (*B, 3), of any length: ``(*B, 4)``.

    Opposite directions give a half turn.
    """
    start, end = (torch.nn.functional.normalize(value, dim=-1) for value in torch.broadcast_tensors(start, end))
    scalar = 1.0 + (start * end).sum(-1, keepdim=True)
    # Opposite directions: about any perpendicular axis, here one chosen away from their largest component.
    smallest = torch.nn.functional.one_hot(start.abs().argmin(-1), 3).to(start.dtype)
    across = torch.linalg.cross(start, smallest)
    opposite = scalar < SHORTEST
    quat = torch.where(
        opposite, torch.nn.functional.pad(across, (1, 0)), torch.cat([scalar, torch.linalg.cross(start, end)], -1)
    )
    return torch.nn.functional.normalize(quat, dim=-1)


def is_turned(quat: Tensor) -> Tensor:
    """Whether quaternions ``(*B, 4)`` define an orientation, ``(*B,)`` bool: zeros do not."""
    return quat.square().sum(-1) > SHORTEST**2


def outer_axes(quat: Tensor) -> Tensor:
    """First and third column of the rotation matrices of quaternions ``(*B, 4)``: ``(*B, 6)``, zeros for zeros.

    Unlike a quaternion, whose sign is free, they are a continuous function of the rotation.
    """
    axes = quat_matrix(quat)[..., ::2].flatten(-2)
    return torch.where(is_turned(quat).unsqueeze(-1), axes, 0.0)


def matrix_quat(rotation: Tensor) -> Tensor:
    """Unit quaternions ``(*B, 4)`` of rotation matrices ``(*B, 3, 3)``, by the best conditioned of four formulas."""
    # Every row of this matrix is the quaternion, times four of its entries.
    r = rotation
    x, y, z = r.diagonal(dim1=-2, dim2=-1).unbind(-1)
    skew = [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    rows = torch.stack(
        [
            torch.stack([1.0 + x + y + z, *skew], dim=-1),
            torch.stack([skew[0], 1.0 + x - y - z, xy, xz], dim=-1),
            torch.stack([skew[1], xy, 1.0 - x + y - z, yz], dim=-1),
            torch.stack([skew[2], xz, yz, 1.0 - x - y + z], dim=-1),
        ],
        dim=-2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    best = rows.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    return torch.nn.functional.normalize(best, dim=-1)
