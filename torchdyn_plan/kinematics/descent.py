"""Batched damped least squares within joint limits: the inner loop of `solve_ik`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.dls import dls_step_within
from torchdyn_plan.kinematics.targets import constraint_error, constraint_jacobian

BLOCK = 64
"""Rows per matrix product: a fixed number, so that a row's result does not depend on the batch."""
STUCK = 0.05
"""A try ends when a step is predicted to remove less than this share of the error: limits or a singularity block it.

For a step that is shortened to ``max_step``, the threshold is reduced in proportion. The share has no unit, so it holds
for arms of any size.
"""


class Search(NamedTuple):
    """Targets and settings of a search; ``M`` is the number of targets."""

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
    """Of position [m] and orientation [rad]."""
    iterations: int
    max_step: Tensor
    """``(N,)`` [rad; m]"""
    posture: Tensor | None = None
    """``(M, N)``"""
    weights: Tensor | None = None
    """``(M, R, R)``, multiply the error and the Jacobian's rows."""
    ease: Tensor | None = None
    """``(N,)``; weights of the joints: a redundant arm moves a joint in proportion to the square of its weight."""

    def bounds(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Limits of some rows, ``(A, N)``, or ``(N,)`` if all have the same."""
        if self.lower.ndim == 1:
            return self.lower, self.upper
        return self.lower[rows], self.upper[rows]

    def cost(self, residual: Tensor) -> Tensor:
        """The larger of the residuals ``(*B, 2)`` in units of their tolerances: at most 1 if solved."""
        place, direction = self.tolerances
        return torch.maximum(residual[..., 0] / place, residual[..., 1] / direction)


def descend(search: Search, tries: Tensor, rows: Tensor, *, all_tries: bool = False) -> tuple[Tensor, Tensor]:
    """Search from ``tries`` (A, S, N) for the targets of ``rows`` (A,): the best positions found by each try.

    A try ends within the tolerances, and its row's other tries end with it, unless ``all_tries`` is true.

    Returns:
        Positions ``(A, S, N)`` and residuals ``(A, S, 2)``.
    """
    count, number, joints = tries.shape
    q = tries.reshape(-1, joints)
    best, cost = q.clone(), torch.full((len(q),), torch.inf, dtype=q.dtype, device=q.device)
    residual = cost.unsqueeze(-1).repeat(1, 2)
    here, owner = torch.arange(len(q), device=rows.device), rows.repeat_interleave(number)
    moving = torch.ones(len(q), dtype=torch.bool, device=rows.device)
    for iteration in range(search.iterations + 1):
        index = owner[here]
        pose, jacobian = evaluate(search.arm, q)
        error = error_at(search, pose, index)
        left = lengths(error)
        now = search.cost(left)
        nearer = (now < cost[here]).nonzero().squeeze(-1)
        better = here[nearer]
        best[better], residual[better], cost[better] = q[nearer], left[nearer], now[nearer]
        going = (now > 1.0) & moving
        if number > 1 and not all_tries:
            ended = (cost <= 1.0).view(count, number).any(dim=1)
            going &= ~ended[here // number]
        if iteration == search.iterations or not bool(going.any()):
            break
        kept = going.nonzero().squeeze(-1)
        if len(kept) < len(here):
            here, q, index, jacobian, error = (value[kept] for value in (here, q, index, jacobian, error))
        q, moving = stepped(search, q, rows_at(search, jacobian, index), error, index)
    return best.view(count, number, joints), residual.view(count, number, 2)


def error_at(search: Search, pose: Tensor, rows: Tensor) -> Tensor:
    """Error from ``pose`` (A, 4, 4) to the targets of ``rows`` (A,): ``(A, R)`` [m; rad]."""
    target = search.target[rows]
    error = constraint_error(pose, target, constraint=search.constraint, symmetry=search.symmetry)
    return error if search.weights is None else (search.weights[rows] @ error.unsqueeze(-1)).squeeze(-1)


def rows_at(search: Search, jacobian: Tensor, rows: Tensor) -> Tensor:
    """The Jacobian's rows ``(A, R, N)`` for `error_at`, from the full Jacobians ``(A, 6, N)``."""
    # Only the rows of the constraint "axis" depend on the target.
    target = search.target[rows] if search.constraint == "axis" else search.target
    found = constraint_jacobian(jacobian, target, constraint=search.constraint)
    return found if search.weights is None else search.weights[rows] @ found


def residual_at(search: Search, q: Tensor, rows: Tensor) -> Tensor:
    """Distances ``(A, 2)`` of ``q`` (A, N) from the targets of ``rows`` (A,)."""
    return lengths(error_at(search, evaluate(search.arm, q)[0], rows))


def lengths(error: Tensor) -> Tensor:
    """Norms of the position and orientation errors, ``(A, R)`` -> ``(A, 2)``."""
    return torch.stack([error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)], dim=-1)


def evaluate(arm: Arm, q: Tensor) -> tuple[Tensor, Tensor]:
    """Poses and Jacobians for ``(M, N)``, in blocks of `BLOCK` rows."""
    padded = torch.nn.functional.pad(q, (0, 0, 0, -len(q) % BLOCK))
    parts = [arm.pose_and_jacobian(block) for block in padded.split(BLOCK)]
    pose, jacobian = (torch.cat(part)[: len(q)] for part in zip(*parts, strict=True))
    return pose, jacobian


def stepped(search: Search, q: Tensor, jacobian: Tensor, error: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """One Levenberg-Marquardt step (Sugihara 2011: λ² grows with the error), within step and joint limits.

    Returns:
        The new joint positions, ``(A, N)``, and whether it is worth continuing from there, ``(A,)``; see `STUCK`.
    """
    lower, upper = search.bounds(index)
    square = (error * error).sum(dim=-1)
    damping = (0.1 * square + _least_damping(q.dtype)).sqrt()
    preferred = None if search.posture is None else 0.3 * (search.posture[index] - q)
    eased = jacobian
    if search.ease is not None:
        eased = jacobian * search.ease
        preferred = None if preferred is None else preferred / search.ease
    step = dls_step_within(eased, error, damping, q, lower, upper, preferred=preferred)
    if search.ease is not None:
        step = step * search.ease
    worst = (step.abs() / search.max_step).amax(dim=-1, keepdim=True).clamp_min(1.0)
    after = torch.clamp(q + step / worst, lower, upper)
    # First-order reduction of the error by the step, times the error.
    taken = ((jacobian @ (after - q).unsqueeze(-1)).squeeze(-1) * error).sum(dim=-1)
    return after, taken * worst.squeeze(-1) > STUCK * square


def _least_damping(dtype: torch.dtype) -> float:
    """λ² at the target: keeps the squared singular values above rounding."""
    return 1e-8 if dtype == torch.float64 else 1e-5
