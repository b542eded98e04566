"""The agent of `air_hockey.py` that defends: it meets a puck so softly that no speed is left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from air_hockey_agent import DRAG, NOWHERE, Agent, ContactState, Tuning, at_step, swing
from study import Row
from torch import Tensor

from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, MetWithin, ReplanSchedule
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan

ZONE = -0.8, -0.2
"""A puck that is at rest between these is defended [m, along the table from its middle]."""


@dataclass(frozen=True, kw_only=True)
class DefendTuning(Tuning):
    """What was chosen for a soft contact."""

    share: float = 0.33
    """Share of the puck's speed with which the mallet gives way."""
    commit_steps: int = 15
    """As of `SoftContact`."""
    swing_steps: int = 6
    """As of `SoftContact`."""
    front: float = -0.35
    """The mallet goes no farther to meet a puck [m, along the table from its middle]."""


class Ahead(ForecastModel):
    """Forecasts where a mallet is in the way of a puck: a distance ahead of it, along its path.

    Where the puck does not come nearer to the own goal, there is no such place: it is put out of the world's reach.
    """

    def __init__(self, puck: ForecastModel, distance: float) -> None:
        """Be ``distance`` [m] ahead of what ``puck`` forecasts."""
        super().__init__()
        self.puck, self.distance = puck, distance
        self.in_keys = puck.in_keys

    def predict(self, *seen: Tensor) -> Forecast:
        """The puck's path (*B, F, 3), shifted along its tangents."""
        path = self.puck.predict(*seen).path
        before = torch.cat([seen[0][..., -1:, :], path[..., :-1, :]], dim=-2)
        moves = path - before
        returns = (moves[..., :1] >= 0.0).cummax(-2).values
        return Forecast(
            torch.where(returns, NOWHERE, path + self.distance * torch.nn.functional.normalize(moves, dim=-1))
        )


@dataclass(frozen=True, kw_only=True)
class SoftContact:
    """Waits in the puck's way, and gives way with a share of its speed when they touch.

    Of a puck with speed v that meets a mallet that gives way with w, the speed (1 + e) w - e v is left: none of it for
    w = e v / (1 + e). The last ``swing_steps`` before the contact the goal moves by the cubic from where the mallet is
    to the contact, with both velocities. A puck that comes to rest in the zone by itself is left alone.
    """

    share: float
    """Share w / v of the puck's speed at contact."""
    commit_steps: int
    """A contact that is so many control steps away is kept: where it is follows the forecast, when it is does not."""
    swing_steps: int
    """Control steps in which the mallet takes on its speed."""
    stop_steps: int = 8
    """In which it stops after the contact."""
    horizon: int = 100
    """Control steps of the forecast."""
    zone: tuple[float, float] = (ZONE[0] + 0.03, ZONE[1] - 0.03)
    """A puck that will rest between these is left alone [m, along x]."""
    control_step: float = 0.02
    """[s]"""
    low: tuple[float, ...] = (-0.91, -0.46)
    """Least coordinates of the mallet [m, world]."""
    high: tuple[float, ...] = (-0.15, 0.46)
    """Greatest coordinates."""

    State: ClassVar[type[ContactState]] = ContactState

    @property
    def lookahead(self) -> int:
        """The whole forecast, to read the velocity at the contact."""
        return self.horizon + 1

    @property
    def early_steps(self) -> int:
        """The mallet waits where it would be met so many control steps before the contact: room to take on speed."""
        return round(0.5 * self.share * self.swing_steps)

    def start(self, observation: Observation) -> ContactState:
        """At rest where the mallet is."""
        return ContactState.at_rest(observation)

    def __call__(
        self, plan: Plan, observation: Observation, holds: Tensor, state: ContactState
    ) -> tuple[Tensor, ContactState]:
        """The goal: where it waits, on its swing, or where it stops."""
        path, tool = plan.ahead(self.lookahead), observation.tool_pos
        acts = self._threatens(observation) & ~holds
        left = (state.contact_left - 1).clamp_min(-1)
        left = torch.where((left < 0) & acts & (plan.arrival_steps <= self.commit_steps), plan.arrival_steps, left)
        steps = left.clamp(1, self.horizon - 1)
        end, after = at_step(path, steps), at_step(path, steps + 1)
        gone = (end - tool).abs().amax(-1) > 0.5 * NOWHERE
        left, acts = left.masked_fill(gone, -1), acts & ~(gone & (left > 0))
        yields = self.share * (after - end)
        swings = ((left > 0) & (left <= self.swing_steps)).unsqueeze(-1)
        swung, swing_velocity = swing(state, tool, end, yields, steps, swing_steps=self.swing_steps)
        waits = torch.where((left > 0).unsqueeze(-1), end - 0.5 * self.swing_steps * yields, plan.goal)
        slower = state.contact_velocity * (1.0 - 1.0 / self.stop_steps)
        stops = ((left == 0) | ((left < 0) & ~acts)).unsqueeze(-1)
        place = torch.where(swings, swung, torch.where(stops, state.contact_place + slower, waits))
        velocity = torch.where(swings, swing_velocity, torch.where(stops, slower, 0.0))
        level = torch.clamp(place[..., :2], place.new_tensor(self.low), place.new_tensor(self.high))
        place = torch.cat([level, place[..., 2:]], dim=-1)
        return place, ContactState(place, velocity, tool, left)

    def _threatens(self, observation: Observation) -> Tensor:
        """Whether the puck leaves the zone towards the own goal if nobody touches it, ``(*B,)``."""
        history = observation.seen[0][..., 0]
        rest = history[..., -1] + (history[..., -1] - history[..., -2]) / (self.control_step * DRAG)
        return rest < self.zone[0]


class Defender(Agent):
    """Brings pucks to rest in front of the own goal."""

    own: DefendTuning

    def __init__(self, about: Row, own: DefendTuning = DefendTuning()) -> None:
        """Plan for the robot and the table that ``about`` describes."""
        super().__init__(about, own)

    def make_planner(self) -> DynamicPlanner:
        """Meets the puck ahead of its path, and gives way."""
        about = self.about
        maneuver = SoftContact(
            share=self.own.share,
            commit_steps=self.own.commit_steps,
            swing_steps=self.own.swing_steps,
            control_step=about["control_step"],
        )
        return DynamicPlanner(
            self.static,
            Ahead(self.make_puck(maneuver.horizon), about["puck_radius"] + about["mallet_radius"]),
            self.make_arrival(),
            search=ExactSearch(
                stride=1,
                first=1,
                switching_cost=1.0,
                margin=self.own.slack_steps,
                early_steps=maneuver.early_steps,
                descent_steps=maneuver.swing_steps,
            ),
            schedule=ReplanSchedule.every(1, first_step=0),
            maneuver=maneuver,
            lost=MetWithin(low=(-0.86, -0.49, -1.0), high=(self.own.front, 0.49, 1.0)),
        )
