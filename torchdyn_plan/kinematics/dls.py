"""Damped least squares, and the error of a tool that points straight down, square to the world's axes."""

import math

import torch
from torch import Tensor

from torchdyn_plan.precision import autocast_is_on, without_autocast

QUARTER_TURN = math.pi / 2


def dls_step(jacobian: Tensor, error: Tensor, damping: float | Tensor, *, preferred: Tensor | None = None) -> Tensor:
    """Joint step of damped least squares, Δq = Jᵀ(JJᵀ + λ²I)⁻¹e (Wampler 1986; Nakamura & Hanafusa 1986).

    Args:
        jacobian: ``(*B, R, N)``, rows [v; ω] or the constrained ones among them.
        error: ``(*B, R)``, the twist still to go [m; rad].
        damping: λ > 0, a number or ``(*B,)``; at a singular configuration it bounds the step by ``|e| / 2λ``.
        preferred: ``(*B, N)``, a step of which the part is added that the constraint leaves free (Liégeois 1977).

    Returns:
        ``(*B, N)`` [rad].
    """
    if autocast_is_on():
        return without_autocast(dls_step, jacobian, error, damping, preferred=preferred)
    if preferred is not None:
        error = error - (jacobian @ preferred.unsqueeze(-1)).squeeze(-1)
    gram = jacobian @ jacobian.mT
    square = damping.square().unsqueeze(-1) if isinstance(damping, Tensor) else damping**2
    gram.diagonal(dim1=-2, dim2=-1).add_(square)
    factor, _ = torch.linalg.cholesky_ex(gram)
    step = (jacobian.mT @ torch.cholesky_solve(error.unsqueeze(-1), factor)).squeeze(-1)
    return step if preferred is None else step + preferred


def upright_error(rotation: Tensor) -> Tensor:
    """Rotation vector that turns a tool's z axis straight down and its x axis to the nearest world axis.

    A square box is the same after a quarter turn about z, so the yaw error is taken modulo π/2.

    Args:
        rotation: ``(*B, 3, 3)``, columns are the tool's axes in the base frame.

    Returns:
        ``(*B, 3)`` [rad], base frame: tilt by the small-angle cross product z_tool × (-z), yaw exactly.
    """
    turn = square_turn(rotation[..., 0, 0], rotation[..., 1, 0])
    return torch.stack([-rotation[..., 1, 2], rotation[..., 0, 2], turn], dim=-1)


def square_turn(x: Tensor, y: Tensor) -> Tensor:
    """Turn about z [rad] to the nearest world axis of a square tool, whose x axis shows along (x, y)."""
    yaw = torch.atan2(y, x)
    return torch.round(yaw * (1.0 / QUARTER_TURN)) * QUARTER_TURN - yaw


def limited_step(step: Tensor, limit: Tensor, gain: float) -> Tensor:
    """Shorten ``step`` (*B, N) to ``gain`` of itself, and further so that no joint moves more than ``limit`` (N,)."""
    worst = (step.abs() / limit).amax(dim=-1, keepdim=True)
    return step * torch.clamp(1.0 / worst.clamp_min(1e-12), max=gain)


def braked_step(step: Tensor, limit: Tensor, brake: Tensor) -> Tensor:
    """Shorten ``step`` (*B, N) so that every joint can still stop where the whole of it leads, all in proportion.

    A joint that goes u in a control step and then brakes stops after u + u²/2b, with b what it can change its step by:

        u = -b + √(b² + 2 b e) = 2 b e / (b + √(b² + 2 b e)),  which tends to e where that is small.

    Args:
        step: ``(*B, N)``, the way e that is left.
        limit: ``(N,)``, the most that a joint moves in a control step.
        brake: ``(N,)``, the most that this changes by from one step to the next.
    """
    way = step.abs()
    # The second form: in the first a joint that has nearly nothing to go is rounded to no step, and stops all.
    stops = 2.0 * brake / (brake + (brake.square() + 2.0 * brake * way).sqrt())
    share = stops.minimum(limit / way.clamp_min(1e-12)).amin(dim=-1, keepdim=True)
    return step * share.clamp(max=1.0)


def dls_step_within(  # noqa: PLR0917  # As of `dls_step`, and the limits.
    jacobian: Tensor,
    error: Tensor,
    damping: Tensor,
    q: Tensor,
    lower: Tensor,
    upper: Tensor,
    *,
    preferred: Tensor | None = None,
) -> Tensor:
    """`dls_step` for rows ``(M, …)``, by the joints that may move.

    A joint at its limit that would be pushed out is removed, and the step of its row is solved again: the others do
    the whole of the work, not what such a joint leaves to them.

    Args:
        jacobian: ``(M, R, N)``
        error: ``(M, R)``
        damping: ``(M,)``
        q: where the joints are, ``(M, N)``.
        lower: limits, ``(N,)`` or ``(M, N)``.
        upper: limits, ``(N,)`` or ``(M, N)``.
        preferred: ``(M, N)``

    Returns:
        ``(M, N)``, 0 for joints that are left out.
    """
    step = dls_step(jacobian, error, damping, preferred=preferred)
    may_fall, may_rise = q > lower, q < upper
    held = _pushed_out(step, may_fall, may_rise)
    rows = held.any(dim=-1).nonzero().squeeze(-1)
    held = held[rows]
    while len(rows):
        free = (~held).to(step.dtype)
        wish = None if preferred is None else preferred[rows] * free
        again = dls_step(jacobian[rows] * free.unsqueeze(-2), error[rows], damping[rows], preferred=wish)
        step[rows] = again
        more = _pushed_out(again, may_fall[rows], may_rise[rows])
        going = more.any(dim=-1)
        rows, held = rows[going], (held | more)[going]
    return step


def _pushed_out(step: Tensor, may_fall: Tensor, may_rise: Tensor) -> Tensor:
    """Which joints would leave their limits, ``(M, N)`` bool."""
    return ((step < 0) & ~may_fall) | ((step > 0) & ~may_rise)
