"""A plan: where and when robot and target meet, its status, and when its target is lost."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan.checks import check_number, check_vector
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.search.meeting import Meeting

FARTHEST = 1e3
"""A forecast that leaves this range is bad [m]."""


class PlanStatus(IntEnum):
    """Codes of ``plan.status``, row by row; from `BAD_FORECAST` on a row whose plan is due holds its tool still."""

    OK = 0
    """The robot can reach the planned meeting in time."""
    WAITING = 1
    """No plan has been made yet."""
    UNREACHABLE = 2
    """The robot cannot reach any meeting on the forecast in time; the goal only gives a direction."""
    BAD_FORECAST = 3
    """The forecast holds a NaN or an infinity, or is out of range."""
    TARGET_LOST = 4
    """The target is lost."""
    BAD_INPUT = 5
    """An input value of the target or the robot is NaN, infinite, or too large to be a measurement."""
    NO_TRACK = 6
    """There are too few measurements of the target, or they are too old, to know where it is."""


class Lost(Protocol):
    """Decides whether a target at a position is lost; a task whose targets cannot be lost has none."""

    def seen(self, target_pos: Tensor) -> Tensor:
        """Whether a target observed at ``target_pos`` (*B, D) [m, world] is lost: ``(*B,)`` bool."""
        ...

    def forecast(self, path: Tensor) -> Tensor:
        """Whether a target forecast at each position of ``path`` (*B, F, D) is lost there: ``(*B, F)`` bool."""
        ...


@dataclass(frozen=True, kw_only=True)
class LostBelow:
    """A target is lost once it is below a height."""

    seen_below: float
    """Height below which an observed target is lost [m, world]."""
    forecast_below: float
    """Height at or below which a forecast target counts as lost [m, world]. Set it between the heights of lost targets
    and of others, because an uncertain forecast lies between them."""

    def __post_init__(self) -> None:
        check_number("seen_below", self.seen_below)
        check_number("forecast_below", self.forecast_below)

    def seen(self, target_pos: Tensor) -> Tensor:
        """As `Lost.seen`."""
        if target_pos.shape[-1] != 3:
            raise no_height(target_pos)
        return target_pos[..., 2] < self.seen_below

    def forecast(self, path: Tensor) -> Tensor:
        """As `Lost.forecast`."""
        if path.shape[-1] != 3:
            raise no_height(path)
        return path[..., 2] <= self.forecast_below


@dataclass(frozen=True, kw_only=True)
class MetWithin:
    """Allows meetings inside a box only, for example where a robot is clear of its limits; a target is never lost."""

    low: tuple[float, ...]
    """Lower corner of the box, one number for each axis [m, world]."""
    high: tuple[float, ...]
    """Upper corner of the box [m, world]."""

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, check_vector(name, getattr(self, name)))
        if len(self.low) != len(self.high) or any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise InputError(f"low must be below high along each axis, got {self.low!r} and {self.high!r}")

    def seen(self, target_pos: Tensor) -> Tensor:
        """See `Lost.seen`: never."""
        return torch.zeros_like(target_pos[..., 0], dtype=torch.bool)

    def forecast(self, path: Tensor) -> Tensor:
        """See `Lost.forecast`: outside the box."""
        if path.shape[-1] != len(self.low):
            raise InputError(f"the box has {len(self.low)} axes, but positions have {path.shape[-1]} coordinates")
        return ((path < path.new_tensor(self.low)) | (path > path.new_tensor(self.high))).any(-1)


def no_height(place: Tensor) -> InputError:
    """The error for positions without three coordinates, which have no height."""
    return InputError(f"LostBelow needs points of 3 coordinates, got {place.shape[-1]}: a plane has no height")


class Plan(NamedTuple):
    """The plan in use in each row."""

    goal: Tensor
    """``(*B, D)`` [m, world]; followed by the tool's quaternion wxyz if the planner has a turn."""
    arrival_steps: Tensor
    """``(*B,)`` int64 control steps from now to the meeting."""
    clamped: Tensor
    """``(*B,)`` bool, see `Meeting.clamped`."""
    reachable: Tensor
    """``(*B,)`` bool, see `Meeting.reachable`."""
    usable: Tensor
    """``(*B,)`` bool: the forecast behind it was usable."""
    path: Tensor
    """``(*B, T, D)`` [m, world]: forecast of the target 0 … T-1 steps after the step that the plan was made for."""
    age: Tensor
    """``(*B,)`` int64 control steps since that step; -1 before the first plan."""

    @classmethod
    def hold(cls, observation: Observation, length: int, *, turned: bool = False) -> Plan:
        """The plan of rows that have none: the tool stays, and the target is expected to stay.

        With ``turned``, goals are followed by a zero quaternion, which keeps the tool's orientation.
        """
        tool_pos, target_pos, step = observation.tool_pos, observation.target_pos, observation.step_count
        yes = torch.ones_like(step, dtype=torch.bool)
        at_rest = target_pos.unsqueeze(-2).expand(*target_pos.shape[:-1], length, target_pos.shape[-1])
        goal = torch.nn.functional.pad(tool_pos, (0, 4)) if turned else tool_pos
        return cls(goal, torch.zeros_like(step), ~yes, yes, yes, at_rest, torch.full_like(step, -1))

    @classmethod
    def make(cls, meeting: Meeting, usable: Tensor, target_pos: Tensor, path: Tensor, length: int) -> Plan:
        """A new plan.

        Args:
            meeting: result of the search.
            usable: ``(*B,)`` whether the forecast was usable.
            target_pos: ``(*B, D)`` the target's position at the step for which the plan is made [m, world].
            path: ``(*B, F, D)`` its forecast from then on.
            length: number of positions to keep; the last one is repeated after the end of the forecast.
        """
        kept = path[..., : max(length - 1, 0), :]
        if length:
            kept = torch.cat([target_pos.unsqueeze(-2), kept], dim=-2)
        if missing := length - kept.shape[-2]:
            kept = torch.cat([kept, kept[..., -1:, :].expand(*kept.shape[:-2], missing, -1)], dim=-2)
        return cls(*meeting, usable, kept, torch.zeros_like(meeting.arrival_steps))

    def older(self) -> Plan:
        """The plan one control step later."""
        return self._replace(arrival_steps=(self.arrival_steps - 1).clamp_min(0), age=self.age + (self.age >= 0))

    def held(self, rows: Tensor, tool_pos: Tensor) -> Plan:
        """The plan with ``rows`` (*B,) bool holding their tool at ``tool_pos`` (*B, D) [m, world]."""
        if not (torch.compiler.is_compiling() or debug_unwrap(rows).any()):
            return self
        stay = tool_pos
        if self.goal.shape != tool_pos.shape:
            stay = torch.nn.functional.pad(tool_pos, (0, self.goal.shape[-1] - tool_pos.shape[-1]))
        return self._replace(
            goal=torch.where(rows.unsqueeze(-1), stay, self.goal),
            arrival_steps=self.arrival_steps.masked_fill(rows, 0),
            clamped=self.clamped & ~rows,
            reachable=self.reachable & ~rows,
        )

    def ahead(self, count: int) -> Tensor:
        """Forecast of the target for now and 1 … ``count`` - 1 steps ahead, ``(*B, count, D)``."""
        ahead = torch.arange(count, device=self.age.device)
        index = (self.age.clamp_min(0).unsqueeze(-1) + ahead).clamp(max=self.path.shape[-2] - 1)
        return self.path.gather(-2, index.unsqueeze(-1).expand(*index.shape, self.path.shape[-1]))

    def status(self, trouble: Tensor, replans: Tensor) -> Tensor:
        """`PlanStatus` of each row, ``(*B,)`` int64, from the status of its input and its number of plans."""
        code = torch.where(self.reachable, int(PlanStatus.OK), int(PlanStatus.UNREACHABLE))
        code = torch.where(replans == 0, int(PlanStatus.WAITING), code)
        code = torch.where(self.usable, code, int(PlanStatus.BAD_FORECAST))
        return torch.where(trouble > 0, trouble, code)


def input_status(observation: Observation, bad: Tensor | None, lost: Lost | None) -> Tensor:
    """`BAD_INPUT` in the rows ``bad`` (*B,), if any, `TARGET_LOST` where ``lost`` says so, else `OK`: (*B,) int64."""
    target_pos = observation.target_pos
    code = torch.zeros_like(observation.step_count)
    if lost is not None:
        code = lost.seen(target_pos) * int(PlanStatus.TARGET_LOST)
    return code if bad is None else code.masked_fill(bad, int(PlanStatus.BAD_INPUT))


def usable_path(path: Tensor, target_pos: Tensor) -> tuple[Tensor, Tensor]:
    """The path ``(*B, F, D)``, where bad rows rest at ``target_pos`` (*B, D), and which rows are good, ``(*B,)``.

    The path gets the type of the target's position.
    """
    if path.dtype != target_pos.dtype:
        path = path.to(target_pos.dtype)
    usable = path.abs().amax((-2, -1), keepdim=True) <= FARTHEST
    return torch.where(usable, path, target_pos.unsqueeze(-2)), usable.view(target_pos.shape[:-1])
