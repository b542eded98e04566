"""Inverse kinematics for TorchRL: a `CartesianSolver` for its robot macro actions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number, check_same_device, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.solver import ROUNDS, IKResult, check_task, inside_limits, solve_rows
from torchdyn_plan.kinematics.targets import is_pose, rotation_matrix, rotation_vector
from torchdyn_plan.kinematics.trajectory import follow_rows, following
from torchdyn_plan.precision import Precise, without_autocast

SOLUTIONS = 4
"""Number of solutions searched for each pose; the nearest is taken."""
NO_TURN = (1.0, 0.0, 0.0, 0.0)


class ArmSolver(Precise):
    """Batched inverse kinematics of an arm with TorchRL's protocol ``torchrl.envs.CartesianSolver``.

    Pass it to ``URScriptPrimitiveTransform(cartesian_solver=…)``. An action is the arm's joint positions and a last
    entry for the gripper, which is passed through. If a pose is not reached the action is the nearest one found;
    `solve` returns the status of each row.
    """

    base: Tensor

    def __init__(
        self,
        arm: Arm,
        *,
        base: Tensor | None = None,
        position_tolerance: float = 1e-4,
        rotation_tolerance: float = math.radians(0.1),
        iterations: int = 24,
    ) -> None:
        """Solve for ``arm``.

        Args:
            arm: the arm, whose tool is brought to the poses.
            base: ``(4, 4)``, the arm's base frame in the world [m]; the world itself by default.
            position_tolerance: [m]
            rotation_tolerance: [rad], weighted by the mask.
            iterations: most steps from one start.

        Raises:
            InputError: the base is not a pose, or there is no arm.
        """
        super().__init__()
        if not isinstance(arm, Arm):
            raise InputError(f"arm must be an Arm, such as Arm.ur5() or Arm.from_urdf(...), got {type(arm).__name__}")
        check_task("pose", 1, position_tolerance, rotation_tolerance, iterations)
        place = torch.eye(4, dtype=torch.float64) if base is None else base
        good = isinstance(place, Tensor) and place.shape == (4, 4) and place.is_floating_point()
        if not good or not bool(is_pose(place.unsqueeze(0), "pose")):
            raise InputError(f"base must be a pose of shape (4, 4), got {base}")
        self.arm, self.iterations = arm, iterations
        self.tolerances = position_tolerance, rotation_tolerance
        self.register_buffer("base", place.to(arm.lower), persistent=False)

    def forward(
        self,
        target_pose: Tensor,
        start_action: Tensor,
        *,
        orientation_mask: Tensor | None = None,
        waypoints: int | None = None,
    ) -> Tensor:
        """The action, or the actions of a straight path, that bring the tool to ``target_pose``.

        Args:
            target_pose: ``(*B, 7)``, position [m] and quaternion wxyz in the world; an invalid quaternion leaves the
                orientation free.
            start_action: ``(*B, N + 1)``, start of the search [rad; m].
            orientation_mask: ``(*B, 3)``, weights of the rotations about the world's axes; 0 leaves an axis free. Rows
                with a NaN or an infinity have no mask.
            waypoints: number of poses along the straight line from the tool's position, all of which are met.

        Returns:
            ``(*B, N + 1)``, or ``(*B, waypoints, N + 1)``.

        Raises:
            InputError: a shape, device or number is wrong.
        """
        q = self.solve(target_pose, start_action, orientation_mask=orientation_mask, waypoints=waypoints).q
        gripper = start_action[..., -1:] if waypoints is None else start_action[..., None, -1:]
        return torch.cat([q.to(start_action.dtype), gripper.expand(*q.shape[:-1], 1)], dim=-1)

    @torch.no_grad()
    def solve(
        self,
        target_pose: Tensor,
        start_action: Tensor,
        *,
        orientation_mask: Tensor | None = None,
        waypoints: int | None = None,
    ) -> IKResult:
        """Like `forward`, but returns the joints with status and residuals, as `solve_ik` and `follow` do."""
        batch, like = self._check(target_pose, start_action, orientation_mask, waypoints), self.arm.lower
        pose = target_pose.reshape(-1, 7).to(like)
        mask = None if orientation_mask is None else orientation_mask.reshape(-1, 3).to(like)
        start = start_action[..., :-1].reshape(-1, self.arm.num_joints).to(like)
        q, status, residual = without_autocast(self._solve, pose, start, mask, waypoints)
        shape = batch if waypoints is None else (*batch, waypoints)
        return IKResult(q.reshape(*shape, self.arm.num_joints), status.reshape(shape), residual.reshape(*shape, 2))

    def _solve(
        self, pose: Tensor, start: Tensor, mask: Tensor | None, waypoints: int | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`solve` for rows ``(M, …)``; for a path, ``(M, waypoints, …)``."""
        target, weights = self._targets(pose, mask)
        search = following(self.arm, "pose", 1, self.tolerances, self.iterations)._replace(weights=weights)
        first = inside_limits(self.arm, start)
        if waypoints is not None:
            path = _straight(self.arm(first.nan_to_num()), target, waypoints)
            return follow_rows(search, path, first, torch.full_like(self.arm.lower, torch.inf), patience=1)
        q, status, residual = solve_rows(search._replace(target=target), start, first, ROUNDS, SOLUTIONS)
        return q[:, 0], status[:, 0], residual[:, 0]

    def _targets(self, pose: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Poses ``(M, 4, 4)`` in the arm's base frame, and weights ``(M, 6, 6)`` of their errors, None if all are 1."""
        turned = pose[:, 3:].square().sum(dim=-1).sqrt()
        oriented = turned.isfinite() & (turned > 1e-6)
        eye = torch.eye(4, dtype=pose.dtype, device=pose.device).repeat(len(pose), 1, 1)
        world = eye.clone()
        quaternion = torch.where(oriented.unsqueeze(-1), pose[:, 3:] / turned.unsqueeze(-1), pose.new_tensor(NO_TURN))
        world[:, :3, :3], world[:, :3, 3] = _rotation(quaternion), pose[:, :3]
        weigh = oriented.unsqueeze(-1).to(pose.dtype).expand(-1, 3)
        if mask is not None:
            weigh = weigh * torch.where(mask.isfinite().all(dim=-1, keepdim=True), mask, 1.0)
        target = torch.linalg.inv(self.base) @ world
        if bool((weigh == 1.0).all()):
            return target, None
        weights = torch.eye(6, dtype=pose.dtype, device=pose.device).repeat(len(pose), 1, 1)
        # Errors are in the base frame, weights about the world's axes.
        weights[:, 3:, 3:] = weigh.unsqueeze(-1) * self.base[:3, :3]
        return target, weights

    def _check(
        self, target_pose: Tensor, start_action: Tensor, orientation_mask: Tensor | None, waypoints: int | None
    ) -> torch.Size:
        check_trailing_shape("target_pose", target_pose, 7)
        batch = target_pose.shape[:-1]
        check_trailing_shape("start_action", start_action, *batch, self.arm.num_joints + 1)
        given = {"target_pose": target_pose, "start_action": start_action, "orientation_mask": orientation_mask}
        if orientation_mask is not None:
            check_trailing_shape("orientation_mask", orientation_mask, *batch, 3)
        for name, value in given.items():
            if value is not None:
                check_same_device(name, value, self.base.device, "the arm")
        if waypoints is not None:
            check_number("waypoints", waypoints, minimum=1, integer=True)
        return batch


def _straight(start: Tensor, target: Tensor, count: int) -> Tensor:
    """Poses ``(M, count, 4, 4)`` on the straight line from ``start`` to ``target`` (M, 4, 4), without the start."""
    share = torch.arange(1, count + 1, dtype=start.dtype, device=start.device).unsqueeze(-1) / count
    path = target.unsqueeze(1).repeat(1, count, 1, 1)
    turn = rotation_vector(target[:, :3, :3] @ start[:, :3, :3].mT)
    path[..., :3, :3] = rotation_matrix(share * turn.unsqueeze(1)) @ start[:, None, :3, :3]
    path[..., :3, 3] = torch.lerp(start[:, None, :3, 3], target[:, None, :3, 3], share)
    return path


def _rotation(quaternion: Tensor) -> Tensor:
    """Rotations ``(M, 3, 3)`` of unit quaternions wxyz ``(M, 4)``."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).view(-1, 3, 3)
