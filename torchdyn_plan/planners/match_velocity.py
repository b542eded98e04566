"""A maneuver that reaches a moving target at the target's own velocity, so that contact is smooth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number, check_vector
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.planners.search.exact import ExactSearch


class MatchPhase(IntEnum):
    """Phases of `MatchVelocity`, see `MatchVelocity.phase`."""

    HOVER = 0
    """Waiting above the meeting place, or on the way there."""
    DOWN = 1
    """Matching the target's velocity and descending."""
    HOLD = 2
    """On the target and moving with it: the time for a gripper to close."""
    LIFT = 3
    """Rising, coming to rest, and staying there until the row restarts."""


class MatchState(NamedTuple):
    """Progress of each row."""

    match_step: Tensor
    """``(*B,)`` int64 control steps since the descent began, -1 before."""
    match_from: Tensor
    """``(*B, D)`` where the descent, or the lift, began [m, world]."""
    match_velocity: Tensor
    """``(*B, D)`` velocity at the start of the lift [m per control step]."""


@dataclass(frozen=True, kw_only=True)
class MatchVelocity:
    """Hovers above the meeting place, descends while matching the target's velocity, holds, and lifts.

    ``descent_steps`` = n steps before the meeting, the goal starts to blend from the tool's position x_0 into the
    target's path p:

        x(k) = x_0 + w(k) (p(k) - x_0),  w(k) = 10 s³ - 15 s⁴ + 6 s⁵,

    where s along the ``axis`` differs from s across it, so that the tool flies along with the target before it
    descends. As w = 1 with zero derivatives at the end, x(n) = p(n) and x'(n) = p'(n). The goal then follows the path
    for ``hold_steps``, and rises while it slows down. The static planner is commanded through the goal only.

    The plan's goal is the hover position and its arrival time the time of contact; ``search`` makes a search for such
    plans. ``phase`` maps ``plan.match_step`` to a `MatchPhase`: a gripper closes in `MatchPhase.HOLD`.
    """

    hover: float
    """Hover distance from the target along the axis, used by ``search`` [m]."""
    descent_steps: int
    """Control steps from the start of the descent to contact."""
    hold_steps: int = 0
    """Control steps spent on the target."""
    lift: float | None = None
    """How far it then rises along the axis; ``hover`` for None [m]."""
    lift_steps: int | None = None
    """Control steps of the lift, until it is at rest; ``descent_steps`` for None."""
    early_steps: int = 0
    """The hover position is above the target's position this many control steps before contact, used by ``search``:
    half of the steps in which the tool matches velocity keep it from moving back and forth."""
    lead_steps: int = 1
    """Control steps by which the tool lags behind a moving goal; goals lead by as much."""
    along_by: float = 0.7
    """Share of the descent after which the velocities across the axis match."""
    down_after: float = 0.4
    """Share of the descent after which the motion along the axis starts."""
    within: float = math.inf
    """A tool farther than this from the target at contact has missed, and hovers again [m]."""
    axis: tuple[float, ...] | None = None
    """Direction from the target to the hover position, of any length; None for up, along the last coordinate."""

    State: ClassVar[type[MatchState]] = MatchState

    def __post_init__(self) -> None:
        check_number("hover", self.hover, minimum=0.0)
        check_number("descent_steps", self.descent_steps, minimum=1, integer=True)
        for name in ("hold_steps", "early_steps", "lead_steps"):
            check_number(name, getattr(self, name), minimum=0, integer=True)
        if self.lift is not None:
            check_number("lift", self.lift, minimum=0.0)
        if self.lift_steps is not None:
            check_number("lift_steps", self.lift_steps, minimum=1, integer=True)
        check_number("along_by", self.along_by, minimum=1e-3, maximum=1.0)
        check_number("down_after", self.down_after, minimum=0.0, maximum=0.999)
        if not self.within > 0.0:
            raise InputError(f"within must be positive, got {self.within!r}")
        if self.axis is not None:
            object.__setattr__(self, "axis", check_vector("axis", self.axis))
            if not any(self.axis):
                raise InputError(f"axis must be a direction, got {self.axis!r}")

    @property
    def lookahead(self) -> int:
        """Number of positions it reads from the target's path: the goal's, and the next one."""
        return self.lead_steps + 2

    def search(self, *, coordinates: int = 3, **settings: Any) -> ExactSearch:
        """A search for the earliest meeting that leaves the tool time to hover and descend.

        Args:
            coordinates: D, coordinates of a position.
            settings: settings of `ExactSearch` that override the defaults here: every step of the forecast is a
                candidate, and a planned meeting is kept unless another is 50 control steps earlier.
        """
        offset = tuple((self.hover * self._up(torch.zeros(coordinates, dtype=torch.float64))).tolist())
        own: dict[str, Any] = {"stride": 1, "first": 1, "offset": offset, "descent_steps": float(self.descent_steps)}
        own |= {"early_steps": self.early_steps}
        own |= {"margin": 1.0, "switching_cost": 1.0}
        return ExactSearch(**(own | settings))

    def start(self, observation: Observation) -> MatchState:
        """State before the descent."""
        zero = torch.zeros_like(observation.tool_pos)
        return MatchState(torch.full_like(observation.step_count, -1), observation.tool_pos, zero)

    def __call__(
        self, plan: Plan, observation: Observation, holds: Tensor, state: MatchState
    ) -> tuple[Tensor, MatchState]:
        """The goal of each row's phase, and the next state."""
        tool_pos, up = observation.tool_pos, self._up(observation.tool_pos)
        place, later = plan.ahead(self.lookahead)[..., -2:, :].unbind(-2)
        step = self._next(plan, observation, holds, state.match_step)
        begins, rises = step == 0, step == self.descent_steps + self.hold_steps
        came = torch.where(begins.unsqueeze(-1), tool_pos, state.match_from)
        came = torch.where(rises.unsqueeze(-1), place, came)
        velocity = torch.where(rises.unsqueeze(-1), later - place, state.match_velocity)
        phase = self.phase(step).unsqueeze(-1)
        above, turn = plan.goal.split([tool_pos.shape[-1], plan.goal.shape[-1] - tool_pos.shape[-1]], dim=-1)
        goal = torch.where(phase == MatchPhase.DOWN, self._down(step, came, place, up), above)
        goal = torch.where(phase == MatchPhase.HOLD, place, goal)
        goal = torch.where(phase == MatchPhase.LIFT, self._lifted(step, came, velocity, up), goal)
        return torch.cat([goal, turn], dim=-1) if turn.shape[-1] else goal, MatchState(step, came, velocity)

    def committed(self, state: MatchState) -> Tensor:
        """See `torchdyn_plan.planners.choice.Commits`: true from the start of the descent to the end of the lift."""
        return (state.match_step >= 0) & ~self.finished(state)

    def finished(self, state: MatchState) -> Tensor:
        """See `torchdyn_plan.planners.choice.Commits`: true after the lift."""
        steps = self.descent_steps if self.lift_steps is None else self.lift_steps
        return state.match_step >= self.descent_steps + self.hold_steps + steps

    def phase(self, match_step: Tensor) -> Tensor:
        """`MatchPhase` of ``plan.match_step`` (*B,): ``(*B,)`` int64."""
        begun, on = match_step >= 0, match_step >= self.descent_steps
        return begun.long() + on + (match_step >= self.descent_steps + self.hold_steps)

    def _next(self, plan: Plan, observation: Observation, holds: Tensor, before: Tensor) -> Tensor:
        """``match_step`` (*B,) one control step after ``before`` (*B,)."""
        step = torch.where(before >= 0, before + 1, before)
        away = torch.linalg.vector_norm(observation.tool_pos - observation.target_pos, dim=-1)
        step = step.masked_fill((step == self.descent_steps) & (away > self.within), -1)
        due = plan.reachable & (plan.age >= 0) & ~holds & (plan.arrival_steps <= self.descent_steps)
        return step.masked_fill((step < 0) & due, 0)

    def _down(self, step: Tensor, came: Tensor, place: Tensor, up: Tensor) -> Tensor:
        """Goal ``(*B, D)`` at ``step`` (*B,) of the descent from ``came`` (*B, D) to ``place`` (*B, D)."""
        share = ((step + self.lead_steps) / self.descent_steps).to(came.dtype).clamp(0.0, 1.0).unsqueeze(-1)
        way = place - came
        along = (way * up).sum(-1, keepdim=True) * up
        flown = smooth(share / self.along_by)
        lowered = smooth((share - self.down_after) / (1.0 - self.down_after))
        return came + flown * (way - along) + lowered * along

    def _lifted(self, step: Tensor, came: Tensor, velocity: Tensor, up: Tensor) -> Tensor:
        """Goal ``(*B, D)`` of the lift from ``came`` (*B, D), with initial ``velocity`` (*B, D)."""
        steps = self.descent_steps if self.lift_steps is None else self.lift_steps
        passed = (step - self.descent_steps - self.hold_steps).to(came.dtype).clamp(0.0, float(steps)).unsqueeze(-1)
        gone = velocity * (passed - 0.5 * passed.square() / steps)
        return came + gone + (self.hover if self.lift is None else self.lift) * smooth(passed / steps) * up

    def _up(self, like: Tensor) -> Tensor:
        """The axis as a unit vector ``(D,)``, of the type of ``like`` (*B, D)."""
        size = like.shape[-1]
        if self.axis is None:
            return torch.eye(size, dtype=like.dtype, device=like.device)[-1]
        if len(self.axis) != size:
            raise InputError(f"axis has {len(self.axis)} numbers, but positions have {size} coordinates")
        return torch.nn.functional.normalize(like.new_tensor(self.axis), dim=-1)


def smooth(share: Tensor) -> Tensor:
    """10 s³ - 15 s⁴ + 6 s⁵ of ``share`` (*B,) clamped to 0 … 1; its first two derivatives are 0 at both ends."""
    s = share.clamp(0.0, 1.0)
    return s**3 * (10.0 + s * (6.0 * s - 15.0))
