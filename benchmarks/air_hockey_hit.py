"""The agent of `air_hockey.py` that hits: it strikes a puck so that it goes into the other goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from air_hockey_agent import NOWHERE, Agent, ContactState, Tuning, at_step, swing
from study import Row
from torch import Tensor

from torchdyn_plan.kinematics import dls_step
from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, IKPlanner, MetWithin, ReplanSchedule
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan

AWAY = 0.6
"""A puck that is this fast along the table is on its way [m/s]; at the start none is."""


LATER = 1e3
"""More than any share of a speed limit: by so much a way counts as worse for each aim before its own."""


@dataclass(frozen=True, kw_only=True)
class HitTuning(Tuning):
    """What was chosen for a strike."""

    slack_steps: float = 0.0
    """Control steps by which a mallet may come late to a contact that is kept."""
    restitution: float = 0.4
    """Between mallet and puck."""
    speeds: tuple[float, ...] = (2.0, 1.85, 1.7, 1.55, 1.4, 1.25, 1.1)
    """At which the puck may leave the mallet [m/s]; the first that the joints allow is taken."""
    aims: tuple[float, ...] = (0.0, 0.04, -0.04)
    """Where the puck may cross the goal line [m, from its middle]; the first that is possible is taken."""
    hang: float = 0.0
    """The mallet hangs back by so much, towards the arm's base, when it strikes [m]."""
    reserve: float = 1.0
    """Share of the joints' speeds (of `Tuning.speed`) that a strike may ask for."""
    commit_steps: int = 15
    """As of `Strike`."""
    swing_steps: int = 9
    """As of `Shots`."""
    low: tuple[float, float] = (-0.91, -0.466)
    """Least coordinates of the mallet [m, world]."""
    high: tuple[float, float] = (-0.15, 0.466)
    """Greatest coordinates."""


TUNED = {3: HitTuning(), 7: HitTuning(hang=0.003)}
"""For an arm of so many joints. The iiwa's mallet hangs on a joint that it moves freely on, the other's is fixed."""


class Ways(NamedTuple):
    """C ways to strike a puck at each of K places."""

    place: Tensor
    """``(*B, K, C, D)`` of the mallet's joint at contact [m, world]."""
    velocity: Tensor
    """``(*B, K, C, D)`` of the mallet then [m per control step]."""
    begin: Tensor
    """``(*B, K, C, D)`` where it begins to speed up, evenly [m, world]."""
    possible: Tensor
    """``(*B, K, C)`` bool: contact and beginning are within the mallet's part of the table."""


def strike(velocity: Tensor, leaves: Tensor, restitution: float) -> tuple[Tensor, Tensor]:
    """How a mallet makes a puck leave at a velocity.

    A mallet that comes with velocity w along the normal n, as seen from the puck, gives it v' = v + (1 + e)(w - v). So
    n has the direction of v' - v, and w = v + (v' - v) / (1 + e). Sideways the mallet moves as the puck does: it does
    not rub, and does not slip while the soft contact lasts.

    Args:
        velocity: ``(*B, D)`` v of the puck before [m/s].
        leaves: ``(*B, D)`` v' after [m/s].
        restitution: e.

    Returns:
        n from mallet to puck, and w [m/s], both ``(*B, D)``.
    """
    change = leaves - velocity
    return torch.nn.functional.normalize(change, dim=-1), velocity + change / (1.0 + restitution)


@dataclass(frozen=True, kw_only=True)
class Shots:
    """Straight shots of a puck into the goal: all aims at all speeds, the best first."""

    aims: Sequence[float]
    """Where the puck crosses the goal line [m, from its middle], the best first."""
    speeds: Sequence[float]
    """At which it leaves the mallet [m/s], the best first."""
    goal_x: float
    """Of the goal line; the own one is at its negative [m, world]."""
    goal_half: float
    """Half of a goal's width [m]."""
    radii: tuple[float, float]
    """Of mallet and puck [m]."""
    restitution: float
    """Between them."""
    hang: float
    """The mallet's centre is so much nearer to the arm's base than its joint [m]."""
    base_x: float
    """Of the arm's base [m, world]."""
    swing_steps: int
    """Control steps in which the mallet takes on its speed."""
    control_step: float
    """[s]"""
    low: tuple[float, float]
    """Least coordinates of the mallet [m, world]."""
    high: tuple[float, float]
    """Greatest coordinates."""

    def ways(self, puck: Tensor, velocity: Tensor) -> Ways:
        """Of a puck at ``puck`` (*B, K, 3) [m, world] with ``velocity`` (*B, K, 3) [m/s]."""
        puck, velocity = puck.unsqueeze(-2), velocity.unsqueeze(-2)
        aims = puck.new_tensor([[self.goal_x, aim, 0.0] for aim in self.aims for _ in self.speeds])
        speeds = puck.new_tensor([[speed] for _ in self.aims for speed in self.speeds])
        normal, comes = strike(velocity, speeds * level_direction(aims - puck), self.restitution)
        place = puck - sum(self.radii) * normal
        place = place + self.hang * level_direction(place - place.new_tensor([self.base_x, 0.0, 0.0]))
        step = self.control_step * comes
        begin = place - 0.5 * self.swing_steps * step
        return Ways(place, step, begin, self._inside(place) & self._inside(begin))

    def scored(self, path: Tensor) -> Tensor:
        """Where on its ``path`` (*B, F, D) the puck is lost in the own goal, ``(*B, F)`` bool."""
        # It turns at the forecast's rim, which has no gap there; a control step before it is a centimetre away.
        at_rim = path[..., 0] < self.radii[1] - self.goal_x + 0.01
        return (at_rim & (path[..., 1].abs() < self.goal_half)).cummax(-1).values

    def _inside(self, place: Tensor) -> Tensor:
        level = place[..., :2]
        return ((level >= level.new_tensor(self.low)) & (level <= level.new_tensor(self.high))).all(-1)


def level_direction(way: Tensor) -> Tensor:
    """Direction of ``way`` (*B, 3) along the table."""
    return torch.nn.functional.normalize(torch.cat([way[..., :2], torch.zeros_like(way[..., 2:])], dim=-1), dim=-1)


class Behind(ForecastModel):
    """Forecasts where a mallet begins its run-up to shoot a puck into the goal.

    Where no shot is possible, there is no such place: it is put out of the world's reach. A worse aim is taken only
    where no better one is possible at any time of the forecast.
    """

    def __init__(self, puck: ForecastModel, shots: Shots) -> None:
        """Take the first possible of ``shots`` of what ``puck`` forecasts."""
        super().__init__()
        self.puck, self.shots = puck, shots
        self.in_keys = puck.in_keys

    def predict(self, *seen: Tensor) -> Forecast:
        """Where the run-up to a contact at each step begins (*B, F, 3)."""
        path, velocity = self.motion(*seen)
        ways = self.shots.ways(path, velocity)
        by_aim = (ways.possible & ~self.shots.scored(path).unsqueeze(-1)).unflatten(-1, (len(self.shots.aims), -1))
        ever = by_aim.any(-1).any(-2).long()
        first = (ever == 1) & (ever.cumsum(-1) == 1)
        possible = (by_aim & first[..., None, :, None]).flatten(-2)
        best = possible.long().argmax(-1, keepdim=True)
        begin = torch.take_along_dim(ways.begin, best.unsqueeze(-1), dim=-2).squeeze(-2)
        return Forecast(torch.where(possible.any(-1, keepdim=True), begin, NOWHERE))

    def motion(self, *seen: Tensor) -> tuple[Tensor, Tensor]:
        """The puck's path [m, world] and velocity [m/s], both ``(*B, F, 3)``."""
        path = self.puck.predict(*seen).path
        before = torch.cat([seen[0][..., -1:, :], path[..., :-1, :]], dim=-2)
        return path, (path - before) / self.shots.control_step


class StrikeState(NamedTuple):
    """As of `ContactState`, and the way that was chosen."""

    contact_place: Tensor
    contact_velocity: Tensor
    contact_tool: Tensor
    contact_left: Tensor
    contact_way: Tensor
    """``(*B,)`` int64 which of the `Ways`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Strike:
    """Waits where the run-up begins, strikes the puck with the velocity that the shot needs, and stops.

    Of the ways at the planned contact the first is taken for which the joints are quick enough. The mallet keeps its
    velocity in the control step of the contact. While it waits, it gives way sideways to a puck that comes past.
    """

    behind: Behind
    """The shots, and the puck's motion."""
    static: IKPlanner
    """Whose joints strike."""
    reserve: float
    """Share of their speed limits that they may take."""
    commit_steps: int
    """A contact that is so many control steps away is kept: where it is follows the forecast, when it is does not."""
    stop_steps: int = 8
    """Control steps in which it stops after the contact, before it may strike again."""
    clearance: float = 0.03
    """Between mallet and puck while it waits [m]."""

    State: ClassVar[type[StrikeState]] = StrikeState

    @property
    def lookahead(self) -> int:
        """None of the path: the puck's motion says more."""
        return 0

    def start(self, observation: Observation) -> StrikeState:
        """At rest where the mallet is."""
        rest = ContactState.at_rest(observation)
        ready = torch.full_like(rest.contact_left, -self.stop_steps)
        return StrikeState(*rest[:3], ready, torch.zeros_like(ready))

    def __call__(
        self, plan: Plan, observation: Observation, holds: Tensor, state: StrikeState
    ) -> tuple[Tensor, StrikeState]:
        """The goal: where it waits, on its swing, or where it stops."""
        shots, tool = self.behind.shots, observation.tool_pos
        path, velocity = self.behind.motion(*observation.seen)
        away = velocity[..., 0, 0] > AWAY
        acts = ~holds & ~away & ((plan.goal - tool).abs().amax(-1) < 0.5 * NOWHERE)
        left = (state.contact_left - 1).clamp_min(-self.stop_steps).masked_fill(away & (state.contact_left > 0), 0)
        ready = left == -self.stop_steps
        begins = ready & acts & plan.reachable & (plan.arrival_steps <= self.commit_steps)
        left = torch.where(begins, plan.arrival_steps, left)
        steps = left.clamp_min(1)
        ways = shots.ways(*(at_step(values, steps - 1).unsqueeze(-2) for values in (path, velocity)))
        ways = Ways(*(at_step(values, torch.zeros_like(steps)) for values in ways))
        way = torch.where(begins, self._choose(observation, ways), state.contact_way) if begins.any() else state[-1]
        end, end_velocity, begin = (at_step(values, way) for values in ways[:3])
        swings = ((left > 0) & (left <= shots.swing_steps)).unsqueeze(-1)
        swung, swing_velocity = swing(
            ContactState(*state[:4]), tool, end, end_velocity, steps, swing_steps=shots.swing_steps
        )
        waits = self._aside(torch.where((left > 0).unsqueeze(-1), begin, plan.goal), path, tool)
        follows = state.contact_velocity * torch.where(left == 0, 1.0, 1.0 - 1.0 / self.stop_steps).unsqueeze(-1)
        stops = ((left <= 0) & ~(ready & acts)).unsqueeze(-1)
        place = torch.where(swings, swung, torch.where(stops, state.contact_place + follows, waits))
        speed = torch.where(swings, swing_velocity, torch.where(stops, follows, 0.0))
        level = torch.clamp(place[..., :2], place.new_tensor(shots.low), place.new_tensor(shots.high))
        place = torch.cat([level, place[..., 2:]], dim=-1)
        return place, StrikeState(place, speed, tool, left, way)

    def _choose(self, observation: Observation, ways: Ways) -> Tensor:
        """The first way ``(*B,)`` of C that the joints can go, else the slowest of the first possible aim."""
        static = self.static
        joints = observation.robot_state[..., None, : static.arm.num_joints]
        there, reached = static.goal_joints(joints, ways.place)
        _, jacobian = static.arm.pose_and_jacobian(there)
        step = dls_step(jacobian[..., :3, :], ways.velocity, static.damping)
        share = (step.abs() / (static.arm.speed_limit * static.control_step)).amax(-1)
        able = ways.possible & reached & (share <= self.reserve)
        aim = torch.arange(share.shape[-1], device=share.device) // len(self.behind.shots.speeds)
        slowest = (share + LATER * aim).masked_fill(~ways.possible, torch.inf).argmin(-1)
        return torch.where(able.any(-1), able.long().argmax(-1), slowest)

    def _aside(self, place: Tensor, path: Tensor, tool: Tensor) -> Tensor:
        """``place`` (*B, 3), moved along y out of the way of a puck that comes past on its ``path`` (*B, F, 3).

        It stays on the side of the puck on which the mallet is, at ``tool`` (*B, 3).
        """
        soon = path[..., : self.commit_steps, :]
        way = place.unsqueeze(-2)[..., :2] - soon[..., :2]
        nearest = way.norm(dim=-1).argmin(-1)
        along, across = at_step(way, nearest).unbind(-1)
        apart = sum(self.behind.shots.radii) + self.clearance
        room = (apart**2 - along.square()).clamp_min(0.0).sqrt()
        side = torch.where(tool[..., 1] < at_step(soon, nearest)[..., 1], -1.0, 1.0)
        moved = (room - side * across).clamp_min(0.0) * side
        return torch.stack([place[..., 0], place[..., 1] + moved, place[..., 2]], dim=-1)


class Hitter(Agent):
    """Shoots pucks into the other goal."""

    own: HitTuning

    def __init__(self, about: Row, own: HitTuning | None = None) -> None:
        """Plan for the robot and the table that ``about`` describes; by default as `TUNED`."""
        super().__init__(about, own or TUNED[len(about["joint_acc"])])

    def make_planner(self) -> DynamicPlanner:
        """Meets the puck from behind, with a velocity."""
        about, own = self.about, self.own
        shots = Shots(
            aims=own.aims,
            speeds=own.speeds,
            goal_x=0.5 * about["length"],
            goal_half=0.5 * about["goal_width"],
            radii=(about["mallet_radius"], about["puck_radius"]),
            restitution=own.restitution,
            hang=own.hang,
            base_x=about["base_x"],
            swing_steps=own.swing_steps,
            control_step=about["control_step"],
            low=own.low,
            high=own.high,
        )
        behind = Behind(self.make_puck(horizon=100), shots)
        return DynamicPlanner(
            self.static,
            behind,
            self.make_arrival(),
            search=ExactSearch(
                stride=1, first=1, switching_cost=1.0, margin=own.slack_steps, descent_steps=own.swing_steps
            ),
            schedule=ReplanSchedule.every(1, first_step=0),
            maneuver=Strike(behind=behind, static=self.static, reserve=own.reserve, commit_steps=own.commit_steps),
            lost=MetWithin(low=(*own.low, -1.0), high=(*own.high, 1.0)),
        )
