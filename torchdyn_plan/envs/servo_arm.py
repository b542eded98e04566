"""Arms whose joint servos are told speeds: their joints and servos in a MuJoCo model, and N copies of them at work."""

# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

if TYPE_CHECKING:
    import mujoco

ARMATURE = 0.1
"""Inertia of a motor, reflected through its gear [kg·m²]."""


class Limits(Protocol):
    """Limits of a joint."""

    @property
    def range(self) -> tuple[float, float]:
        """Of its position [rad]."""
        ...

    @property
    def speed(self) -> float:
        """Of its speed [rad/s]."""
        ...

    @property
    def acceleration(self) -> float:
        """Of its acceleration [rad/s²]."""
        ...

    @property
    def torque(self) -> float:
        """Of its torque [N·m]."""
        ...


def add_sky(spec: mujoco.MjSpec) -> None:
    """A sky, ambient light, and room for large pictures."""
    import mujoco

    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=256)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, [0.90, 0.92, 0.94], [0.62, 0.66, 0.70]
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    visual.headlight.ambient, visual.headlight.diffuse = [0.4] * 3, [0.35] * 3


def add_hinge(body: mujoco.MjsBody, name: str, limits: Limits) -> None:
    """A joint about the body's z axis, whose motor compensates gravity."""
    import mujoco

    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, 1],
        range=limits.range,
        limited=True,
        armature=ARMATURE,
        actfrclimited=True,
        actfrcrange=[-limits.torque, limits.torque],
        actgravcomp=True,
    )


def add_servos(
    spec: mujoco.MjSpec, joints: Mapping[str, Limits], *, stiffness: Sequence[float], damping: Sequence[float]
) -> None:
    """Two actuators for each joint: a position servo whose target moves at the commanded speed, and a speed servo."""
    import mujoco

    for number, (name, limits) in enumerate(joints.items()):
        place = spec.add_actuator(name=f"place{number + 1}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        place.set_to_intvelocity(kp=stiffness[number])
        place.actrange, place.actlimited = list(limits.range), True
        speed = spec.add_actuator(name=f"speed{number + 1}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        speed.set_to_velocity(kv=damping[number])


class ServoArms:
    """The arms of N simulations, as views of the simulations' memory; float64 on the CPU.

    ``joint_pos`` and ``joint_vel`` (N, J) [rad, rad/s] change with every step, without copies. ``told_speed`` (N, J) is
    the last command to the servos, within the limits of speed and acceleration [rad/s].
    """

    def __init__(
        self, bound: Mapping[str, Tensor], limits: Sequence[Limits], *, home: Sequence[float], control_step: float
    ) -> None:
        """Take the first joints of simulations, and their servos.

        Args:
            bound: ``qpos``, ``qvel``, ``act`` and ``ctrl`` of the simulations, ``(N, …)`` each, with no other servos.
            limits: of the J joints.
            home: where the joints are at the start [rad].
            control_step: for which a command holds [s].
        """
        count = len(limits)
        self.joint_pos, self.joint_vel = bound["qpos"][:, :count], bound["qvel"][:, :count]
        self._place, self._ctrl = bound["act"], bound["ctrl"].view(-1, count, 2)
        self.told_speed = torch.zeros(len(self._place), count, dtype=torch.float64)
        self._home, self._control_step = torch.tensor(home, dtype=torch.float64), control_step
        self._fastest, self._quickest, self._low, self._high = torch.tensor(
            [(joint.speed, joint.acceleration, *joint.range) for joint in limits], dtype=torch.float64
        ).unbind(-1)

    def reset(self, rows: Tensor) -> None:
        """Put the arms ``rows`` (M,) at home, at rest."""
        self.joint_pos[rows], self._place[rows], self.told_speed[rows] = self._home, self._home, 0.0
        self._ctrl[rows] = 0.0

    def command(self, action: Tensor) -> None:
        """Tell the servos joint speeds over their limits, ``action`` (N, J), -1 to 1, for the next control step."""
        wanted = action.to(torch.float64).clamp(-1.0, 1.0) * self._fastest
        # No joint is told a speed that takes it out of its range.
        time = self._control_step
        wanted = wanted.clamp((self._low - self.joint_pos) / time, (self._high - self.joint_pos) / time)
        change = self._quickest * time
        torch.clamp(wanted, self.told_speed - change, self.told_speed + change, out=self.told_speed)
        self._ctrl[:] = self.told_speed.unsqueeze(-1)
