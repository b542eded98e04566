"""Recorded attempts of a planner at a moving target: the target's path about the place, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_finite, check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.capture import CaptureConfig, CaptureModel
from torchdyn_plan.planners.maneuver import Maneuver
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.training.shards import read_shards


class Captures(NamedTuple):
    """Attempts of a robot that waited at a place for a target."""

    window: Tensor
    """(n, positions, 2): the forecast path about the place, see `torchdyn_plan.nets.CaptureNetwork.windows` [m]."""
    goal: Tensor
    """(n, 2): the place [m, world]."""
    captured: Tensor
    """(n,) bool: whether the attempt ended in a capture."""
    run: Tensor
    """(n,) int64: attempts with the same number come from the same series of episodes."""

    def take(self, rows: Tensor) -> Captures:
        """The attempts ``rows`` (M,)."""
        return Captures(*(tensor[rows] for tensor in self))


def load_captures(folder: Path, config: CaptureConfig) -> Captures:
    """All ``captures-*.safetensors`` of ``folder``, concatenated.

    Raises:
        InputError: there is none, one is broken, windows are not those of ``config``, or all attempts ended alike.
    """
    shards = read_shards(folder, "captures", Captures._fields)
    data = Captures(*(torch.cat([shard[name] for shard in shards]) for name in Captures._fields))
    check_trailing_shape("window of the captures", data.window, config.positions, 2)
    check_trailing_shape("goal of the captures", data.goal, 2)
    for name, kind in (("captured", torch.bool), ("run", torch.int64)):
        if getattr(data, name).dtype != kind:
            raise InputError(
                f"{name} of the captures in {str(folder)!r} must be {kind}, got {getattr(data, name).dtype}"
            )
    for name, tensor in zip(Captures._fields, data, strict=True):
        if len(tensor) != len(data.run):
            raise InputError(f"captures in {str(folder)!r} have {len(tensor)} rows of {name}, {len(data.run)} of run")
        check_finite(f"{name} of the captures in {str(folder)!r}", tensor)
    if bool(data.captured.all()) or not bool(data.captured.any()):
        raise InputError(f"captures in {str(folder)!r} all ended alike: there is nothing to learn from {len(data.run)}")
    return data


class Guessing(CaptureModel):
    """Explores: multiplies the probability of a capture by a number that is drawn anew at each call."""

    def __init__(self, draw: torch.Generator, *, least: float) -> None:
        """Draw from ``draw`` numbers between ``least`` and 1."""
        super().__init__()
        self.draw, self.least = draw, least

    def probability(self, path: Tensor, goal: Tensor, steps: Tensor) -> Tensor:
        """As of `CaptureModel`: a number ``(*B, K)`` that knows nothing of the path."""
        return self.least + (1.0 - self.least) * torch.rand(goal.shape[:-1], generator=self.draw)


@dataclass(frozen=True, kw_only=True)
class FarSighted:
    """A maneuver like another one; more of the path is kept in the planner's memory for it."""

    maneuver: Maneuver
    """The other one."""
    lookahead: int
    """Positions of the target's path that are kept."""

    def __post_init__(self) -> None:
        check_number("lookahead", self.lookahead, minimum=self.maneuver.lookahead, integer=True)

    @property
    def State(self) -> type[Any]:  # noqa: N802
        """The other one's."""
        return self.maneuver.State

    def start(self, observation: Observation) -> Any:
        """As the other one."""
        return self.maneuver.start(observation)

    def __call__(self, plan: Plan, observation: Observation, holds: Tensor, state: Any) -> tuple[Tensor, Any]:
        """As the other one."""
        return self.maneuver(plan, observation, holds, state)


class Attempts:
    """Attempts in progress in N environments, at most one in each, and those that have ended.

    An attempt is the last plan of some time before the target comes. It counts if the robot is at the place by then.
    """

    def __init__(self, config: CaptureConfig, count: int, draw: torch.Generator) -> None:
        """For windows of ``config`` in ``count`` environments; from when plans are taken is drawn from ``draw``."""
        self.window, self.goal = torch.zeros(count, config.positions, 2), torch.zeros(count, 2)
        self.open, self.there = torch.zeros(2, count, dtype=torch.bool)
        self.past = torch.zeros(count, dtype=torch.int64)
        # Early plans see all of the window ahead, late ones only a part of it.
        self.soonest = SOONEST + (SOONEST_RANGE * torch.rand(count, generator=draw).square()).long()
        # An empty one is there if none ends.
        self.ended = [Captures(self.window[:0], self.goal[:0], self.open[:0], self.past[:0])]

    def renew(self, rows: Tensor, window: Tensor, goal: Tensor) -> None:
        """Begin attempts in ``rows`` (N,), with ``window`` (N, positions, 2) and ``goal`` (N, D), instead of others."""
        self.window = torch.where(rows[:, None, None], window, self.window)
        self.goal = torch.where(rows[:, None], goal[:, :2], self.goal)
        self.open, self.there, self.past = self.open | rows, self.there & ~rows, self.past.masked_fill(rows, 0)

    def watch(self, tool_pos: Tensor, arrival_steps: Tensor) -> None:
        """See where tools (N, D) are, ``arrival_steps`` (N,) before the target comes."""
        near = (tool_pos[:, :2] - self.goal).norm(dim=-1) < AT_PLACE
        self.there = self.there | (self.open & near & (arrival_steps <= IN_PLACE))
        self.past = self.past + (self.open & (arrival_steps <= 0))

    def end(self, rows: Tensor, *, captured: bool) -> None:
        """End attempts in ``rows`` (N,), and keep those in which the robot was there."""
        kept = (rows & self.open & self.there).nonzero().squeeze(-1)
        if len(kept):
            outcome = torch.full((len(kept),), captured)
            self.ended.append(Captures(self.window[kept], self.goal[kept], outcome, kept))
        self.open, self.there = self.open & ~rows, self.there & ~rows

    def found(self, first: int = 0) -> Captures:
        """All attempts that have ended; the first environment counts as run ``first``."""
        whole = Captures(*map(torch.cat, zip(*self.ended, strict=True)))
        return whole._replace(run=whole.run + first)

    def drop(self, rows: Tensor) -> None:
        """Forget attempts in ``rows`` (N,) of which nothing came."""
        self.open, self.there = self.open & ~rows, self.there & ~rows


SOONEST, SOONEST_RANGE, LATEST = 8, 16, 45
"""Plans are taken between so many, up to a range more, and so many control steps before the target comes."""
AT_PLACE = 0.015
"""A tool within this distance of a place, sideways, is there [m]."""
IN_PLACE = 6
"""A robot is in time if it is there by then [control steps before the target comes]."""
PASSED = 25
"""So many control steps after the target came an attempt that was not begun has failed."""
