"""Gradients of inverse kinematics by the implicit function theorem, not through the solver's steps."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.dls import dls_step
from torchdyn_plan.kinematics.targets import constraint_error, constraint_jacobian


def refine(
    arm: Arm, target: Tensor, solution: Tensor, solved: Tensor, *, constraint: str = "pose", symmetry: int = 1
) -> Tensor:
    """``solution`` with gradients with respect to ``target`` and the arm's own tensors.

    The error e(q, θ) of a solution is 0, so dq/dθ = -J⁺ ∂e/∂θ. That is the derivative of one Newton step taken at a
    constant q, and of two such steps up to the third order. Two steps are taken, which also bring the solution to its
    target within rounding. They work under autograd and every transform of ``torch.func``.

    - Redundant arms: the derivative is the smallest of all motions that follow the target.
    - Singularities: J⁺ is damped with λ² = √ε, so that along a lost direction the derivative tends to 0 instead of
      infinity; at a singular value σ it is too small by λ²/σ², 1 part in a thousand at σ = 0.004 in float64.
    - Joints at their limits do not move: their derivative is 0, and the others follow the target as well as they can.
    - Rows that were not solved keep their ``solution``, with derivative 0.

    Args:
        arm: whose joints they are.
        target: ``(*B, 4, 4)``.
        solution: ``(*B, N)``, taken as a constant.
        solved: ``(*B,)`` bool, rows that are within the tolerances.
        constraint: see `targets.constraint_error`.
        symmetry: see `targets.constraint_error`.

    Returns:
        ``(*B, N)``
    """
    constant = solution.detach()
    free = ((constant > arm.lower) & (constant < arm.upper)).to(constant.dtype)
    eye = torch.eye(4, dtype=target.dtype, device=target.device)
    target = torch.where(solved[..., None, None], target, eye)
    damping = torch.finfo(constant.dtype).eps ** 0.25
    q = constant
    for _ in range(2):
        pose, jacobian = arm.pose_and_jacobian(q)
        error = constraint_error(pose, target, constraint=constraint, symmetry=symmetry)
        rows = constraint_jacobian(jacobian, target, constraint=constraint) * free.unsqueeze(-2)
        q = q + dls_step(rows, error, damping)
    # The last bit of the way may not lead outside: neither a status nor an arm would forgive it.
    return torch.where(solved.unsqueeze(-1), torch.clamp(q, arm.lower, arm.upper), constant)
