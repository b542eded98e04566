"""Arms driven to goals by a static planner, and nothing else: where arrival times are measured."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapping import is_reached
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm


class ReachingTask:
    """``num_envs`` arms with a goal each; the ball lies parked before the far rail, out of the arms' reach.

    The static planner is any callable from tensordict to tensordict that reads the robot's state and ``goal`` and
    writes ``action``: the task only runs it and looks.
    """

    def __init__(
        self,
        planner: Callable[[TensorDictBase], TensorDictBase],
        num_envs: int,
        *,
        scene: TrapperScene | None = None,
        num_threads: int = 0,
    ) -> None:
        """Build the batch with every arm at home and at rest."""
        self.planner, self.scene = planner, scene or TrapperScene()
        self.simulation = TrapperSimulation(num_envs, self.scene, num_threads=num_threads)
        self._arm = Arm.ur5(tool_length=self.scene.tool_length)
        self._base = torch.tensor(self.scene.base_pos)
        self._memory: TensorDict | None = None
        self.reset()

    def reset(self, joint_pos: Tensor | None = None, joint_vel: Tensor | None = None) -> None:
        """Put every arm home, or at ``joint_pos`` (N, 6) [rad]; all without a memory.

        They are at rest, or move with ``joint_vel`` (N, 6) [rad/s], which needs ``joint_pos``: else an `InputError`.
        """
        if joint_vel is not None and joint_pos is None:
            raise InputError("joint_vel needs joint_pos beside it, got None")
        count = self.simulation.num_envs
        far = torch.tensor([0.0, self.scene.half_side - 2 * self.scene.ball_radius], dtype=torch.float64)
        still = torch.zeros(count, 2, dtype=torch.float64)
        self.simulation.reset(torch.arange(count), far.expand(count, 2), still)
        if joint_pos is not None:
            self.simulation.place_arms(joint_pos, torch.zeros_like(joint_pos) if joint_vel is None else joint_vel)
        self._memory, self._steps = None, torch.zeros(count, dtype=torch.int64)

    @property
    def tool_pos(self) -> Tensor:
        """Centres of the box mouths, ``(N, 3)`` [m, world]."""
        return self._arm(self.simulation.joint_pos.float())[:, :3, 3] + self._base

    @property
    def robot_state(self) -> Tensor:
        """What a policy or an ETA network reads, ``(N, 15)``."""
        joints = (self.simulation.joint_pos.float(), self.simulation.joint_vel.float())
        return torch.cat([*joints, self.tool_pos], dim=-1)

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each arm is at ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""
        return is_reached(self.scene, self.tool_pos, goal)

    def step(self, goal: Tensor) -> None:
        """One control step of every arm towards ``goal`` (N, 3) [m, world]."""
        state = self.robot_state
        entries = {
            keys.JOINT_POS: state[:, :6], keys.JOINT_VEL: state[:, 6:12], keys.TOOL_POS: state[:, 12:],
            keys.ROBOT_STATE: state, keys.OBSERVATION: state, keys.GOAL: goal, keys.STEP_COUNT: self._steps,
        }  # fmt: skip
        if self._memory is not None:
            entries[keys.PLAN] = self._memory
        result = self.planner(TensorDict(entries, batch_size=[len(goal)]))
        self._memory, self._steps = result.get(keys.PLAN, None), self._steps + 1
        self.simulation.step(result[keys.ACTION])
