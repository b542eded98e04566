"""Descents by damped least squares within the joints' limits, many side by side: the loop inside `solve_ik`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.dls import dls_step_within
from torchdyn_plan.kinematics.targets import constraint_error, constraint_jacobian

BLOCK = 64
"""Rows of one product of matrices: a fixed number, so that a row's answer does not depend on its company."""


class Search(NamedTuple):
    """What is asked of the descents; ``M`` is the number of targets."""

    arm: Arm
    target: Tensor
    """``(M, 4, 4)``"""
    lower: Tensor
    """``(M, N)`` or ``(N,)``, limits of this search [rad; m]."""
    upper: Tensor
    """As ``lower``."""
    constraint: str
    symmetry: int
    tolerances: tuple[float, float]
    """Of place [m] and of direction [rad]."""
    iterations: int
    max_step: Tensor
    """``(N,)`` [rad; m]"""
    posture: Tensor | None
    """``(M, N)``"""

    def bounds(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Limits of some rows, ``(A, N)``, or ``(N,)`` where all have the same."""
        if self.lower.ndim == 1:
            return self.lower, self.upper
        return self.lower[rows], self.upper[rows]

    def cost(self, residual: Tensor) -> Tensor:
        """Residuals ``(*B, 2)`` in units of their tolerances, the worse of both: at most 1 where solved."""
        place, direction = self.tolerances
        return torch.maximum(residual[..., 0] / place, residual[..., 1] / direction)


def descend(search: Search, tries: Tensor, rows: Tensor, *, all_tries: bool = False) -> tuple[Tensor, Tensor]:
    """From ``tries`` (A, S, N) towards the targets of ``rows`` (A,): the best positions on the way of each.

    A try ends within the tolerances, and with it its row's other tries, unless ``all_tries`` go on to their own ends.

    Returns:
        Positions ``(A, S, N)`` and residuals ``(A, S, 2)``.
    """
    count, number, joints = tries.shape
    q = tries.reshape(-1, joints)
    best, cost = q.clone(), torch.full((len(q),), torch.inf, dtype=q.dtype, device=q.device)
    residual = cost.unsqueeze(-1).repeat(1, 2)
    here, owner = torch.arange(len(q), device=rows.device), rows.repeat_interleave(number)
    for iteration in range(search.iterations + 1):
        index = owner[here]
        wanted = search.target[index]
        pose, jacobian = evaluate(search.arm, q)
        error = constraint_error(pose, wanted, constraint=search.constraint, symmetry=search.symmetry)
        left = _lengths(error)
        now = search.cost(left)
        nearer = now < cost[here]
        better = here[nearer]
        best[better], residual[better], cost[better] = q[nearer], left[nearer], now[nearer]
        going = now > 1.0
        if number > 1 and not all_tries:
            ended = (cost <= 1.0).view(count, number).any(dim=1)
            going &= ~ended[here // number]
        if iteration == search.iterations or not bool(going.any()):
            break
        if not bool(going.all()):
            here, q, index, wanted = here[going], q[going], index[going], wanted[going]
            jacobian, error = jacobian[going], error[going]
        q = _stepped(search, q, constraint_jacobian(jacobian, wanted, constraint=search.constraint), error, index)
    return best.view(count, number, joints), residual.view(count, number, 2)


def residual_at(search: Search, q: Tensor, rows: Tensor) -> Tensor:
    """Distances ``(A, 2)`` of ``q`` (A, N) from the targets of ``rows`` (A,)."""
    pose, _ = evaluate(search.arm, q)
    target = search.target[rows]
    return _lengths(constraint_error(pose, target, constraint=search.constraint, symmetry=search.symmetry))


def _lengths(error: Tensor) -> Tensor:
    """Of place and of direction, ``(A, R)`` -> ``(A, 2)``."""
    return torch.stack([error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)], dim=-1)


def evaluate(arm: Arm, q: Tensor) -> tuple[Tensor, Tensor]:
    """Poses and Jacobians for ``(M, N)``, by products of always `BLOCK` rows."""
    padded = torch.nn.functional.pad(q, (0, 0, 0, -len(q) % BLOCK))
    parts = [arm.pose_and_jacobian(block) for block in padded.split(BLOCK)]
    pose, jacobian = (torch.cat(part)[: len(q)] for part in zip(*parts, strict=True))
    return pose, jacobian


def _stepped(search: Search, q: Tensor, jacobian: Tensor, error: Tensor, index: Tensor) -> Tensor:
    """One step of Levenberg and Marquardt (Sugihara 2011: λ² grows with the error), within limits of step and joint."""
    lower, upper = search.bounds(index)
    damping = (0.1 * (error * error).sum(dim=-1) + _least_damping(q.dtype)).sqrt()
    preferred = None if search.posture is None else 0.3 * (search.posture[index] - q)
    step = dls_step_within(jacobian, error, damping, q, lower, upper, preferred=preferred)
    worst = (step.abs() / search.max_step).amax(dim=-1, keepdim=True)
    return torch.clamp(q + step / worst.clamp_min(1.0), lower, upper)


def _least_damping(dtype: torch.dtype) -> float:
    """λ² at the target: what keeps the squares of singular values apart from rounding."""
    return 1e-8 if dtype == torch.float64 else 1e-5
