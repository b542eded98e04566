"""The whole forecast searched at once: every time at which the target could be met, and the best of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.odds import meeting_odds
from torchdyn_plan.planners.search import SearchResult

if TYPE_CHECKING:
    from torchdyn_plan.nets.eta import Arrival
    from torchdyn_plan.nets.spread import Spread


NEAR_EDGE = 0.08
"""Distance over which goals near the robot's axis come to lose their whole cost [m]."""


class Candidates(NamedTuple):
    """Places and times at which the target could be met, K of them."""

    goals: Tensor
    """``(*B, K, 3)`` [m, world]."""
    comes: Tensor
    """``(*B, K)`` or ``(K,)`` int64: control steps until the target comes within the footprint."""
    score: Tensor
    """``(*B, K)`` or ``(K,)``: what the meeting is worth to a robot that is in time."""
    stay: Tensor | None
    """``(*B, K)`` int64: control steps that the target stays; None where stays are not judged."""
    on_table: Tensor
    """``(*B, K)`` bool: the target is not in a pocket."""


@dataclass(frozen=True, kw_only=True)
class ExactSearch:
    """Judges every ``stride``-th position of the forecast as a meeting place, in one pass of the arrival predictor.

    A candidate at step t is *in time* when the robot, which needs e(t) steps, is there ``lead`` steps and a ``margin``
    before the target comes, e(t) + lead + margin ≤ t. Of these the one with the highest score wins: a point for each
    step that the target stays at the place (up to ``longest_stay``), less ``patience`` for each step of waiting, plus
    ``loyalty`` for the meeting that was planned before, which also needs no margin. Equal scores go to the earliest.
    With the defaults the first crossing of e(t) = t wins. If nothing is in time, the least late candidate gives the
    goal, and `reachable` is false.

    With a ``base_pos`` places near the robot's axis count less: there its box comes down too slowly for a fast target.
    With a ``caution`` the probability of meeting counts too: that the robot is there ``lead`` steps before the target
    comes, by the whole distribution of the arrival time, and that the target is within the footprint then, by the
    spread of the forecast.
    """

    stride: int = 5
    """Control steps between candidates; an arrival bin's width loses nothing."""
    first: int = 2
    """Step of the first candidate; the middle of the first arrival bin."""
    height: float | None = None
    """Height of the goals, above the table to wait there [m]; None for the target's own."""
    half_extent: float | None = None
    """Goals are clamped to the square of this half-side, where the tool can be; None to leave them [m]."""
    lead: float = 0.0
    """Control steps that the robot needs from the goal to the target."""
    margin: float = 0.0
    """Control steps that the robot should be early."""
    footprint: float = 0.0
    """A target within this distance of the goal, along both axes, is at the place [m]; 0 judges no stays."""
    longest_stay: int = 16
    """Control steps; to stay longer is worth no more."""
    patience: float = 0.02
    """Score that a step of waiting costs."""
    loyalty: float = 0.0
    """Score of keeping the meeting planned before."""
    arrived: float = 0.0
    """A goal within this distance of the tool, sideways, is reached now [m]."""
    coarse: int = 1
    """Ask for every so many candidates first, then for those around the likely best; 1 asks for all at once.

    Made for the first crossing. It costs meetings where a robot waits: beneath the tool arrival times are not smooth.
    """
    base_pos: tuple[float, float] | None = None
    """Vertical axis of the robot, near which it is slow because it folds up [m, world]; None where it is not."""
    near: float = 0.42
    """Goals nearer to that axis than this, sideways, are worth less [m]."""
    near_cost: float = 15.0
    """Score that they lose, all of it from `NEAR_EDGE` further in."""
    caution: float = 0.0
    """Score of a meeting that is certain over one that is impossible: with c, a probability that is higher by p is
    worth c·p steps of stay, or c·p / ``patience`` steps of waiting. 0 takes the forecast and the mean arrival time as
    they are."""

    def __post_init__(self) -> None:
        check_number("stride", self.stride, minimum=1, integer=True)
        check_number("coarse", self.coarse, minimum=1, integer=True)
        check_number("first", self.first, minimum=0, integer=True)
        check_number("longest_stay", self.longest_stay, minimum=1, integer=True)
        for name in ("lead", "margin", "footprint", "patience", "loyalty", "arrived", "near", "near_cost", "caution"):
            check_number(name, getattr(self, name), minimum=0.0)
        if self.base_pos is not None:
            if len(self.base_pos) != 2:
                raise InputError(f"base_pos must be x and y [m], got {self.base_pos!r}")
            for coordinate in self.base_pos:
                check_number("base_pos", coordinate)
        if self.caution > 0.0 and self.coarse > 1:
            raise InputError(f"a caution needs all candidates at once: coarse must be 1 with it, got {self.coarse}")
        if self.half_extent is not None:
            check_number("half_extent", self.half_extent, minimum=0.0)
        if self.height is not None:
            check_number("height", self.height)

    def __call__(
        self,
        forecast: Tensor,
        target_pos: Tensor,
        eta: Callable[..., Arrival],
        *,
        tool_pos: Tensor | None = None,
        planned_steps: Tensor | None = None,
        spread: Spread | None = None,
    ) -> SearchResult:
        """Choose a meeting.

        Args:
            forecast: ``(*B, F, 3)`` [m, world], target positions in 1 … F control steps.
            target_pos: ``(*B, 3)`` [m, world], the target now.
            eta: maps goals ``(*B, K, 3)`` to arrivals ``(*B, K)``; called once, with the keyword ``reading``.
            tool_pos: ``(*B, 3)`` [m, world], to tell goals that are reached already; None to trust ``eta`` alone.
            planned_steps: ``(*B,)`` control steps from now to the meeting planned before; None if there is none.
            spread: of the forecast, read with a ``caution``; None to be sure of it.

        Returns:
            The meeting; ``arrival_steps`` is when the target comes within the footprint.

        Raises:
            InputError: an argument has another shape, or their batches differ.
        """
        horizon = checked_horizon(forecast, target_pos, tool_pos, planned_steps)
        goals, comes, score, stay, on_table = self.candidates(forecast, target_pos, horizon)
        kept = None
        if planned_steps is not None:
            # Nearer in time than any other candidate, or as near: the same meeting.
            kept = (comes - planned_steps.unsqueeze(-1)).abs() <= max(self.stride // 2, 1)
            score = score + self.loyalty * kept

        def choose(needed: Tensor, gain: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
            early = comes - self.lead - needed
            slack = early - self.margin
            slack = slack if kept is None else torch.where(kept, early, slack)
            return _best(score + gain, slack, stay=stay, on_table=on_table)

        ask = partial(self._needed, eta=eta, tool_pos=tool_pos)
        if self.coarse > 1:
            best, reachable = choose_nearby(choose, lambda some: ask(some)[0], goals, self.coarse)
        else:
            needed, arrival = ask(goals)
            gain: Tensor | float = 0.0
            if self.caution > 0.0:
                steps, places = self.places(forecast, target_pos, horizon)
                told, away = None if spread is None else spread.at(steps), (goals - places)[..., :2]
                odds = meeting_odds(arrival, needed, comes - self.lead, told, away, half_width=self.footprint)
                gain = self.caution * odds
            best, reachable = choose(needed, gain)
        return SearchResult(
            goal=goals.gather(-2, best.unsqueeze(-1).expand(*best.shape, 3)).squeeze(-2),
            arrival_steps=comes.expand(goals.shape[:-1]).gather(-1, best).squeeze(-1),
            clamped=torch.zeros_like(reachable),
            reachable=reachable,
        )

    def candidates(self, forecast: Tensor, target_pos: Tensor, horizon: int) -> Candidates:
        """Where and when the target could be met, whatever the robot needs; arguments as for a call."""
        steps, places = self.places(forecast, target_pos, horizon)
        goals, on_table = self.goals(places), places[..., 2] > 0.0
        cost = self.patience * steps
        if self.base_pos is not None:
            cost = cost + self.near_cost * self._nearness(goals)
        if self.footprint == 0.0:
            return Candidates(goals, steps, 1 - cost, None, on_table)
        path = torch.cat([target_pos.unsqueeze(-2), forecast], dim=-2)
        before, stay = self.stays(path, goals, min(self.first, horizon))
        return Candidates(goals, steps - before, stay - cost, stay, on_table)

    def _nearness(self, goals: Tensor) -> Tensor:
        """How near to the robot's axis ``goals`` (*B, K, 3) are, ``(*B, K)``: 0 outside of `near`, up to 1."""
        assert self.base_pos is not None
        x, y = self.base_pos
        away = torch.hypot(goals[..., 0] - x, goals[..., 1] - y)
        return ((self.near - away) / NEAR_EDGE).clamp(0.0, 1.0)

    def places(self, forecast: Tensor, target_pos: Tensor, horizon: int) -> tuple[Tensor, Tensor]:
        """Steps ``(K,)`` of the candidates, and where the target is then, ``(*B, K, 3)`` [m, world]."""
        first = min(self.first, horizon)
        steps = torch.arange(first, horizon + 1, self.stride, device=forecast.device)
        if first > 0:
            return steps, forecast[..., first - 1 :: self.stride, :]
        path = torch.cat([target_pos.unsqueeze(-2), forecast], dim=-2)
        return steps, path[..., :: self.stride, :]

    def _needed(self, goals: Tensor, *, eta: Callable[..., Arrival], tool_pos: Tensor | None) -> tuple[Tensor, Arrival]:
        """Control steps (*B, K) to each goal (*B, K, 3), infinitely many where the robot never arrives; the arrival."""
        arrival = eta(goals, reading="odds" if self.caution > 0.0 else "expectation")
        needed = arrival.steps.masked_fill(arrival.never, torch.inf)
        if tool_pos is None or self.arrived == 0.0:
            return needed, arrival
        away = (goals - tool_pos.unsqueeze(-2))[..., :2].square().sum(-1)
        return needed.masked_fill(away < self.arrived**2, 0.0), arrival

    def goals(self, places: Tensor) -> Tensor:
        """Where the tool is sent to meet a target at ``places`` (*B, 3) [m, world]."""
        level, height = places[..., :2], places[..., 2:]
        if self.half_extent is not None:
            level = level.clamp(-self.half_extent, self.half_extent)
        if self.height is not None:
            return torch.nn.functional.pad(level, (0, 1), value=self.height)
        return places if self.half_extent is None else torch.cat([level, height], dim=-1)

    def stays(self, path: Tensor, goals: Tensor, first: int) -> tuple[Tensor, Tensor]:
        """How many steps before each candidate the target is at its place already, and how long it stays in all.

        Args:
            path: ``(*B, F + 1, 3)`` [m, world], the target now and in 1 … F steps.
            goals: ``(*B, K, 3)`` [m, world], at every ``stride``-th position of the path from the ``first`` on.
            first: step of the first candidate.

        Returns:
            Both ``(*B, K)`` int64, in control steps; the stay is 0 where the target never comes within the footprint.
            Neither the past counts nor what comes after the forecast.
        """
        longest = self.longest_stay
        level = torch.where(path[..., 2:] > 0.0, path[..., :2], torch.inf)
        level = torch.nn.functional.pad(level, (0, 0, longest, longest), value=torch.inf)
        # Windows around the candidates are views: nothing is copied before the difference.
        around = level[..., first:, :].unfold(-2, 2 * longest + 1, self.stride)
        gone = ~((around - goals[..., :2].unsqueeze(-1)).abs().amax(-2) <= self.footprint)
        number = torch.arange(1, longest + 2, device=path.device)
        before = longest + 1 - (gone[..., : longest + 1] * number).amax(-1)
        after = torch.where(gone[..., longest:], number, longest + 2).amin(-1) - 1
        return (before - 1).clamp_min(0), (before + after - 1).clamp(0, longest)


def checked_horizon(
    forecast: Tensor, target_pos: Tensor, tool_pos: Tensor | None = None, planned_steps: Tensor | None = None
) -> int:
    """F; raises `InputError` where a shape is wrong."""
    check_trailing_shape("target_pos", target_pos, 3)
    batch, horizon = target_pos.shape[:-1], forecast.shape[-2] if forecast.ndim > 1 else 1
    check_trailing_shape("forecast", forecast, *batch, horizon, 3)
    if tool_pos is not None:
        check_trailing_shape("tool_pos", tool_pos, *batch, 3)
    if planned_steps is not None:
        check_trailing_shape("planned_steps", planned_steps, *batch)
    return horizon


def choose_nearby(
    choose: Callable[[Tensor], tuple[Tensor, Tensor]], ask: Callable[[Tensor], Tensor], goals: Tensor, coarse: int
) -> tuple[Tensor, Tensor]:
    """What ``choose`` returns when it knows the steps needed to every ``coarse``-th goal, and to those near its choice.

    Args:
        choose: makes its choice from the steps needed to each goal ``(*B, K)``; returns its index ``(*B, 1)`` first.
        ask: maps goals ``(*B, k, 3)`` to the steps needed ``(*B, k)``; called twice.
        goals: ``(*B, K, 3)``, along a path: from one to the next the steps needed change little.
        coarse: first every so many goals are asked for, then as many and one around the best guess.
    """
    count = goals.shape[-2]
    needed = ask(goals[..., ::coarse, :])
    # Between them the steps needed are interpolated: a product with a triangle for each goal that is known.
    place = (torch.arange(count, device=goals.device) / coarse).clamp(max=needed.shape[-1] - 1)
    nodes = torch.arange(needed.shape[-1], device=goals.device).unsqueeze(-1)
    shares = (1.0 - (place - nodes).abs()).clamp_min(0.0).to(needed.dtype)
    guess, _ = choose(needed.clamp(max=1e4) @ shares)
    # Goals before the guess may do as well, and were not asked for; after it, the next one asked for is not far.
    width = min(coarse + 1, count)
    window = (guess - coarse + 1).clamp(0, count - width) + torch.arange(width, device=goals.device)
    known = torch.full(goals.shape[:-1], torch.inf, dtype=needed.dtype, device=goals.device)
    known[..., ::coarse] = needed
    nearby = goals.gather(-2, window.unsqueeze(-1).expand(*window.shape, 3))
    return choose(known.scatter(-1, window, ask(nearby)))


def _best(score: Tensor, slack: Tensor, *, stay: Tensor | None, on_table: Tensor) -> tuple[Tensor, Tensor]:
    """Index (*B, 1) of the candidate in time with the highest score, and whether any is in time (*B,); all (*B, K)."""
    in_time = (slack >= 0.0) & on_table
    # Worse and worse: late, out of the box's reach, never reached by the robot, below the table.
    late = slack.clamp(min=-1e6)
    if stay is not None:
        in_time, late = in_time & (stay > 0), late - 1e4 * (stay == 0)
    late = late - 1e7 * ~on_table
    some = in_time.any(dim=-1, keepdim=True)
    score = torch.where(some, torch.where(in_time, score, -torch.inf), late)
    return score.argmax(dim=-1, keepdim=True), some.squeeze(-1)
