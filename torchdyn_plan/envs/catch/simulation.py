"""N copies of a catch scene stepped on native threads, seen as torch tensors that share the simulation's memory."""

from __future__ import annotations

import torch
from mujoco.batch import Batch
from torch import Tensor

from torchdyn_plan.envs.catch.scene import GRAVITY, CatchScene
from torchdyn_plan.envs.catch.ur10 import UR10_LINKS
from torchdyn_plan.envs.servo_arm import ServoArms
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
        self.qpos, qvel, count = bound["qpos"], bound["qvel"], len(UR10_LINKS)
        self._arms = arms = ServoArms(bound, UR10_LINKS, home=scene.home, control_step=scene.control_step)
        self.joint_pos, self.joint_vel, self.told_speed = arms.joint_pos, arms.joint_vel, arms.told_speed
        self.ball_pos, self.ball_vel = self.qpos[:, count : count + 3], qvel[:, count : count + 3]

    def reset(self, rows: Tensor, place: Tensor, velocity: Tensor) -> None:
        """Put ``rows`` (M,) back: arms at home, balls at ``place`` (M, 3) [m] with ``velocity`` (M, 3) [m/s]."""
        self.batch.reset(rows.numpy())
        self._arms.reset(rows)
        self.ball_pos[rows] = place
        # MuJoCo moves a ball with the velocity of a substep's end: with this one it is on its parabola after each.
        falls = braked(velocity, velocity.new_tensor(GRAVITY), self.drag)
        self.ball_vel[rows] = velocity - 0.5 * self.scene.substep * falls

    def step(self, action: Tensor) -> None:
        """One control step; ``action`` (N, 6) is joint speed over its limit, -1 to 1."""
        self._arms.command(action)
        self.batch.step(None, nstep=self.substeps)

    def place_balls(self, place: Tensor) -> None:
        """Put every ball at rest at ``place`` (N, 3) [m]."""
        self.ball_pos[:], self.ball_vel[:] = place, 0.0
