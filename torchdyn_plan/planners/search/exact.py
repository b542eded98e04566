"""The whole forecast searched at once: every time at which the target could be met, and the best of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import POINT_SIZES, check_number, check_points, check_trailing_shape, check_vector
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.search.meeting import NO_CONTEXT, Meeting, SearchContext
from torchdyn_plan.precision import exact_product

if TYPE_CHECKING:
    from torchdyn_plan.nets.arrival import ArrivalQuery
    from torchdyn_plan.nets.distributions import Arrival, Spread
    from torchdyn_plan.nets.forecast import Forecast
    from torchdyn_plan.planners.plan import Lost


LATEST = 1e6
"""If nothing is in time, candidates rank by how late they are, at most so many control steps."""
LATE_OUT_OF_REACH = 1e4
"""Control steps that a candidate counts as later at which the target never comes within the footprint."""
LATE_LOST = 1e7
"""Control steps that a candidate counts as later at which the target is lost: it ranks behind all others."""


class Candidates(NamedTuple):
    """Places and times at which the target could be met, K of them."""

    steps: Tensor
    """``(K,)`` int64 control steps from now."""
    places: Tensor
    """``(*B, K, D)`` [m, world], where the target is then."""
    goals: Tensor
    """``(*B, K, D)`` [m, world], where the tool is sent to meet it."""
    target_steps: Tensor
    """``(*B, K)`` or ``(K,)`` int64: control steps until the target comes within the footprint."""
    score: Tensor
    """``(*B, K)`` or ``(K,)``: what the meeting is worth to a robot that is in time."""
    dwell_steps: Tensor | None
    """``(*B, K)`` int64: control steps that the target stays there; None where that is not judged."""
    lost: Tensor | None
    """``(*B, K)`` bool: the target is lost by then; None where it cannot be."""


@dataclass(frozen=True, kw_only=True)
class ExactSearch:
    """Judges every ``stride``-th position of the forecast as a meeting place, in one pass of the arrival model.

    A candidate at step t is *in time* when the robot, which needs e(t) steps, is there ``descent_steps`` and a
    ``margin`` before the target comes, e(t) + descent_steps + margin ≤ t. Of these the one with the highest score wins:
    a point for each step that the target dwells at the place (up to ``longest_dwell``), less ``waiting_cost`` for each
    step of waiting, plus ``switching_cost`` for the meeting that was planned before, which also needs no margin. Equal
    scores go to the earliest. With the defaults the first crossing of e(t) = t wins. If nothing is in time, the least
    late candidate gives the goal, and `Meeting.reachable` is false.

    With a ``base_pos`` places near the robot's axis count less: there it comes down too slowly for a fast target.
    With a ``probability_weight`` the probability of meeting counts too: that the robot is there ``descent_steps``
    before the target comes, by the whole distribution of the arrival time, and that the target is within the footprint
    then, by the spread of the forecast. With a ``capture`` in the context, it is also the probability that a robot that
    waits there captures the target.
    """

    reads_turn: ClassVar[bool] = True

    stride: int = 5
    """Control steps between candidates; an arrival bin's width loses nothing.

    Successive plans have the same candidates only where the schedule's period is a multiple of it. With a
    ``switching_cost``, plan at such a period or take stride 1: else the meeting moves a little with each plan.
    """
    first: int = 2
    """Step of the first candidate; the middle of the first arrival bin."""
    height: float | None = None
    """Height of the goals in space, above the target to wait there [m]; None for the target's own."""
    half_extent: float | None = None
    """Goals are clamped to the square of this half-side, where the tool can be; None to leave them [m]."""
    offset: tuple[float, ...] | None = None
    """From the target to the goal, where the tool waits, a number for each axis [m]; None for no way at all."""
    early_steps: int = 0
    """The goal is where the target is so many control steps before they meet: from there the tool goes along."""
    descent_steps: float = 0.0
    """Control steps that the robot needs from the goal to the target."""
    margin: float = 0.0
    """Control steps that the robot should be early."""
    footprint: float = 0.0
    """A target within this distance of the goal, along both axes, is at the place [m]; 0 judges no dwelling."""
    longest_dwell: int = 16
    """Control steps; to dwell longer is worth no more."""
    waiting_cost: float = 0.02
    """Score that a step of waiting costs."""
    switching_cost: float = 0.0
    """Score that any other meeting than the one planned before loses to it: hysteresis."""
    arrival_radius: float = 0.0
    """A goal within this distance of the tool, sideways, is reached now [m]."""
    coarse: int = 1
    """Ask for every so many candidates first, then for those around the likely best; 1 asks for all at once.

    Made for the first crossing. It costs meetings where a robot waits: beneath the tool arrival times are not smooth.
    """
    base_pos: tuple[float, float] | None = None
    """Vertical axis of the robot, near which it is slow because it folds up [m, world]; None where it is not."""
    axis_radius: float = 0.42
    """Goals nearer to that axis than this, sideways, are worth less [m]."""
    axis_edge: float = 0.08
    """Distance over which they come to lose their whole ``axis_cost`` [m]."""
    axis_cost: float = 15.0
    """Score that they lose."""
    probability_weight: float = 0.0
    """Score of a meeting that is certain over one that is impossible: with c, a probability that is higher by p is
    worth c·p steps of dwelling, or c·p / ``waiting_cost`` steps of waiting. 0 takes the forecast and the mean arrival
    time as they are."""

    def __post_init__(self) -> None:
        for name in ("stride", "coarse", "longest_dwell"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        for name in ("first", "early_steps"):
            check_number(name, getattr(self, name), minimum=0, integer=True)
        check_number("axis_edge", self.axis_edge, minimum=1e-9)
        for name in (
            "descent_steps",
            "margin",
            "footprint",
            "waiting_cost",
            "switching_cost",
            "arrival_radius",
            "axis_radius",
            "axis_cost",
            "probability_weight",
        ):
            check_number(name, getattr(self, name), minimum=0.0)
        if self.base_pos is not None:
            object.__setattr__(self, "base_pos", tuple(self.base_pos))
            if len(self.base_pos) != 2:
                raise InputError(f"base_pos must be x and y [m], got {self.base_pos!r}")
            for coordinate in self.base_pos:
                check_number("base_pos", coordinate)
        if self.offset is not None:
            object.__setattr__(self, "offset", check_vector("offset", self.offset))
        if self.probability_weight > 0.0 and self.coarse > 1:
            raise InputError(f"a probability_weight needs all candidates at once: coarse must be 1, got {self.coarse}")
        if self.half_extent is not None:
            check_number("half_extent", self.half_extent, minimum=0.0)
        if self.height is not None:
            check_number("height", self.height)

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """Choose a meeting.

        Args:
            forecast: of the target in 1 … F control steps; its spread is read with a ``probability_weight``.
            target_pos: ``(*B, D)`` [m, world], the target now.
            eta: maps goals ``(*B, K, D)`` to arrivals ``(*B, K)``; called once, with the keyword ``estimator``.
            context: what else is known.

        Returns:
            The meeting; ``arrival_steps`` is when the target comes within the footprint.

        Raises:
            InputError: an argument has another shape, or their batches differ.
        """
        check_context(forecast.path, target_pos, context)
        whole = torch.cat([target_pos.unsqueeze(-2), forecast.path], dim=-2)
        candidates = self.candidates(whole, context.lost)
        if context.turn is not None:
            turns = context.turn[..., (candidates.steps - 1).clamp_min(0), :]
            candidates = candidates._replace(goals=torch.cat([candidates.goals, turns], dim=-1))
        kept = None
        if context.planned_steps is not None:
            # Nearer in time to the meeting planned before than any other candidate, or as near: the same meeting.
            away = (candidates.target_steps - context.planned_steps.unsqueeze(-1)).abs()
            kept = away <= max(self.stride // 2, 1)
        if self.coarse > 1:
            best, reachable = choose_nearby(
                lambda eta_steps: self._choose(candidates, kept, eta_steps),
                lambda goals: self._ask(goals, eta, context.tool_pos)[0],
                candidates.goals,
                self.coarse,
            )
        else:
            eta_steps, arrival = self._ask(candidates.goals, eta, context.tool_pos)
            probability = None
            if self.probability_weight > 0.0:
                time = candidates.target_steps - self.descent_steps
                offset = candidates.goals[..., :2] - candidates.places[..., :2]
                spread = None if forecast.spread is None else forecast.spread.at(candidates.steps)
                probability = meeting_probability(arrival, eta_steps, time, spread, offset, half_width=self.footprint)
                if context.capture is not None:
                    seen = whole, candidates.goals, candidates.target_steps
                    probability = probability * context.capture.probability(*seen)
            best, reachable = self._choose(candidates, kept, eta_steps, probability)
        goals, target_steps = candidates.goals, candidates.target_steps
        return Meeting(
            goal=goals.gather(-2, best.unsqueeze(-1).expand(*best.shape, goals.shape[-1])).squeeze(-2),
            arrival_steps=target_steps.expand(goals.shape[:-1]).gather(-1, best).squeeze(-1),
            clamped=torch.zeros_like(reachable),
            reachable=reachable,
        )

    def _ask(self, goals: Tensor, eta: ArrivalQuery, tool_pos: Tensor | None) -> tuple[Tensor, Arrival]:
        """Control steps (*B, K) to each goal (*B, K, D), infinitely many where the robot never arrives; the arrival."""
        arrival = eta(goals, estimator="distribution" if self.probability_weight > 0.0 else "expectation")
        eta_steps = arrival.steps.masked_fill(arrival.never, torch.inf)
        if tool_pos is None or self.arrival_radius == 0.0:
            return eta_steps, arrival
        away = (goals[..., :2] - tool_pos.unsqueeze(-2)[..., :2]).square().sum(-1)
        return eta_steps.masked_fill(away < self.arrival_radius**2, 0.0), arrival

    def _choose(
        self, candidates: Candidates, kept: Tensor | None, eta_steps: Tensor, probability: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Index (*B, 1) of the best candidate, and whether any is in time (*B,), for a robot that needs so long."""
        score = candidates.score
        early = candidates.target_steps - self.descent_steps - eta_steps
        slack = early - self.margin
        if kept is not None:
            score = torch.add(score, kept, alpha=self.switching_cost)
            slack = torch.where(kept, early, slack)
        if probability is not None:
            score = score + self.probability_weight * probability
        in_time, late = slack >= 0.0, slack.clamp(min=-LATEST)
        if candidates.dwell_steps is not None:
            never = candidates.dwell_steps == 0
            in_time, late = in_time & ~never, torch.add(late, never, alpha=-LATE_OUT_OF_REACH)
        if candidates.lost is not None:
            in_time, late = in_time & ~candidates.lost, torch.add(late, candidates.lost, alpha=-LATE_LOST)
        some = in_time.any(dim=-1, keepdim=True)
        score = torch.where(some, torch.where(in_time, score, -torch.inf), late)
        return score.argmax(dim=-1, keepdim=True), some.squeeze(-1)

    def candidates(self, path: Tensor, lost: Lost | None = None) -> Candidates:
        """Where and when a target could be met that is along ``path`` (*B, F + 1, D) now and in 1 … F steps."""
        first = min(self.first, path.shape[-2] - 1)
        steps = torch.arange(first, path.shape[-2], self.stride, device=path.device)
        places = path[..., first :: self.stride, :]
        waited = places if self.early_steps == 0 else path[..., (steps - self.early_steps).clamp_min(0), :]
        goals, gone = self.goals(waited), None if lost is None else lost.forecast(path)
        cost = self.waiting_cost * steps
        if self.base_pos is not None:
            x, y = self.base_pos
            away = torch.hypot(goals[..., 0] - x, goals[..., 1] - y)
            cost = cost + self.axis_cost * ((self.axis_radius - away) / self.axis_edge).clamp(0.0, 1.0)
        lost_there = None if gone is None else gone[..., first :: self.stride]
        if self.footprint == 0.0:
            return Candidates(steps, places, goals, steps, 1 - cost, None, lost_there)
        before, dwell = self.dwells(path, goals, first, gone)
        return Candidates(steps, places, goals, steps - before, dwell - cost, dwell, lost_there)

    def goals(self, places: Tensor) -> Tensor:
        """Where the tool is sent to meet a target at ``places`` (*B, D) [m, world]."""
        if self.offset is not None:
            if len(self.offset) != places.shape[-1]:
                raise InputError(f"offset has {len(self.offset)} numbers, but places {places.shape[-1]} coordinates")
            places = places + places.new_tensor(self.offset)
        level = places[..., :2]
        if self.half_extent is not None:
            level = level.clamp(-self.half_extent, self.half_extent)
        if self.height is not None and places.shape[-1] > 2:
            return torch.nn.functional.pad(level, (0, 1), value=self.height)
        return places if self.half_extent is None else torch.cat([level, places[..., 2:]], dim=-1)

    def dwells(self, path: Tensor, goals: Tensor, first: int, gone: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """How many steps before each candidate the target is at its place already, and how long it dwells in all.

        Args:
            path: ``(*B, F + 1, D)`` [m, world], the target now and in 1 … F steps.
            goals: ``(*B, K, D)`` [m, world], at every ``stride``-th position of the path from the ``first`` on.
            first: step of the first candidate.
            gone: ``(*B, F + 1)`` bool: where the target is lost, and dwells nowhere.

        Returns:
            Both ``(*B, K)`` int64, in control steps; the dwelling is 0 where the target never comes within the
            footprint. Neither the past counts nor what comes after the forecast.
        """
        longest, level = self.longest_dwell, path[..., :2]
        if gone is not None:
            level = level.masked_fill(gone.unsqueeze(-1), torch.inf)
        level = torch.nn.functional.pad(level, (0, 0, longest, longest), value=torch.inf)
        # Windows around the candidates are views: nothing is copied before the difference.
        around = level[..., first:, :].unfold(-2, 2 * longest + 1, self.stride)
        inside = (around - goals[..., :2].unsqueeze(-1)).abs().amax(-2) <= self.footprint
        number = torch.arange(longest + 1, device=path.device)
        # Steps inside up to the candidate but for itself, -1 if it is not inside; and from it on.
        before = longest - 1 - number.masked_fill(inside[..., : longest + 1], -1).amax(-1)
        after = number.masked_fill(inside[..., longest:], longest + 1).amin(-1)
        return before.clamp_min(0), (before + after).clamp(0, longest)


def check_context(path: Tensor, target_pos: Tensor, context: SearchContext = NO_CONTEXT) -> None:
    """Raise `InputError` where a shape is wrong."""
    batch, size = target_pos.shape[:-1], target_pos.shape[-1] if target_pos.ndim else 0
    if size not in POINT_SIZES or path.ndim < 2 or path.shape != (*batch, path.shape[-2], size):
        size = check_points("target_pos", target_pos)
        check_trailing_shape("forecast", path, *batch, path.shape[-2] if path.ndim > 1 else 1, size)
    if context.tool_pos is not None and context.tool_pos.shape != target_pos.shape:
        check_trailing_shape("tool_pos", context.tool_pos, *batch, size)
    if context.planned_steps is not None and context.planned_steps.shape != batch:
        check_trailing_shape("planned_steps", context.planned_steps, *batch)


def choose_nearby(
    choose: Callable[[Tensor], tuple[Tensor, Tensor]], ask: Callable[[Tensor], Tensor], goals: Tensor, coarse: int
) -> tuple[Tensor, Tensor]:
    """What ``choose`` returns when it knows the steps needed to every ``coarse``-th goal, and to those near its choice.

    Args:
        choose: makes its choice from the steps needed to each goal ``(*B, K)``; returns its index ``(*B, 1)`` first.
        ask: maps goals ``(*B, k, D)`` to the steps needed ``(*B, k)``; called twice.
        goals: ``(*B, K, D)``, along a path: from one to the next the steps needed change little.
        coarse: first every so many goals are asked for, then as many and one around the best guess.
    """
    count = goals.shape[-2]
    eta_steps = ask(goals[..., ::coarse, :])
    # Between them the steps needed are interpolated: a product with a triangle for each goal that is known.
    place = (torch.arange(count, device=goals.device) / coarse).clamp(max=eta_steps.shape[-1] - 1)
    nodes = torch.arange(eta_steps.shape[-1], device=goals.device).unsqueeze(-1)
    shares = (1.0 - (place - nodes).abs()).clamp_min(0.0).to(eta_steps.dtype)
    guess, _ = choose(exact_product(eta_steps.clamp(max=1e4), shares))
    # Goals before the guess may do as well, and were not asked for; after it, the next one asked for is not far.
    width = min(coarse + 1, count)
    window = (guess - coarse + 1).clamp(0, count - width) + torch.arange(width, device=goals.device)
    known = torch.full_like(goals[..., 0], torch.inf, dtype=eta_steps.dtype)
    known[..., ::coarse] = eta_steps
    nearby = goals.gather(-2, window.unsqueeze(-1).expand(*window.shape, goals.shape[-1]))
    return choose(known.scatter(-1, window, ask(nearby)))


def meeting_probability(
    arrival: Arrival,
    eta_steps: Tensor,
    time: Tensor,
    spread: Spread | None,
    offset: Tensor,
    *,
    half_width: float,
) -> Tensor:
    """Probability of each of K meetings, ``(*B, K)`` in 0 … 1: P(robot there by ``time``) · P(target there).

    Arrival time and forecast error are taken to be independent, and so are the errors along x and y.

    Args:
        arrival: at the goals; one without a distribution is there for certain after ``eta_steps``.
        eta_steps: ``(*B, K)`` control steps to each goal, 0 for one that is reached now.
        time: ``(*B, K)`` control steps from now at which the robot should be there.
        spread: of the forecast at each meeting; ``(*B, K, 2)``, ``gone`` ``(*B, K)``. None: no error.
        offset: ``(*B, K, 2)`` of each goal from the forecast place [m].
        half_width: a target within it of the goal, along both axes, is there [m].
    """
    there = (eta_steps <= time).to(offset.dtype)
    if arrival.bins is not None:
        there = torch.where(eta_steps <= 0.0, there, arrival.by(time))
    if spread is None:
        return there * (offset.abs() <= half_width).all(-1)
    return there * spread.between(offset, half_width).prod(-1) * (1.0 - spread.gone)
