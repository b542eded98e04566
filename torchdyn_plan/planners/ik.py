"""The static planner by inverse kinematics: damped least squares, five steps of the path at a time."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_finite, check_number, check_trailing_shape
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.components import Vector, damped_least_squares
from torchdyn_plan.kinematics.dls import dls_step, limited_step
from torchdyn_plan.kinematics.fused import Columns, Fused, filled
from torchdyn_plan.planners.approach import Approach, square_turn, tool_target, way_to
from torchdyn_plan.planners.protocol import read

PATH_NAMES = ("path_pos", "path_step", "path_goal")


class IKPlanner(TensorDictModuleBase):
    """Drives the arm to ``goal`` with its box upright and square; a goal on the table is approached from above.

    Reads ``joint_pos`` (*B, 6) [rad], ``goal`` (*B, 3) [m, world] and ``step_count`` (*B,); writes ``action`` (*B, 6)
    and its memory under ``plan``. The arm follows a path of `PATH_LENGTH` steps from where it was when the path began,
    whatever it does meanwhile; the path is flushed when the goal changes (paper, Section III-B.1), and rows with
    ``step_count`` 0 start afresh. A control step solves that step of the path alone: a flushed path costs nothing.
    Goals outside the table or the arm's reach are clamped to a near place inside.
    """

    PATH_LENGTH = 5
    _limit: Tensor

    def __init__(
        self,
        arm: Arm | None = None,
        *,
        approach: Approach | None = None,
        control_step: float = 0.004,
        damping: float = 0.02,
        gain: float = 0.25,
        chunk: int | None = None,
        compiled: bool = False,
    ) -> None:
        """Plan for ``arm`` (the UR5 of Trapper by default) at ``control_step`` [s].

        Args:
            arm: a six-joint arm whose tool frame is the box mouth, z axis out of it.
            approach: how goals become tool positions.
            control_step: time between two actions [s].
            damping: λ of the least squares.
            gain: share of the remaining joint error that one step may cover, which brakes the arm at the end.
            chunk: solve in blocks of exactly this many rows, so that results do not depend on the batch size.
            compiled: solve in one compiled loop, which takes a C++ compiler and some seconds at the first call (less
                where torch finds it in its cache); actions are the same but for rounding, do not depend on the batch
                size, and have no derivatives.
        """
        super().__init__()
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        self.in_keys = [keys.JOINT_POS, keys.GOAL, keys.STEP_COUNT]
        written: list[Any] = [keys.ACTION, *((keys.PLAN, name) for name in PATH_NAMES)]
        self.out_keys = written
        self.approach = approach or Approach()
        self.arm = arm or Arm.ur5(tool_length=self.approach.tool_length)
        self.damping, self.gain, self.chunk = damping, gain, chunk
        self._fused = Fused(self._fused_step) if compiled else None
        self.register_buffer("_limit", self.arm.speed_limit * control_step, False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` for the ``goal`` in ``tensordict``, on a new path where the old one is used up or stale.

        Raises:
            InputError: a key is missing, a shape is wrong, or the goal holds a NaN or an infinity.
        """
        get = partial(read, tensordict, reader="IKPlanner")
        joint_pos, goal, step_count = get(keys.JOINT_POS), get(keys.GOAL), get(keys.STEP_COUNT)
        if not torch.compiler.is_compiling():
            self._check(joint_pos, goal)
        plan = tensordict.get(keys.PLAN, None)
        path_pos, path_step = self._recall(plan, joint_pos, goal, step_count)
        action, path_pos = self._step_rows(path_pos, goal)
        tensordict.set(keys.ACTION, action.to(joint_pos.dtype))
        entries = {} if plan is None else dict(plan.items())
        entries.update(zip(PATH_NAMES, (path_pos.to(joint_pos.dtype), path_step + 1, goal), strict=True))
        # A new one each step: tensordicts of earlier steps may share the old one.
        tensordict.set(keys.PLAN, TensorDict(entries, tensordict.batch_size, device=tensordict.device))
        return tensordict

    def _recall(
        self, plan: TensorDictBase | None, joint_pos: Tensor, goal: Tensor, step_count: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Where the path stands, (*B, N) and its step (*B,); where ``plan`` holds none to follow, a new path begins."""
        if plan is None or PATH_NAMES[0] not in plan.keys():  # noqa: SIM118
            return joint_pos, torch.zeros(joint_pos.shape[:-1], dtype=torch.int64, device=joint_pos.device)
        path_pos, path_step, path_goal = map(plan.get, PATH_NAMES)
        ends = (path_step >= self.PATH_LENGTH) | (path_goal != goal).any(-1)
        ends |= step_count.reshape(ends.shape) == 0
        return torch.where(ends.unsqueeze(-1), joint_pos, path_pos), path_step.masked_fill(ends, 0)

    def _step_rows(self, joint_pos: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """`step`, in blocks of ``chunk`` rows if there is one."""
        if self.chunk is None or self._fused is not None:
            return self.step(joint_pos, goal)
        batch, padding = joint_pos.shape, (0, 0, 0, -joint_pos.shape[:-1].numel() % self.chunk)
        rows = [nn.functional.pad(value.reshape(-1, value.shape[-1]), padding) for value in (joint_pos, goal)]
        action, reached = self.step(*rows)
        count = batch[:-1].numel()
        return action[:count].reshape(batch), reached[:count].reshape(batch)

    def _check(self, joint_pos: Tensor, goal: Tensor) -> None:
        check_trailing_shape(keys.JOINT_POS, joint_pos, self.arm.num_joints)
        check_trailing_shape(keys.GOAL, goal, *joint_pos.shape[:-1], 3)
        check_finite(keys.GOAL, goal)

    def path(self, joint_pos: Tensor, goal: Tensor) -> Tensor:
        """Next `PATH_LENGTH` actions from ``joint_pos`` (*B, N) towards ``goal`` (*B, 3) [m, world]: (*B, 5, N)."""
        actions = []
        for _ in range(self.PATH_LENGTH):
            action, joint_pos = self.step(joint_pos, goal)
            actions.append(action)
        return torch.stack(actions, dim=-2)

    def step(self, joint_pos: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """One step of the path from ``joint_pos`` (*B, N) [rad] towards ``goal`` (*B, 3) [m, world].

        Returns:
            The action ``(*B, N)`` and the joint angles to which the path has come ``(*B, N)`` [rad].
        """
        joint_pos, goal = joint_pos.to(self._limit.dtype), goal.to(self._limit.dtype)
        if self._fused is not None:
            if joint_pos.ndim == 2:
                action, reached = self._fused(joint_pos, goal)
                return action, reached
            rows = self._fused(joint_pos.reshape(-1, joint_pos.shape[-1]), goal.reshape(-1, 3))
            action, reached = (value.reshape(joint_pos.shape) for value in rows)
            return action, reached
        pose, jacobian = self._pose_and_jacobian(joint_pos)
        error = torch.stack(self._error(pose.flatten(-2).unbind(-1), goal.unbind(-1)), dim=-1)
        step = limited_step(dls_step(jacobian, error, self.damping), self._limit, self.gain)
        step = torch.clamp(step, self.arm.lower - joint_pos, self.arm.upper - joint_pos)
        return (step / self._limit).clamp(-1.0, 1.0), joint_pos + step

    def _error(self, pose: Sequence[Tensor], goal: Sequence[Tensor]) -> list[Tensor]:
        """The twist still to go [m; rad], six columns, from a pose row by row and a goal x, y, z [m, world]."""
        x, y, height, on_table = tool_target(goal, self.approach)
        tool = pose[3], pose[7], pose[11] + self.approach.base_pos[2]
        way = way_to(tool, (x, y, height), on_table, self.approach)
        # Straight down is the tilt z_tool × (-z), for small angles.
        return [*way, -pose[6], pose[2], square_turn(pose[0], pose[4])]

    def _fused_step(self, joint_pos: Columns, goal: Columns) -> tuple[Vector, Vector]:
        """`step`, column by column."""
        rotation, place, jacobian = self.arm.components(joint_pos)
        pose = [entry for row, end in zip(rotation, place, strict=True) for entry in (*row, end)]
        error = self._error([filled(entry, joint_pos[0]) for entry in pose], goal)
        step = [filled(value, goal[0]) for value in damped_least_squares(jacobian, error, self.damping)]
        limit, lower, upper = (values.tolist() for values in (self._limit, self.arm.lower, self.arm.upper))
        worst = functools.reduce(torch.maximum, [value.abs() / most for value, most in zip(step, limit, strict=True)])
        share = (1.0 / worst.clamp_min(1e-12)).clamp(max=self.gain)
        bounds = zip(joint_pos, lower, upper, strict=True)
        ways = [(low - here, high - here) for here, low, high in bounds]
        step = [torch.clamp(value * share, *way) for value, way in zip(step, ways, strict=True)]
        action = [(value / most).clamp(-1.0, 1.0) for value, most in zip(step, limit, strict=True)]
        return action, [here + value for here, value in zip(joint_pos, step, strict=True)]

    def _pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """The arm's, from products of always ``chunk`` rows where ``joint_pos`` is a multiple of them."""
        if self.chunk is None or joint_pos.ndim != 2 or len(joint_pos) <= self.chunk:
            return self.arm.pose_and_jacobian(joint_pos)
        pose, jacobian = zip(*map(self.arm.pose_and_jacobian, joint_pos.split(self.chunk)), strict=True)
        return torch.cat(pose), torch.cat(jacobian)
