"""N copies of a catch scene stepped on native threads, seen as torch tensors that share the simulation's memory."""

from __future__ import annotations

import torch
from mujoco.batch import Batch
from torch import Tensor

from torchdyn_plan.envs.catch.scene import GRAVITY, CatchScene
from torchdyn_plan.envs.catch.ur10 import UR10_LINKS
from torchdyn_plan.kinematics.flight import braked


class CatchSimulation:
    """Arms and balls of ``num_envs`` scenes. All tensors are float64 on the CPU.

    ``qpos`` (N, nq) holds MuJoCo's generalised positions, from which a scene can be drawn. ``joint_pos`` and
    ``joint_vel`` (N, 6) [rad, rad/s], ``ball_pos`` and ``ball_vel`` (N, 3) [m, m/s, world] are views of the simulation:
    they change with every step, without copies. ``told_speed`` (N, 6) is what the joints' servos were told last, within
    the limits of speed and acceleration [rad/s].
    """

    def __init__(self, num_envs: int, scene: CatchScene, *, drag: float, num_threads: int = 0) -> None:
        """Compile ``scene`` with a ball whose drag is ``drag`` [1/m]; ``num_threads`` 0 means all cores."""
        self.scene, self.num_envs, self.drag = scene, num_envs, drag
        self.model = scene.compile(drag=drag)
        self.batch = Batch(self.model, num_envs, num_threads, True)
        self.substeps = round(scene.control_step / scene.substep)
        bound = {name: torch.from_numpy(self.batch.bind(name)) for name in ("qpos", "qvel", "act", "ctrl")}
        self.qpos, qvel, self._place = bound["qpos"], bound["qvel"], bound["act"]
        count = len(UR10_LINKS)
        self._ctrl = bound["ctrl"].view(num_envs, count, 2)
        self.joint_pos, self.joint_vel = self.qpos[:, :count], qvel[:, :count]
        self.ball_pos, self.ball_vel = self.qpos[:, count : count + 3], qvel[:, count : count + 3]
        self._home = torch.tensor(scene.home, dtype=torch.float64)
        self.told_speed = torch.zeros(num_envs, count, dtype=torch.float64)
        self._fastest, self._quickest, self._low, self._high = torch.tensor(
            [(link.speed, link.acceleration, *link.range) for link in UR10_LINKS], dtype=torch.float64
        ).unbind(-1)

    def reset(self, rows: Tensor, place: Tensor, velocity: Tensor) -> None:
        """Put ``rows`` (M,) back: arms at home, balls at ``place`` (M, 3) [m] with ``velocity`` (M, 3) [m/s]."""
        self.batch.reset(rows.numpy())
        self.joint_pos[rows], self._place[rows], self.told_speed[rows] = self._home, self._home, 0.0
        self._ctrl[rows] = 0.0
        self.ball_pos[rows] = place
        # MuJoCo moves a ball with the velocity of a substep's end: with this one it is on its parabola after each.
        falls = braked(velocity, velocity.new_tensor(GRAVITY), self.drag)
        self.ball_vel[rows] = velocity - 0.5 * self.scene.substep * falls

    def step(self, action: Tensor) -> None:
        """One control step; ``action`` (N, 6) is joint speed over its limit, -1 to 1."""
        wanted = action.to(torch.float64).clamp(-1.0, 1.0) * self._fastest
        # No joint is told a speed that takes it out of its range.
        time = self.scene.control_step
        wanted = wanted.clamp((self._low - self.joint_pos) / time, (self._high - self.joint_pos) / time)
        change = self._quickest * time
        torch.clamp(wanted, self.told_speed - change, self.told_speed + change, out=self.told_speed)
        self._ctrl[:] = self.told_speed.unsqueeze(-1)
        self.batch.step(None, nstep=self.substeps)

    def place_balls(self, place: Tensor) -> None:
        """Put every ball at rest at ``place`` (N, 3) [m]."""
        self.ball_pos[:], self.ball_vel[:] = place, 0.0
