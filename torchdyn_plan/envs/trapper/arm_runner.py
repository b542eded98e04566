"""UR5s driven to goals by a static planner, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.arm_runner import ArmRunner
from torchdyn_plan.envs.trapper.contact import is_reached
from torchdyn_plan.envs.trapper.scene import TrapperScene, trapper_scene
from torchdyn_plan.envs.trapper.simulation import TrapperSimulation
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.arm import Arm


class TrapperArmRunner(ArmRunner):
    """``num_envs`` arms with a goal each; the ball lies parked before the far rail, out of the arms' reach."""

    def __init__(
        self,
        planner: Callable[[TensorDictBase], TensorDictBase],
        num_envs: int,
        *,
        scene: TrapperScene | None = None,
        num_threads: int = 0,
    ) -> None:
        """Build the batch with every arm at home and at rest; ``num_threads`` 0 means all cores."""
        super().__init__(planner, num_envs)
        self.scene = trapper_scene(scene)
        self.simulation = TrapperSimulation(num_envs, self.scene, num_threads=num_threads)
        self._arm = Arm.ur5(tool_length=self.scene.tool_length)
        self._base = torch.tensor(self.scene.base_pos)
        self.reset()

    def _put_at_start(self) -> None:
        far = torch.tensor([0.0, self.scene.half_side - 2 * self.scene.ball_radius], dtype=torch.float64)
        still = torch.zeros(self.num_envs, 2, dtype=torch.float64)
        self.simulation.reset(torch.arange(self.num_envs), far.expand(self.num_envs, 2), still)

    def reset(self, joint_pos: Tensor | None = None, joint_vel: Tensor | None = None) -> None:
        """Put every arm home, or at ``joint_pos`` (N, 6) [rad]; all without a memory.

        They are at rest, or move with ``joint_vel`` (N, 6) [rad/s], which needs ``joint_pos``: else an `InputError`.
        """
        if joint_vel is not None and joint_pos is None:
            raise InputError("joint_vel needs joint_pos beside it, got None")
        super().reset()
        if joint_pos is not None:
            self.simulation.place_arms(joint_pos, torch.zeros_like(joint_pos) if joint_vel is None else joint_vel)

    @property
    def tool_pos(self) -> Tensor:
        """Centres of the box mouths, ``(N, 3)`` [m, world]."""
        return self._arm(self.simulation.joint_pos.float())[:, :3, 3] + self._base

    @property
    def robot_state(self) -> Tensor:
        """What a policy or an ETA network reads, ``(N, 15)``."""
        joints = (self.simulation.joint_pos.float(), self.simulation.joint_vel.float())
        return torch.cat([*joints, self.tool_pos], dim=-1)

    def _observed(self) -> dict[str, Tensor]:
        state = self.robot_state
        return {
            keys.JOINT_POS: state[:, :6],
            keys.JOINT_VEL: state[:, 6:12],
            keys.TOOL_POS: state[:, 12:],
            keys.ROBOT_STATE: state,
            keys.OBSERVATION: state,
        }

    def _drive(self, action: Tensor) -> None:
        self.simulation.step(action)

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each arm is at ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""
        return is_reached(self.scene, self.tool_pos, goal)
