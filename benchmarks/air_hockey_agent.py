"""What the agents of `air_hockey.py` share: how they act and move, whatever they plan."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from study import Row
from tensordict import TensorDict
from torch import Tensor

from torchdyn_plan.kinematics import Arm
from torchdyn_plan.kinematics.mjcf import joints_of_mjcf
from torchdyn_plan.nets import AnalyticArrival, Billiard
from torchdyn_plan.planners import DynamicPlanner, IKPlanner
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.static.approach import StraightToGoal

DRAG, RESTITUTION = 0.497, 0.85
"""Of the puck on the table [1/s], and between rims; measured in the challenge's simulation."""
NOWHERE = 100.0
"""Where nothing can be met [m]."""


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """What was chosen on starts of the series dev."""

    speed: float = 0.85
    """Share of the joints' speed limits that is used; beyond 0.95 is a violation."""
    within: float = 0.9
    """Share of their position limits; beyond 0.95 is a violation."""
    quick: float = 4.0
    """Acceleration of joints, times what the challenge names and does not ask for."""
    slowdown: float = 1.1
    """Arrivals take so much longer than the limits allow."""
    slack_steps: float = 3.0
    """Control steps by which a mallet may come late to a contact that is kept."""


class Agent(ABC):
    """Our planner as the challenge asks it: what is seen in, what the joints are to be and to move at out.

    A speed that changes evenly within each control step never asks for more than the acceleration limit. The joints
    are then half a step behind one that takes on each speed at once, as the planner assumes. So it plans for half a
    step later: there, joints and puck move as it assumes.
    """

    def __init__(self, about: Row, own: Tuning) -> None:
        """Plan for the robot and the table that ``about`` describes."""
        self.about, self.own = about, own
        self.arm = self._arm()
        self.quick = [own.quick * value for value in about["joint_acc"]]
        self.static = self._static()
        self.planner = self.make_planner().eval()
        self.most_change = about["control_step"] * torch.tensor(self.quick)
        self._warm_up()
        self.start()

    @abstractmethod
    def make_planner(self) -> DynamicPlanner:
        """The planner, on ``static``."""

    def start(self) -> None:
        """Begin an episode."""
        self.state = TensorDict(batch_size=[1])
        self.joints: Tensor | None = None
        self.speed = torch.zeros(1, len(self.about["joint_acc"]))
        self.step_number = 0

    def act(self, seen: Row) -> tuple[list[float], list[float]]:
        """Joint positions and speeds at the end of this control step."""
        step, base = self.about["control_step"], self.about["base_x"]
        if self.joints is None:
            self.joints = torch.tensor([seen["joint_pos"]])
        velocity = torch.tensor([[*seen["puck_vel"][:2], 0.0]])
        puck = torch.tensor([[seen["puck_pos"][0] + base, seen["puck_pos"][1], self.about["height"]]])
        puck = puck + 0.5 * step * velocity
        mallet = self.arm(self.joints)[..., :3, 3] + torch.tensor([base, 0.0, 0.0])
        self.state.update(
            {
                "joint_pos": self.joints,
                "tool_pos": mallet,
                "target_pos": puck,
                "target_history": torch.stack([puck - step * velocity, puck], dim=-2),
                "robot_state": torch.cat([self.joints, self.speed], dim=-1),
                "step_count": torch.tensor([self.step_number]),
            }
        )
        self.planner(self.state)
        change = self.state["action"] * self.arm.speed_limit - self.speed
        self.speed = self.speed + change / (change.abs() / self.most_change).amax(-1, keepdim=True).clamp_min(1.0)
        self.joints = self.joints + step * self.speed
        self.step_number += 1
        return (self.joints - 0.5 * step * self.speed)[0].tolist(), self.speed[0].tolist()

    def make_arrival(self) -> AnalyticArrival:
        """When the joints can be at a goal."""
        return AnalyticArrival(
            self.static,
            speed=self.arm.speed_limit,
            acceleration=self.quick,
            control_step=self.about["control_step"],
            slowdown=self.own.slowdown,
            extra_steps=-self.own.slack_steps,
        )

    def make_puck(self, horizon: int) -> Billiard:
        """The forecast of the puck, ``horizon`` control steps."""
        about = self.about
        sides = [side / 2.0 - about["puck_radius"] for side in (about["length"], about["width"])]
        return Billiard(sides, horizon=horizon, control_step=about["control_step"], restitution=RESTITUTION, drag=DRAG)

    def _warm_up(self) -> None:
        """Act a few times on a puck that stands: what is done only once takes no time of an episode."""
        self.start()
        still = {"joint_pos": [0.0] * len(self.about["joint_acc"]), "puck_pos": [0.0, 0.0], "puck_vel": [0.0, 0.0]}
        with torch.no_grad():
            for _ in range(3):
                self.act(still)

    def _arm(self) -> Arm:
        """The robot, with limits a little within those of the challenge."""
        joints = joints_of_mjcf(self.about["file"], base=self.about["base"], tip=self.about["mallet"])
        within = self.own.within
        joints = [replace(joint, lower=within * joint.lower, upper=within * joint.upper) for joint in joints]
        return Arm(joints, speed_limit=[self.own.speed * speed for speed in self.about["joint_vel"]])

    def _static(self) -> IKPlanner:
        """Drives the mallet to a goal."""
        base = (self.about["base_x"], 0.0, 0.0)
        return IKPlanner(
            self.arm,
            approach=StraightToGoal(base_pos=base),
            control_step=self.about["control_step"],
            acceleration=self.quick,
            damping=0.005,
        )


class ContactState(NamedTuple):
    """Where each row's mallet is sent, and what it is about."""

    contact_place: Tensor
    """``(*B, D)`` the goal [m, world]."""
    contact_velocity: Tensor
    """``(*B, D)`` with which it moves [m per control step]."""
    contact_tool: Tensor
    """``(*B, D)`` where the mallet was [m, world]."""
    contact_left: Tensor
    """``(*B,)`` int64 control steps to the contact that it is committed to; -1 for none."""

    @classmethod
    def at_rest(cls, observation: Observation) -> ContactState:
        """A mallet that is at rest and not about anything."""
        tool = observation.tool_pos
        return cls(tool, torch.zeros_like(tool), tool, torch.full_like(observation.step_count, -1))


def swing(
    state: ContactState, tool: Tensor, end: Tensor, end_velocity: Tensor, steps: Tensor, *, swing_steps: int
) -> tuple[Tensor, Tensor]:
    """Goal and velocity (*B, D) of a mallet that is to be at ``end`` with ``end_velocity`` in ``steps`` (*B,).

    It begins ``swing_steps`` before the contact from where the mallet is, and goes on from the last goal.
    """
    fresh = ((state.contact_left <= 0) | (state.contact_left > swing_steps)).unsqueeze(-1)
    came = torch.where(fresh, tool, state.contact_place)
    velocity = torch.where(fresh, tool - state.contact_tool, state.contact_velocity)
    return cubic_step(came, velocity, end, end_velocity, steps)


def cubic_step(
    place: Tensor, velocity: Tensor, end: Tensor, end_velocity: Tensor, steps: Tensor
) -> tuple[Tensor, Tensor]:
    """Place and velocity (*B, D) one step on along the cubic that is at ``end`` after ``steps`` (*B,)."""
    count = steps.to(place.dtype).unsqueeze(-1)
    way = end - place
    bend = (6.0 * way / count - 4.0 * velocity - 2.0 * end_velocity) / count
    jerk = (6.0 * (velocity + end_velocity) - 12.0 * way / count) / count.square()
    return place + velocity + bend / 2.0 + jerk / 6.0, velocity + bend + jerk / 2.0


def at_step(path: Tensor, index: Tensor) -> Tensor:
    """Entry ``index`` (*B,) of ``path`` (*B, F, …), ``(*B, …)``."""
    batch, rest = index.shape, path.shape[index.ndim + 1 :]
    index = index.reshape(*batch, 1, *[1] * len(rest)).expand(*batch, 1, *rest)
    return path.gather(len(batch), index).squeeze(len(batch))
