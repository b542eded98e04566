"""Arrival times of an arm from its joint limits, without training or simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.solver import IKStatus, solve_ik
from torchdyn_plan.kinematics.timing import arrival_time
from torchdyn_plan.nets.arrival import ArrivalModel
from torchdyn_plan.nets.distributions import Arrival
from torchdyn_plan.precision import Precise, at_least_float32


class GoalJoints(Protocol):
    """Gives the joint positions at a goal; a `torchdyn_plan.planners.IKPlanner` is one."""

    def goal_joints(self, joint_pos: Tensor, goal: Tensor, /) -> tuple[Tensor, Tensor]:
        """Joints ``(*B, N)`` at ``goal`` (*B, 3) [m, world], from ``joint_pos`` (*B, N), and whether it is reached.

        With a ``goal_size`` of 7, goals are poses like ``goal_pose``.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedJoints:
    """Joints from `solve_ik`: of all solutions found, the one reached soonest."""

    arm: Arm
    """The arm."""
    rotation: tuple[tuple[float, float, float], ...] | None = None
    """Rotation matrix of the tool at the goal, row by row, in the arm's base frame; None for any orientation."""
    base_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the arm's base frame in the world, axes parallel [m]."""

    def goal_joints(self, joint_pos: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """As of `GoalJoints`."""
        place = goal - goal.new_tensor(self.base_pos)
        joint_pos = joint_pos.expand(*goal.shape[:-1], joint_pos.shape[-1])
        if self.rotation is None:
            found = solve_ik(self.arm, place, q0=joint_pos, constraint="position")
        else:
            pose = torch.eye(4, dtype=goal.dtype, device=goal.device).repeat(*goal.shape[:-1], 1, 1)
            pose[..., :3, :3] = goal.new_tensor(self.rotation)
            pose[..., :3, 3] = place
            found = solve_ik(self.arm, pose, q0=joint_pos)
        return found.q, found.status == int(IKStatus.SOLVED)


class AnalyticArrival(Precise, ArrivalModel):
    """Arrival of an arm whose joints move at their limits and stop at the goal together.

    Joints move straight to their goal positions with trapezoidal speed profiles, starting from their present speeds:
    the time of the slowest joint is a lower bound for any controller on that path. Delays of the controller are
    settings.
    """

    speed: Tensor
    acceleration: Tensor

    def __init__(
        self,
        joints: GoalJoints,
        *,
        speed: Sequence[float] | Tensor,
        acceleration: Sequence[float] | Tensor,
        control_step: float = 0.004,
        extra_steps: float = 0.0,
        slowdown: float = 1.0,
    ) -> None:
        """Make the model.

        Args:
            joints: gives the joints of a goal.
            speed: limits of the N joints [rad/s; m/s].
            acceleration: limits of the N joints [rad/s²; m/s²].
            control_step: time between two control steps [s].
            extra_steps: additional control steps of the controller, for lag and settling; negative if a tool counts as
                arrived before it has stopped.
            slowdown: factor by which the controller is slower than the limits allow.
        """
        super().__init__()
        if not hasattr(joints, "goal_joints"):
            raise InputError(f"joints must have goal_joints, like an IKPlanner, got {type(joints).__name__}")
        check_number("control_step", control_step, minimum=1e-6)
        check_number("extra_steps", extra_steps)
        check_number("slowdown", slowdown, minimum=1e-3)
        limits = {"speed": speed, "acceleration": acceleration}
        for name, values in limits.items():
            given = torch.as_tensor(values, dtype=torch.float32)
            if given.ndim != 1 or not bool(((given > 0.0) & given.isfinite()).all()):
                raise InputError(f"{name} must be a positive number for each joint, got {given.tolist()}")
            self.register_buffer(name, given, persistent=False)
        if self.speed.shape != self.acceleration.shape:
            counts = f"{len(self.speed)} and {len(self.acceleration)}"
            raise InputError(f"speed and acceleration must have equally many joints, got {counts}")
        self.joints, self.control_step = joints, control_step
        self.extra_steps, self.slowdown = extra_steps, slowdown

    def arrival(self, robot_state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Arrival ``(*B, K)`` at goals (*B, K, 3) [m, world], with any estimator; *never* if no joints reach a goal.

        If its joints have a ``goal_size`` of 7, goals are poses.

        ``robot_state`` (*B, 1, S) begins with the joints' positions and speeds, N of each.
        """
        count = len(self.speed)
        if robot_state.shape[-1] < 2 * count:
            raise InputError(f"robot_state must begin with {2 * count} numbers of joints, got {robot_state.shape[-1]}")
        check_trailing_shape("goal", goal, getattr(self.joints, "goal_size", 3))
        place = at_least_float32(goal)
        joint_pos, joint_vel = robot_state.to(place.dtype)[..., : 2 * count].split(count, dim=-1)
        there, reached = self.joints.goal_joints(joint_pos, place)
        return Arrival(self.steps(there - joint_pos, joint_vel), ~reached)

    def steps(self, offset: Tensor, velocity: Tensor) -> Tensor:
        """Control steps ``(*B,)`` until joints with ``velocity`` (*B, N) come to rest ``offset`` (*B, N) away."""
        speed, acceleration = self.speed.to(offset.dtype), self.acceleration.to(offset.dtype)
        seconds = arrival_time(offset, velocity, speed, acceleration)
        return (seconds * (self.slowdown / self.control_step) + self.extra_steps).clamp_min(0.0)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        limits = {name: tuple(getattr(self, name).tolist()) for name in ("speed", "acceleration")}
        own = {name: getattr(self, name) for name in ("joints", "control_step", "extra_steps", "slowdown")}
        return own | limits
