"""A fixed number of damped steps towards a pose, as a controller takes them: eager in few operations, or compiled."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_number, check_trailing_shape
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.components import Component, Vector, add, cross, damped_least_squares, multiply
from torchdyn_plan.kinematics.fused import Columns, Fused


class DampedSteps(nn.Module):
    """``steps`` steps of damped least squares towards poses.

    The turn that is left is taken as sin(θ)·axis, ½ Σ rᵢ × tᵢ over the columns of both rotations: exact to the third
    order at the target, and short of θ far away, where a step is cut short anyhow.
    """

    _ridge: Tensor
    _error: Tensor
    _error_of_target: Tensor

    def __init__(self, arm: Arm, *, steps: int = 5, damping: float = 0.02, compiled: bool = False) -> None:
        """Step ``arm``; ``damping`` is λ. ``compiled`` is one loop by a C++ compiler, see `Fused`."""
        super().__init__()
        check_number("steps", steps, minimum=1, integer=True)
        check_number("damping", damping, minimum=1e-6)
        self.arm, self.steps, self.damping = arm, steps, damping
        like = {"dtype": arm.lower.dtype, "device": arm.lower.device}
        self.register_buffer("_ridge", damping**2 * torch.eye(6, **like), persistent=False)
        constant, linear = _error_matrices()
        self.register_buffer("_error", constant.to(**like), persistent=False)
        self.register_buffer("_error_of_target", linear.to(**like), persistent=False)
        self._fused = Fused(self._columns) if compiled else None

    def forward(self, joint_pos: Tensor, target: Tensor) -> Tensor:
        """From ``joint_pos`` (*B, N) [rad; m] towards ``target`` (*B, 4, 4): (*B, N).

        Raises:
            InputError: a shape is wrong, or the arm is of another precision or device.
        """
        self.arm.check(joint_pos)
        check_trailing_shape("target", target, *joint_pos.shape[:-1], 4, 4)
        q, wanted = joint_pos.reshape(-1, self.arm.num_joints), target.reshape(-1, 16)
        q = self._fused(q, wanted[:, :12])[0] if self._fused is not None else self._eager(q, wanted)
        return q.reshape(joint_pos.shape)

    def _eager(self, q: Tensor, target: Tensor) -> Tensor:
        own = cast(dict[str, Tensor], self._buffers)
        # The error is linear in the pose, by a matrix that is linear in the target.
        to_error = torch.addmm(own["_error"], target, own["_error_of_target"]).view(-1, 6, 16)
        column, form = q.unsqueeze(-1), self.arm.form
        for _ in range(self.steps):
            pose, jacobian = form.pose_and_jacobian(q)
            error = torch.bmm(to_error, pose.view(-1, 16, 1))
            transposed = jacobian.mT
            factor, _ = torch.linalg.cholesky_ex(torch.baddbmm(own["_ridge"], jacobian, transposed))
            # Two triangular solves take half the time of `cholesky_solve`.
            half = torch.linalg.solve_triangular(factor, error, upper=False)
            weights = torch.linalg.solve_triangular(factor.mT, half, upper=True)
            column = torch.baddbmm(column, transposed, weights)
            q = column.squeeze(-1)
        return q

    def _columns(self, joint_pos: Columns, target: Columns) -> tuple[Vector]:
        """`_eager`, column by column."""
        q = list(joint_pos)
        for _ in range(self.steps):
            rotation, place, jacobian = self.arm.components(q)
            way: Vector = [target[4 * i + 3] - place[i] for i in range(3)]
            turn: Vector = [0.0, 0.0, 0.0]
            for j in range(3):
                part = cross([row[j] for row in rotation], [target[4 * i + j] for i in range(3)])
                turn = [add(total, value) for total, value in zip(turn, part, strict=True)]
            error: list[Component] = [*way, *(multiply(0.5, value) for value in turn)]
            step = damped_least_squares(jacobian, error, self.damping)
            q = [here + value for here, value in zip(q, step, strict=True)]
        return (list(q),)


def _error_matrices() -> tuple[Tensor, Tensor]:
    """What turns flat targets t into flat matrices E, by which a flat pose p, last entry 1, becomes the error E p.

    Returns:
        Constant ``(96,)`` and linear part ``(16, 96)`` of E, ``(6, 16)`` laid out flat.
    """
    constant, linear = torch.zeros(6, 4, 4), torch.zeros(4, 4, 6, 4, 4)
    for i in range(3):
        constant[i, i, 3] = -1.0
        linear[i, 3, i, 3, 3] = 1.0
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for j in range(3):
            # ½ (r × t) of column j, entry a: r_b t_c - r_c t_b.
            linear[c, j, 3 + a, b, j] = 0.5
            linear[b, j, 3 + a, c, j] = -0.5
    return constant.flatten(), linear.view(16, 96)
