"""The static planner by inverse kinematics: damped least squares, five steps of the path at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_finite, check_number, check_trailing_shape
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.dls import dls_step, limited_step, upright_error
from torchdyn_plan.planners.protocol import read

PATH_NAMES = ("path_pos", "path_step", "path_goal")


@dataclass(frozen=True, kw_only=True)
class Approach:
    """How goals become tool positions: where the table is, how high to travel, where the box may stand."""

    base_pos: tuple[float, float, float] = (0.0, -0.855, 0.05)
    """Position of the arm's base frame in the world, axes parallel [m]."""
    tool_length: float = 0.084
    """Distance of the box mouth from the flange [m]."""
    table_height: float = 0.052
    """Goals at or below this height are on the table: the box is dropped over them [m]."""
    down_height: float = 0.006
    """Height of the box mouth when it is down [m]."""
    travel_height: float = 0.099
    """Height of the box mouth on its way to a goal on the table, above the ball [m]."""
    clear_height: float = 0.089
    """Below this the box slows sideways as it lifts, and 2 cm below it stands still sideways [m]."""
    drop_distance: float = 0.045
    """Horizontal distance from the goal within which the box drops [m]."""
    half_extent: float = 0.722
    """The tool's place is clamped to the square of this half-side, which keeps the box clear of the rails [m]."""
    min_radius: float = 0.1
    """The tool keeps at least this distance from the arm's vertical axis [m]."""
    max_radius: float = 0.91
    """The tool keeps at most this distance from the arm's vertical axis [m]."""

    def __post_init__(self) -> None:
        for name in ("tool_length", "down_height", "travel_height", "drop_distance", "half_extent", "max_radius"):
            check_number(name, getattr(self, name), minimum=0.0)


class IKPlanner(TensorDictModuleBase):
    """Drives the arm to ``goal`` with its box upright and square; a goal on the table is approached from above.

    Reads ``joint_pos`` (*B, 6) [rad], ``goal`` (*B, 3) [m, world] and ``step_count`` (*B,); writes ``action`` (*B, 6)
    and its memory under ``plan``. The arm follows a path of `PATH_LENGTH` steps from where it was when the path began,
    whatever it does meanwhile; the path is flushed when the goal changes (paper, Section III-B.1), and rows with
    ``step_count`` 0 start afresh. A control step solves that step of the path alone: a flushed path costs nothing.
    Goals outside the table or the arm's reach are clamped to a near place inside.
    """

    PATH_LENGTH = 5
    _base: Tensor
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
    ) -> None:
        """Plan for ``arm`` (the UR5 of Trapper by default) at ``control_step`` [s].

        Args:
            arm: a six-joint arm whose tool frame is the box mouth, z axis out of it.
            approach: how goals become tool positions.
            control_step: time between two actions [s].
            damping: λ of the least squares.
            gain: share of the remaining joint error that one step may cover, which brakes the arm at the end.
            chunk: solve in blocks of exactly this many rows, so that results do not depend on the batch size.
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
        self.register_buffer("_base", torch.tensor(self.approach.base_pos, dtype=self.arm.lower.dtype), False)
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
        if self.chunk is None:
            return self.step(joint_pos, goal)
        batch, padding = joint_pos.shape, (0, 0, 0, -joint_pos.shape[:-1].numel() % self.chunk)
        rows = [nn.functional.pad(value.reshape(-1, value.shape[-1]), padding) for value in (joint_pos, goal)]
        action, reached = self.step(*rows)
        count = batch[:-1].numel()
        return action[:count].reshape(batch), reached[:count].reshape(batch)

    def _check(self, joint_pos: Tensor, goal: Tensor) -> None:
        check_trailing_shape(keys.JOINT_POS, joint_pos, self.arm.num_joints)
        check_trailing_shape(keys.GOAL, goal, *joint_pos.shape[:-1], 3)
        # The sum is a quick look: only a sum that is not finite is worth the full one.
        if not torch.isfinite(goal.sum()):
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
        joint_pos, goal = joint_pos.to(self._base.dtype), goal.to(self._base.dtype)
        target, on_table = self.tool_target(goal)
        pose, jacobian = self._pose_and_jacobian(joint_pos)
        way = way_to(pose[..., :3, 3], target - self._base, on_table, self.approach, self._base[2])
        error = torch.cat([way, upright_error(pose[..., :3, :3])], dim=-1)
        step = limited_step(dls_step(jacobian, error, self.damping), self._limit, self.gain)
        step = torch.clamp(step, self.arm.lower - joint_pos, self.arm.upper - joint_pos)
        return (step / self._limit).clamp(-1.0, 1.0), joint_pos + step

    def _pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """The arm's, from products of always ``chunk`` rows where ``joint_pos`` is a multiple of them."""
        if self.chunk is None or joint_pos.ndim != 2 or len(joint_pos) <= self.chunk:
            return self.arm.pose_and_jacobian(joint_pos)
        pose, jacobian = zip(*map(self.arm.pose_and_jacobian, joint_pos.split(self.chunk)), strict=True)
        return torch.cat(pose), torch.cat(jacobian)

    def tool_target(self, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Place of the box mouth for ``goal`` (*B, 3), both [m, world], and whether the goal is on the table (*B,)."""
        a = self.approach
        on_table = goal[..., 2] <= a.table_height
        place = goal[..., :2].clamp(-a.half_extent, a.half_extent) - self._base[:2]
        radius = place.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        place = place * (radius.clamp(a.min_radius, a.max_radius) / radius) + self._base[:2]
        place = place.clamp(-a.half_extent, a.half_extent)
        height = torch.where(on_table, a.down_height, goal[..., 2])
        return torch.cat([place, height.unsqueeze(-1)], dim=-1), on_table


def way_to(tool: Tensor, target: Tensor, on_table: Tensor, approach: Approach, base_height: Tensor | float) -> Tensor:
    """Displacement that a tool has still to make, ``(*B, 3)`` [m], as a velocity direction at ``tool``.

    Sideways the way is taken in polar coordinates about the arm's axis (out of its own way, pan and reach at once).
    A goal on the table is approached at the travel height; the box drops within the drop distance, and a box more
    than 2 cm below the clear height lifts before it moves.

    Args:
        tool: ``(*B, 3)`` [m], base frame.
        target: ``(*B, 3)`` [m], base frame.
        on_table: ``(*B,)`` bool.
        approach: heights and distances.
        base_height: height of the base above the table [m].
    """
    x, y, z = tool.unbind(-1)
    goal_x, goal_y, goal_z = target.unbind(-1)
    radius = torch.hypot(x, y).clamp_min(1e-6)
    away = torch.hypot(goal_x - x, goal_y - y)
    forward = (torch.hypot(goal_x, goal_y) - radius) / radius
    turn = torch.atan2(x * goal_y - y * goal_x, x * goal_x + y * goal_y)
    side = torch.stack([x * forward - y * turn, y * forward + x * turn], dim=-1)
    far = ((away - approach.drop_distance) / 0.015).clamp(0.0, 1.0)
    height, lift = z + base_height, approach.travel_height - approach.down_height
    wanted = goal_z + base_height + torch.where(on_table, lift * far, 0.0)
    low = torch.maximum(far, (~on_table).to(far.dtype)) * (approach.clear_height - height) / 0.02
    side = side * (1.0 - low.clamp(0.0, 1.0)).unsqueeze(-1)
    return torch.cat([side, (wanted - height).unsqueeze(-1)], dim=-1)
