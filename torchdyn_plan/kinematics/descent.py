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
STUCK = 0.05
"""A try ends with a step that should take away less than this share of the error: limits or axes in line bar the way.

Of a step that is shortened to ``max_step``, as much less is expected. The share has no unit, so arms of any size and in
any unit are searched alike.
"""


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
    posture: Tensor | None = None
    """``(M, N)``"""
    weights: Tensor | None = None
    """``(M, R, R)``, by which the error and the Jacobian's rows are multiplied."""
    ease: Tensor | None = None
    """``(N,)``; of the motions that would do, a joint takes a share that grows with the square of this."""

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
    """What is left to go from ``pose`` (A, 4, 4) to the targets of ``rows`` (A,): ``(A, R)`` [m; rad]."""
    target = search.target[rows]
    error = constraint_error(pose, target, constraint=search.constraint, symmetry=search.symmetry)
    return error if search.weights is None else (search.weights[rows] @ error.unsqueeze(-1)).squeeze(-1)


def rows_at(search: Search, jacobian: Tensor, rows: Tensor) -> Tensor:
    """The Jacobian's rows ``(A, R, N)`` that move along `error_at`, from the whole ones ``(A, 6, N)``."""
    # Only the rows of an axis depend on the target.
    target = search.target[rows] if search.constraint == "axis" else search.target
    found = constraint_jacobian(jacobian, target, constraint=search.constraint)
    return found if search.weights is None else search.weights[rows] @ found


def residual_at(search: Search, q: Tensor, rows: Tensor) -> Tensor:
    """Distances ``(A, 2)`` of ``q`` (A, N) from the targets of ``rows`` (A,)."""
    return lengths(error_at(search, evaluate(search.arm, q)[0], rows))


def lengths(error: Tensor) -> Tensor:
    """Of place and of direction, ``(A, R)`` -> ``(A, 2)``."""
    return torch.stack([error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)], dim=-1)


def evaluate(arm: Arm, q: Tensor) -> tuple[Tensor, Tensor]:
    """Poses and Jacobians for ``(M, N)``, by products of always `BLOCK` rows."""
    padded = torch.nn.functional.pad(q, (0, 0, 0, -len(q) % BLOCK))
    parts = [arm.pose_and_jacobian(block) for block in padded.split(BLOCK)]
    pose, jacobian = (torch.cat(part)[: len(q)] for part in zip(*parts, strict=True))
    return pose, jacobian


def stepped(search: Search, q: Tensor, jacobian: Tensor, error: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """One step of Levenberg and Marquardt (Sugihara 2011: λ² grows with the error), within limits of step and joint.

    Returns:
        Where the joints are then, ``(A, N)``, and whether it is worth going on from there, ``(A,)``; see `STUCK`.
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
    # What the step takes away of the error to first order, times the error.
    taken = ((jacobian @ (after - q).unsqueeze(-1)).squeeze(-1) * error).sum(dim=-1)
    return after, taken * worst.squeeze(-1) > STUCK * square


def _least_damping(dtype: torch.dtype) -> float:
    """λ² at the target: what keeps the squares of singular values apart from rounding."""
    return 1e-8 if dtype == torch.float64 else 1e-5
