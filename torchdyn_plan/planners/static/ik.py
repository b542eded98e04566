"""Static planner by inverse kinematics: damped least squares, five steps of the path at a time."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.func import debug_unwrap

from torchdyn_plan import keys
from torchdyn_plan.checks import check_finite, check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.components import Vector, damped_least_squares
from torchdyn_plan.kinematics.descent import evaluate
from torchdyn_plan.kinematics.dls import braked_step, dls_step, limited_step
from torchdyn_plan.kinematics.fused import Columns, Fused, filled
from torchdyn_plan.nets.analytic_arrival import AnalyticArrival
from torchdyn_plan.nets.by_noise import LEAST_NOISE
from torchdyn_plan.planners.memory import remember, warn_of_loss
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.static.approach import Approach, StraightToGoal, is_round, reads_pose
from torchdyn_plan.planners.static.base import StaticPlannerModule
from torchdyn_plan.precision import Precise


class Path(NamedTuple):
    """Progress along each arm's path; its names under ``plan`` begin with ``path_``."""

    pos: Tensor
    """``(*B, N)`` joint angles reached on it [rad]."""
    step: Tensor
    """``(*B,)`` int64 number of its steps taken."""
    goal: Tensor
    """``(*B, 3)`` its goal [m, world]; ``(*B, 7)`` for a planner of poses."""


PASSES = 2
"""Number of times a step is solved again without the joints that it would push beyond their limits."""
GOAL_STEPS, GOAL_STEP = 10, 0.5
"""Steps used to find the end of a path, and the most that a joint moves in one of them [rad]."""
GOAL_DAMPING = 0.005
"""λ of these steps."""
GOAL_TOLERANCE = 0.015
"""A tool within this distance of its goal has arrived [m]."""
TURN_TOLERANCE = 0.05
"""The same for its orientation [rad]."""
GOAL_SPEED = 2.0
"""A goal that changes no faster than this is a moving goal; a larger jump is a new goal [m/s]."""
PATH_NAMES = tuple(f"path_{field}" for field in Path._fields)
PATH_SET = frozenset(PATH_NAMES)


class IKPlanner(Precise, StaticPlannerModule):
    """Drives an arm's tool to ``goal`` by inverse kinematics, along the path of its approach.

    Reads ``joint_pos`` (*B, N) [rad], ``goal`` (*B, 3) [m, world] and ``step_count`` (*B,); writes ``action`` (*B, N)
    and its memory under ``plan``. The arm follows a path of `PATH_LENGTH` steps from its position at the start of the
    path, in open loop; the path is flushed when the goal changes (paper, Section III-B.1), and rows with ``step_count``
    0 restart. Each control step solves one step of the path only, so a flushed path costs nothing.

    With an approach that turns the tool, `TurnedToGoal`, it and its methods read ``goal_pose`` (*B, 7) instead of
    ``goal``.
    """

    PATH_LENGTH = 5
    _limit: Tensor
    _brake: Tensor

    def __init__(
        self,
        arm: Arm,
        *,
        approach: Approach | None = None,
        control_step: float = 0.004,
        damping: float = 0.02,
        noisy_damping: float | None = None,
        gain: float = 0.25,
        acceleration: float | Sequence[float] | None = None,
        chunk: int | None = None,
        compiled: bool = False,
    ) -> None:
        """Plan for ``arm`` at ``control_step`` [s].

        Args:
            arm: the arm, whose tool frame is driven to the goal.
            approach: how the tool approaches a goal; straight, from a base at the world's origin, by default.
            control_step: time between two actions [s].
            damping: λ of the least squares.
            noisy_damping: λ for goals from noisy measurements, see `for_noise`. None for ``damping``. An arm that is
                nearly stretched out shakes when its goal jitters: joints reverse at full speed, not all in the same
                time, and the tool leaves its height by centimetres. More damping keeps it still.
            gain: share of the remaining joint error that one step may cover, which brakes the arm at the end.
            acceleration: limit of each joint, or of all of them [rad/s²]. The arm then brakes by this limit instead of
                ``gain``, and follows a moving goal one control step behind it. None for the gain only.
            chunk: solve in blocks of exactly this many rows, so that results do not depend on the batch size. Take a
                multiple of 32: in a smaller block the last bit may depend on a row's place, as processors compute
                what does not fill their vectors in another way.
            compiled: solve in one compiled loop. Needs a C++ compiler and some seconds at the first call (less if torch
                has it cached); actions are the same up to rounding, do not depend on the batch size, and have no
                derivatives.
        """
        super().__init__()
        if not isinstance(arm, Arm):
            raise InputError(f"arm must be an Arm, such as Arm.ur5() or Arm.from_urdf(...), got {type(arm).__name__}")
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        if noisy_damping is not None:
            check_number("noisy_damping", noisy_damping, minimum=1e-9)
        self.arm, self.approach = arm, approach or StraightToGoal()
        turns = reads_pose(self.approach)
        self._round = is_round(self.approach)
        self.goal_key, self.goal_size = (keys.GOAL_POSE, 7) if turns else (keys.GOAL, 3)
        if compiled and (turns or acceleration is not None):
            raise InputError("a compiled IKPlanner takes neither poses nor an acceleration: leave compiled=False")
        remembered: list[Any] = [(keys.PLAN, name) for name in PATH_NAMES]
        self.in_keys = [keys.JOINT_POS, self.goal_key, keys.STEP_COUNT, *remembered]
        self.out_keys = [keys.ACTION, *remembered]
        self.control_step, self.damping, self.gain, self.chunk = control_step, damping, gain, chunk
        self.noisy_damping, self.compiled = noisy_damping, compiled
        self._fused = Fused(self._fused_step) if compiled else None
        self._width = torch.Size([arm.num_joints])
        self.register_buffer("_limit", arm.needed_speed_limit("IKPlanner") * control_step, False)
        self.acceleration = acceleration
        self.register_buffer("_brake", None if acceleration is None else self._brake_of(acceleration), False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` for the ``goal`` in ``tensordict``, on a new path if the old one is finished or stale.

        Raises:
            InputError: a key is missing, a shape is wrong, or the goal holds a NaN or an infinity.
        """
        joint_pos, goal = tensordict.get(keys.JOINT_POS, None), tensordict.get(self.goal_key, None)
        step_count = tensordict.get(keys.STEP_COUNT, None)
        if joint_pos is None or goal is None or step_count is None:
            wanted = keys.JOINT_POS, self.goal_key, keys.STEP_COUNT
            joint_pos, goal, step_count = (read(tensordict, key, "IKPlanner") for key in wanted)
        if not torch.compiler.is_compiling():
            fits = joint_pos.shape[-1:] == self._width and goal.shape == (*joint_pos.shape[:-1], self.goal_size)
            if not (fits and math.isfinite(debug_unwrap(goal).sum().item())):
                self._check(joint_pos, goal)
        path_pos, path_step, before = self._recall(tensordict.get(keys.PLAN, None), joint_pos, goal, step_count)
        goals = (goal,) if self.acceleration is None else (goal, before)
        blocks = self.chunk is not None and self._fused is None
        action, path_pos = self._step_blocks(path_pos, *goals) if blocks else self.step(path_pos, *goals)
        if action.dtype != joint_pos.dtype:
            action, path_pos = action.to(joint_pos.dtype), path_pos.to(joint_pos.dtype)
        tensordict.set(keys.ACTION, action)
        path = Path(path_pos, path_step + 1, goal)
        remember(tensordict, dict(zip(PATH_NAMES, path, strict=True)))
        return tensordict

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """The entries of a finished path, see `Remembering`."""
        batch = like.shape[:-1]
        step = torch.full(batch, self.PATH_LENGTH, dtype=torch.int64, device=like.device)
        path = Path(like.new_zeros(*batch, self.arm.num_joints), step, like.new_zeros(*batch, self.goal_size))
        return dict(zip(PATH_NAMES, path, strict=True))

    def arrival_model(self) -> AnalyticArrival:
        """Model of its arrival times; ``robot_state`` must begin with the joints' positions and speeds.

        It assumes that joints speed up as fast as the planner brakes: at its acceleration, or within ``1 / gain``
        control steps. For a robot that lags, or with other limits, make your own `AnalyticArrival`.
        """
        speed = self._limit / self.control_step
        if self.acceleration is None:
            acceleration = speed * (self.gain / self.control_step)
        else:
            acceleration = self._brake / self.control_step**2
        return AnalyticArrival(self, speed=speed, acceleration=acceleration, control_step=self.control_step)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        names = ("arm", "approach", "control_step", "damping", "gain", "chunk", "compiled")
        # Left out if absent, so that planners saved before these settings existed keep their description.
        others = [name for name in ("noisy_damping", "acceleration") if getattr(self, name) is not None]
        return {name: getattr(self, name) for name in (*names, *others)}

    def for_noise(self, noise: float) -> Self:
        """The planner with ``noisy_damping``, if it has one and measurements err by `LEAST_NOISE` or more [m]."""
        if self.noisy_damping is None or noise < LEAST_NOISE:
            return self
        settings: dict[str, Any] = self.part_settings() | {"damping": self.noisy_damping, "noisy_damping": None}
        return type(self)(**settings).train(self.training)

    def _brake_of(self, acceleration: float | Sequence[float]) -> Tensor:
        """Largest change of each joint's step from one control step to the next, ``(N,)`` [rad]."""
        count = self.arm.num_joints
        values = [acceleration] * count if isinstance(acceleration, (int, float)) else list(acceleration)
        if len(values) != count:
            raise InputError(f"acceleration must be one number, or {count}, one for each joint, got {len(values)}")
        for value in values:
            check_number("acceleration", value, minimum=1e-6)
        return self._limit.new_tensor(values) * self.control_step**2

    def _recall(self, plan: Any, joint_pos: Tensor, goal: Tensor, step_count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The path's joint angles (*B, N), its step (*B,), and the last step's goal, or else the present one.

        A new path begins where ``plan`` holds none to follow.
        """
        stored: dict[str, Any] = {} if plan is None else dict(plan.items())
        if not stored.keys() >= PATH_SET:
            warn_of_loss(PATH_NAMES[0], step_count == 0)
            return joint_pos, torch.zeros(joint_pos.shape[:-1], dtype=torch.int64, device=joint_pos.device), goal
        path = Path(*(stored[name] for name in PATH_NAMES))
        ends = (path.step >= self.PATH_LENGTH) | (path.goal != goal).any(-1)
        fresh = step_count.reshape(ends.shape) == 0
        ends |= fresh
        before = path.goal if self.acceleration is None else torch.where(fresh.unsqueeze(-1), goal, path.goal)
        return torch.where(ends.unsqueeze(-1), joint_pos, path.pos), path.step.masked_fill(ends, 0), before

    def _step_blocks(self, joint_pos: Tensor, *goals: Tensor) -> tuple[Tensor, Tensor]:
        """`step` in blocks of ``chunk`` rows, the last one padded."""
        assert self.chunk is not None
        batch, padding = joint_pos.shape, (0, 0, 0, -joint_pos.shape[:-1].numel() % self.chunk)
        rows = [nn.functional.pad(value.reshape(-1, value.shape[-1]), padding) for value in (joint_pos, *goals)]
        action, reached = self.step(*rows)
        count = batch[:-1].numel()
        return action[:count].reshape(batch), reached[:count].reshape(batch)

    def _check(self, joint_pos: Tensor, goal: Tensor) -> None:
        check_trailing_shape(keys.JOINT_POS, joint_pos, self.arm.num_joints)
        check_trailing_shape(self.goal_key, goal, *joint_pos.shape[:-1], self.goal_size)
        check_finite(self.goal_key, goal)

    def path(self, joint_pos: Tensor, goal: Tensor) -> Tensor:
        """Next `PATH_LENGTH` actions from ``joint_pos`` (*B, N) towards ``goal`` (*B, 3) [m, world]: (*B, 5, N)."""
        actions = []
        for _ in range(self.PATH_LENGTH):
            action, joint_pos = self.step(joint_pos, goal)
            actions.append(action)
        return torch.stack(actions, dim=-2)

    def goal_joints(self, joint_pos: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """End of the path from ``joint_pos`` (*B, N) [rad] to ``goal`` (*B, 3) [m, world]; differentiable.

        It is computed in `GOAL_STEPS` long steps of the approach, instead of the many steps of a real path.

        Returns:
            Joint angles ``(*B, N)`` [rad], and ``(*B,)`` bool: the tool is then at the goal, within `GOAL_TOLERANCE`.
        """
        goal = goal.to(self._limit.dtype)
        q = joint_pos.to(goal.dtype).expand(*goal.shape[:-1], joint_pos.shape[-1])
        batch, goal = goal.shape[:-1], goal.reshape(-1, goal.shape[-1])
        q = q.reshape(-1, q.shape[-1])
        longest = torch.full_like(self._limit, GOAL_STEP)
        for _ in range(GOAL_STEPS):
            pose, jacobian = self.arm.pose_and_jacobian(q)
            error = self._way(pose, goal)
            rows = self._rows(pose, jacobian, error.shape[-1])
            step = limited_step(dls_step(rows, error, GOAL_DAMPING), longest, 1.0)
            q = torch.clamp(q + step, self.arm.lower, self.arm.upper)
        outside = (self.approach.within_reach(goal) - goal).norm(dim=-1)
        reached = self.is_at(q, goal) & (outside <= GOAL_TOLERANCE)
        return q.view(*batch, -1), reached.view(batch)

    def is_at(self, joint_pos: Tensor, goal: Tensor) -> Tensor:
        """Whether the tool is at ``goal`` (R, 3) [m, world] at joint angles (R, N) [rad]: ``(R,)`` bool.

        That is within `GOAL_TOLERANCE`, and for poses (R, 7) also within `TURN_TOLERANCE`.
        """
        way = self._way(self.arm(joint_pos), goal)
        there = way[..., :3].norm(dim=-1) <= GOAL_TOLERANCE
        return there if self.goal_size == 3 else there & (way[..., 3:].norm(dim=-1) <= TURN_TOLERANCE)

    def _way(self, pose: Tensor, goal: Tensor) -> Tensor:
        """The remaining twist from poses (R, 4, 4) to goals (R, 3 or 7)."""
        return torch.stack(self.approach.twist(pose[..., :3, :].flatten(-2).unbind(-1), goal.unbind(-1)), dim=-1)

    def _rows(self, pose: Tensor, jacobian: Tensor, count: int) -> Tensor:
        """The first ``count`` rows of ``jacobian`` (*B, 6, N), of which a tool that is round may turn as it likes."""
        rows = jacobian if count == 6 else jacobian[..., :count, :]
        if not self._round:
            return rows
        # No joint works against a turn about the tool's own axis.
        axis = pose[..., :3, 2].unsqueeze(-1)
        move, turn = rows[..., :3, :], rows[..., 3:, :]
        return torch.cat([move, turn - axis * (axis * turn).sum(-2, keepdim=True)], dim=-2)

    def step(self, joint_pos: Tensor, goal: Tensor, before: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """One step of the path from ``joint_pos`` (*B, N) [rad] towards ``goal`` (*B, 3) [m, world].

        With an acceleration, ``before`` (*B, 3) is the last step's goal, and the step follows the goal's motion.

        Returns:
            The action ``(*B, N)`` and the joint angles reached on the path ``(*B, N)`` [rad].
        """
        # Looking up a buffer as a module's attribute costs as much as a small operation; its table is cheaper.
        dtype = cast(Tensor, self._buffers["_limit"]).dtype
        if joint_pos.dtype != dtype or goal.dtype != dtype:
            joint_pos, goal = joint_pos.to(dtype), goal.to(dtype)
        if self._fused is not None:
            if joint_pos.ndim == 2:
                return self._step_fused(joint_pos, goal)
            rows = self._step_fused(joint_pos.reshape(-1, joint_pos.shape[-1]), goal.reshape(-1, 3))
            action, reached = (value.reshape(joint_pos.shape) for value in rows)
            return action, reached
        if joint_pos.ndim == 2 and (self.chunk is None or len(joint_pos) <= self.chunk):
            pose, jacobian = self.arm.form.pose_and_jacobian(joint_pos)
        else:
            pose, jacobian = self._pose_and_jacobian(joint_pos)
        if self.acceleration is not None:
            return self._step_braked(joint_pos, goal, goal if before is None else before, pose, jacobian)
        return self._step_from(joint_pos, goal, pose, jacobian)

    def _step_braked(
        self, joint_pos: Tensor, goal: Tensor, before: Tensor, pose: Tensor, jacobian: Tensor
    ) -> tuple[Tensor, Tensor]:
        """`step` with an acceleration limit: braked towards the last goal, plus the goal's motion since then."""
        error, old = self._way(pose, goal), self._way(pose, before.to(goal.dtype))
        moved = error - old
        moves = moved[..., :3].norm(dim=-1, keepdim=True) <= GOAL_SPEED * self.control_step
        along = torch.where(moves, moved, 0.0)
        low, high = self.arm.lower - joint_pos, self.arm.upper - joint_pos
        rows = self._rows(pose, jacobian, error.shape[-1])
        ways = [self._within(dls_step(rows, way, self.damping), rows, way, low, high) for way in (error - along, along)]
        step = limited_step(braked_step(ways[0], self._limit, self._brake) + ways[1], self._limit, 1.0)
        step = torch.clamp(step, low, high)
        return (step / self._limit).clamp(-1.0, 1.0), joint_pos + step

    def _within(self, whole: Tensor, rows: Tensor, error: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """``whole``, or, where it pushes a joint out of its limits, a step by the other joints."""
        pushes = ((low >= 0.0) & (whole < 0.0)) | ((high <= 0.0) & (whole > 0.0))
        return self._without_held(whole, rows, error, low, high) if bool(pushes.any()) else whole

    def _step_from(self, joint_pos: Tensor, goal: Tensor, pose: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
        """`step` for known pose and Jacobian of the tool."""
        error = torch.stack(self.approach.twist(pose.flatten(-2).unbind(-1), goal.unbind(-1)), dim=-1)
        rows = jacobian if error.shape[-1] == 6 else jacobian[..., : error.shape[-1], :]
        if self._round:
            rows = self._rows(pose, jacobian, error.shape[-1])
        limit, bounds = cast(Tensor, self._buffers["_limit"]), cast(dict[str, Tensor], self.arm._buffers)
        low, high = bounds["lower"] - joint_pos, bounds["upper"] - joint_pos
        whole = dls_step(rows, error, self.damping)
        wanted = limited_step(whole, limit, self.gain)
        step = torch.clamp(wanted, low, high)
        # If nothing was clamped, no joint is pushed out of its limits.
        plain = not torch.compiler.is_compiling() and debug_unwrap(step) is step
        if not (plain and torch.equal(step, wanted)):
            whole = self._without_held(whole, rows, error, low, high)
            step = torch.clamp(limited_step(whole, limit, self.gain), low, high)
        return (step / limit).clamp(-1.0, 1.0), joint_pos + step

    def _without_held(self, whole: Tensor, rows: Tensor, error: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """``whole``, a step (*B, N), solved again without the joints at a limit that it would push out."""
        at_lower, at_upper = low >= 0.0, high <= 0.0
        held = torch.zeros_like(at_lower)
        for _ in range(PASSES):
            held = held | (at_lower & (whole < 0.0)) | (at_upper & (whole > 0.0))
            again = dls_step(rows.masked_fill(held.unsqueeze(-2), 0.0), error, self.damping)
            whole = torch.where(held.any(dim=-1, keepdim=True), again, whole)
        return whole

    def _step_fused(self, joint_pos: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """`step` in one compiled loop; rows that push a joint beyond its limits are solved again."""
        assert self._fused is not None
        action, reached, room = self._fused(joint_pos, goal)
        # A single row is read directly: a minimum would take a tenth of the step's time.
        count = room.numel()
        if count and not (room if count == 1 else room.amin()).item() > 0.0:
            rows = (room.squeeze(-1) <= 0.0).nonzero().squeeze(-1)
            joint_pos, goal = joint_pos[rows], goal[rows]
            action[rows], reached[rows] = self._step_from(joint_pos, goal, *evaluate(self.arm, joint_pos))
        return action, reached

    def _fused_step(self, joint_pos: Columns, goal: Columns) -> tuple[Vector, Vector, Vector]:
        """`step` column by column with all joints; and each row's least distance from a joint to the limit ahead [rad].

        A joint for which that is 0 is at its limit, and should have been left out.
        """
        rotation, place, jacobian = self.arm.components(joint_pos)
        pose = [entry for row, end in zip(rotation, place, strict=True) for entry in (*row, end)]
        error = self.approach.twist([filled(entry, joint_pos[0]) for entry in pose], goal)
        columns = [column[: len(error)] for column in jacobian]
        step = [filled(value, goal[0]) for value in damped_least_squares(columns, error, self.damping)]
        limit, lower, upper = (values.tolist() for values in (self._limit, self.arm.lower, self.arm.upper))
        worst = functools.reduce(torch.maximum, [value.abs() / most for value, most in zip(step, limit, strict=True)])
        share = (1.0 / worst.clamp_min(1e-12)).clamp(max=self.gain)
        bounds = zip(joint_pos, lower, upper, strict=True)
        ways = [(low - here, high - here) for here, low, high in bounds]
        pairs = zip(step, ways, strict=True)
        room = functools.reduce(torch.minimum, [torch.where(value < 0.0, -low, high) for value, (low, high) in pairs])
        step = [torch.clamp(value * share, *way) for value, way in zip(step, ways, strict=True)]
        action = [(value / most).clamp(-1.0, 1.0) for value, most in zip(step, limit, strict=True)]
        return action, [here + value for here, value in zip(joint_pos, step, strict=True)], [room]

    def _pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """The arm's pose and Jacobian, in blocks of ``chunk`` rows if ``joint_pos`` is a multiple of them."""
        if self.chunk is None or joint_pos.ndim != 2:
            return self.arm.pose_and_jacobian(joint_pos)
        pose, jacobian = zip(*map(self.arm.pose_and_jacobian, joint_pos.split(self.chunk)), strict=True)
        return torch.cat(pose), torch.cat(jacobian)
