"""N copies of a Trapper scene stepped on native threads, seen as torch tensors that share the simulation's memory."""

from __future__ import annotations

import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.kinematics.ur5 import UR5_LINKS


class TrapperSimulation:
    """Arms, balls and servos of ``num_envs`` scenes. All tensors are float64 on the CPU.

    ``qpos`` (N, nq) holds MuJoCo's generalised positions, from which a scene can be drawn.
    ``joint_pos``, ``joint_vel`` (N, 6) [rad, rad/s] and ``ball_pos``, ``ball_vel`` (N, 3) [m, m/s, world] are views of
    the simulation: they change with every step, without copies.
    """

    LEASH = 0.06
    """How far a joint's commanded position may run ahead of the joint [rad]."""

    def __init__(
        self, num_envs: int, scene: TrapperScene, *, friction: float = 0.0, num_threads: int = 0, arm: bool = True
    ) -> None:
        """Compile ``scene`` and build the batch; ``num_threads`` 0 means all cores, ``arm`` False the ball alone."""
        self.scene, self.num_envs, self.num_threads = scene, num_envs, num_threads
        self.model = scene.compile(arm=arm, friction=friction)
        self.batch = Batch(self.model, num_envs, num_threads, True)
        self.substeps = round(scene.control_step / scene.substep)
        self.qpos = torch.from_numpy(self.batch.bind("qpos"))
        self._qvel = torch.from_numpy(self.batch.bind("qvel"))
        ball = self.model.joint("ball")
        q, v = int(ball.qposadr[0]), int(ball.dofadr[0])
        self.ball_pos, self._ball_turn = self.qpos[:, q : q + 3], self.qpos[:, q + 3 : q + 7]
        self.ball_vel, self.ball_spin = self._qvel[:, v : v + 3], self._qvel[:, v + 3 : v + 6]
        self.has_arm = arm
        if arm:
            first = self.model.joint(UR5_LINKS[0].joint)
            q, v = int(first.qposadr[0]), int(first.dofadr[0])
            self.joint_pos, self.joint_vel = self.qpos[:, q : q + 6], self._qvel[:, v : v + 6]
            self._ctrl = torch.from_numpy(self.batch.bind("ctrl"))
            self._home = torch.tensor(scene.home, dtype=torch.float64)
            self._command, self._speed = self._home.repeat(num_envs, 1), torch.zeros_like(self.joint_pos)
            # force = k(u - q) - d·v with u = command + (d/k)·speed: position and speed are both fed forward.
            lead = np.array(scene.servo_damping) / np.array(scene.servo_stiffness)
            self._lead = torch.from_numpy(lead)
            self._range = torch.tensor([link.range for link in UR5_LINKS], dtype=torch.float64).unbind(-1)

    def reset(self, rows: Tensor, ball_pos: Tensor, ball_vel: Tensor) -> None:
        """Put ``rows`` (M,) back: arm at home and at rest, balls at ``ball_pos`` rolling with ``ball_vel`` (M, 2)."""
        self.batch.reset(rows.numpy())
        radius = self.scene.ball_radius
        self.ball_pos[rows, :2], self.ball_pos[rows, 2] = ball_pos, radius
        self._ball_turn[rows] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        self.ball_vel[rows, :2] = ball_vel
        self.ball_spin[rows] = torch.stack([-ball_vel[:, 1], ball_vel[:, 0], torch.zeros(len(rows))], -1) / radius
        if self.has_arm:
            self.joint_pos[rows] = self._home
            self._command[rows], self._speed[rows] = self._home, 0.0
            self._ctrl[rows] = self._home

    def place_arms(self, joint_pos: Tensor, joint_vel: Tensor) -> None:
        """Put every arm at ``joint_pos`` (N, 6) [rad], moving with ``joint_vel`` (N, 6) [rad/s] as if so commanded."""
        self.joint_pos[:], self.joint_vel[:] = joint_pos, joint_vel
        self._command[:], self._speed[:] = joint_pos, joint_vel

    def hold(self, other: TrapperSimulation, rows: Tensor) -> None:
        """Take over ``rows`` (M,) of another simulation of the same scene, with arms that stand still from now on."""
        self.qpos[rows], self._qvel[rows] = other.qpos[rows], other._qvel[rows]
        self.joint_vel[rows] = 0.0
        self._command[rows], self._speed[rows] = self.joint_pos[rows], 0.0
        self._ctrl[rows] = self.joint_pos[rows]

    def step(self, action: Tensor | None = None, rows: Tensor | None = None) -> None:
        """One control step of ``rows`` (all by default); ``action`` (N, 6) is joint speed over its limit, -1 to 1."""
        if action is not None:
            self._drive(action)
        self.batch.step(None if rows is None else rows.numpy(), nstep=self.substeps)

    def _drive(self, action: Tensor) -> None:
        fastest = self.scene.servo_speed * self.scene.joint_speed
        wanted = (action.to(torch.float64) * self.scene.joint_speed).clamp(-fastest, fastest)
        change = self.scene.acceleration_limit * self.scene.control_step
        speed = torch.clamp(wanted, self._speed - change, self._speed + change, out=self._speed)
        position = self.joint_pos
        self._command += speed * self.scene.control_step
        self._command.clamp_(position - self.LEASH, position + self.LEASH)
        self._command.clamp_(*self._range)
        # The speed that the servo strives for, speed + (k/d)·(command - position), never exceeds the fastest.
        ahead = self._lead * fastest
        torch.clamp(self._command + self._lead * speed, position - ahead, position + ahead, out=self._ctrl)
