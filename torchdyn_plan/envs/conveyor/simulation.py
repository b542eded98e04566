"""N copies of a conveyor scene stepped on native threads, seen as torch tensors that share the simulation's memory."""

from __future__ import annotations

import torch
from mujoco.batch import Batch
from torch import Tensor

from torchdyn_plan.envs.conveyor.panda import PANDA_LINKS
from torchdyn_plan.envs.conveyor.scene import ConveyorScene
from torchdyn_plan.envs.servo_arm import ServoArms
from torchdyn_plan.kinematics.quaternions import matrix_quat, quat_multiply

PARKED = (-0.7, 0.25)
"""Where taken and gone parts are put: their x, and their spacing along y [m]."""


class ConveyorSimulation:
    """Arms, belts and parts of ``num_envs`` scenes. All tensors are float64 on the CPU.

    ``qpos`` (N, nq) holds MuJoCo's generalised positions, from which a scene can be drawn. ``joint_pos`` and
    ``joint_vel`` (N, 7) [rad, rad/s], ``part_pos``, ``part_quat`` and ``part_vel`` (N, K, …) [m, wxyz, m/s, world; of
    parts' centres] are views of the simulation: they change with every step, without copies. ``told_speed`` (N, 7) is
    the last command to the joint servos, within the limits of speed and acceleration [rad/s].
    """

    def __init__(self, num_envs: int, scene: ConveyorScene, *, speed: float, parts: int, num_threads: int = 0) -> None:
        """Compile ``scene`` with a belt at ``speed`` [m/s] and ``parts`` parts; ``num_threads`` 0 means all cores."""
        self.scene, self.num_envs, self.parts, self.speed = scene, num_envs, parts, speed
        self.model = scene.compile(speed=speed, parts=parts)
        self.batch = Batch(self.model, num_envs, num_threads, True)
        self.substeps = round(scene.control_step / scene.substep)
        bound = {name: torch.from_numpy(self.batch.bind(name)) for name in ("qpos", "qvel", "act", "ctrl", "eq_active")}
        self.qpos, qvel, count = bound["qpos"], bound["qvel"], len(PANDA_LINKS)
        self._active, self._welds = bound["eq_active"], torch.from_numpy(self.batch.expand("eq_data"))
        self._arms = arms = ServoArms(bound, PANDA_LINKS, home=scene.home, control_step=scene.control_step)
        self.joint_pos, self.joint_vel, self.told_speed = arms.joint_pos, arms.joint_vel, arms.told_speed
        free, moving = self.qpos[:, count:].view(num_envs, parts, 7), qvel[:, count:].view(num_envs, parts, 6)
        self.part_pos, self.part_quat = free[..., :3], free[..., 3:]
        self.part_vel, self._part_spin = moving[..., :3], moving[..., 3:]

    def reset(self, rows: Tensor, place: Tensor, yaw: Tensor) -> None:
        """Put ``rows`` (M,) back: arms at home, parts at ``place`` (M, K, 2) [m], turned by ``yaw`` (M, K) [rad]."""
        self.batch.reset(rows.numpy())
        self._arms.reset(rows)
        self.part_pos[rows, :, :2] = place
        self.part_pos[rows, :, 2] = self.scene.top - 0.5 * self.scene.part_size[2]
        zero = torch.zeros_like(yaw)
        self.part_quat[rows] = torch.stack([(yaw / 2).cos(), zero, zero, (yaw / 2).sin()], dim=-1)
        velocity = torch.zeros(len(rows), self.parts, 3, dtype=torch.float64)
        velocity[..., 1] = self.speed
        self.part_vel[rows], self._part_spin[rows], self._active[rows] = velocity, 0.0, 0.0

    def step(self, action: Tensor) -> None:
        """One control step; ``action`` (N, 7) is joint speed over its limit, -1 to 1."""
        self._arms.command(action)
        self.batch.step(None, nstep=self.substeps)

    def hold(self, held: Tensor, tool_pos: Tensor, tool_rotation: Tensor) -> None:
        """Fix parts ``held`` (N, K), as they are, to tools at ``tool_pos`` (N, 3) and ``tool_rotation`` (N, 3, 3)."""
        if not held.any():
            return
        row, part = held.nonzero(as_tuple=True)
        back = tool_rotation[row].mT.to(torch.float64)
        way = self.part_pos[row, part] - tool_pos[row].to(torch.float64)
        place = (back @ way.unsqueeze(-1)).squeeze(-1)
        quat = quat_multiply(matrix_quat(back), self.part_quat[row, part])
        self._welds[row, part, 0:3] = 0.0
        self._welds[row, part, 3:6], self._welds[row, part, 6:10] = place, quat
        self._active[row, part] = 1.0

    def park(self, parts: Tensor) -> None:
        """Take ``parts`` (N, K) bool off belt and tool, and lay them aside."""
        if not parts.any():
            return
        row, part = parts.nonzero(as_tuple=True)
        self._active[row, part] = 0.0
        x, apart = PARKED
        height = torch.full_like(part, 0, dtype=torch.float64) + 0.5 * self.scene.part_size[2]
        place = torch.stack([torch.full_like(height, x), (part - 1.0) * apart, height], dim=-1).to(torch.float64)
        self.part_pos[row, part] = place
        self.part_quat[row, part] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        self.part_vel[row, part], self._part_spin[row, part] = 0.0, 0.0
