"""Goal searches with a temperature: gradients pass from goal and meeting time to forecast, networks and robot state.

As the temperature falls they tend to the hard searches of `torchdyn_plan.planners.search.exact` and `.search`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.search.corner import CORNERS
from torchdyn_plan.planners.search.exact import (
    LATE_LOST,
    LATE_OUT_OF_REACH,
    LATEST,
    Candidates,
    ExactSearch,
    check_context,
)
from torchdyn_plan.planners.search.meeting import NO_CONTEXT, Meeting, SearchContext
from torchdyn_plan.precision import exact_product

if TYPE_CHECKING:
    from torchdyn_plan.nets.arrival import ArrivalQuery
    from torchdyn_plan.nets.forecast import Forecast

SURE = 1000.0
"""Control steps that a whole probability counts as: a goal that is never reached is as bad as one 500 steps late."""

LATENESS = 4.0
"""Steps of score that a step of lateness outweighs, and more."""


@dataclass(frozen=True, kw_only=True)
class SoftExactSearch:
    """Soft form of `ExactSearch`: a mean over candidates instead of the best one.

    Candidate k, met in t_k steps, has the hard search's score S_k (in steps, ``point`` of them for a point; with a
    ``capture`` in the context, its probability counts ``probability_weight`` points), the slack
    s_k = t_k - descent - margin - e_k with the mean arrival time e_k, and the probability a_k that the robot arrives at
    all. With the temperature T

        w = softmax_k [ S_k / T + 4 (1 + 1/T) (ln σ(s_k / T) + ln σ(1000 (a_k - 1/2) / T)) ],
        goal = Σ w_k g_k,  time = Σ w_k t_k.

    A step of lateness weighs more than four steps of score, and ever more as T → 0: those in time are left, or the
    least late one if there is none, and of these the highest score. Stays and steps are whole numbers: constants for
    the gradient.
    """

    search: ExactSearch = field(default_factory=ExactSearch)
    """The hard search, whose candidates, scores and times are taken; ``arrival_radius`` and ``coarse`` do not count."""
    temperature: float = 2.0
    """T [control steps]."""
    point: float = 50.0
    """Control steps that a point of score is worth."""

    def __post_init__(self) -> None:
        check_number("temperature", self.temperature, minimum=1e-3)
        check_number("point", self.point, minimum=0.0)

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """Choose a meeting.

        Args:
            forecast: of the target in 1 … F control steps.
            target_pos: ``(*B, D)`` [m, world], the target now.
            eta: maps goals ``(*B, K, D)`` to arrivals ``(*B, K)``; called once, with ``estimator="soft"``.
            context: of which it reads when a target is lost, and the probability of a capture.

        Returns:
            The meeting, with ``arrival_steps`` in the forecast's dtype; ``reachable`` where it is rather in time.

        Raises:
            InputError: an argument has another shape, or their batches differ.
        """
        check_context(forecast.path, target_pos, context)
        hard, heat = self.search, self.temperature
        whole = torch.cat([target_pos.unsqueeze(-2), forecast.path], dim=-2)
        candidates = hard.candidates(whole, context.lost)
        arrival = eta(candidates.goals, estimator="soft")
        target_steps = candidates.target_steps.to(forecast.path.dtype).expand(arrival.steps.shape)
        # A model that knows for certain may say never by infinite steps and a bool: finite numbers keep goals finite.
        eta_steps = arrival.steps.clamp(max=LATEST)
        in_time = logsigmoid((target_steps - hard.descent_steps - hard.margin - eta_steps) / heat)
        never = arrival.never.to(arrival.steps.dtype)
        gate = in_time + logsigmoid(SURE * (0.5 - never) / heat)
        strict = LATENESS * (1.0 + 1.0 / heat)
        score = candidates.score
        if context.capture is not None:
            captured = context.capture.probability(whole, candidates.goals, candidates.target_steps)
            score = score + hard.probability_weight * captured
        worth = self.point * score / heat + strict * (gate - _apart(candidates) / heat)
        weights = worth.softmax(dim=-1)
        return Meeting(
            goal=exact_product(weights.unsqueeze(-2), candidates.goals).squeeze(-2),
            arrival_steps=(weights * target_steps).sum(dim=-1),
            clamped=torch.zeros_like(target_pos[..., 0], dtype=torch.bool),
            reachable=(weights * gate.exp()).sum(dim=-1) > 0.25,
        )


@dataclass(frozen=True, kw_only=True)
class SoftCornerSearch:
    """Soft form of `CornerSearch` with ``estimator="expectation"``: a mean over the corners, on the path between steps.

    With mean arrival times e and the path s̃ read linearly between steps, the corners c_i of the square of half-edge
    d = D(s̃(e_t), s_t) are missed by m_i = D(c_i, s̃(e_i)), and the robot arrives at them with probability a_i. Then

        w = softmax_i [ (-m_i + ln σ((a_i - 1/2) / T)) / T ],  goal = Σ w_i s̃(e_i),  time = Σ w_i e_i.

    As T → 0 the nearest corner that is reached remains; the hard search also rounds its time to a whole step. Where no
    corner is reached the likeliest remains, rather than the nearest.
    """

    temperature: float = 0.05
    """T [m]."""

    def __post_init__(self) -> None:
        check_number("temperature", self.temperature, minimum=1e-4)

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """Choose a meeting, as `SoftExactSearch` does; ``eta`` is called for one goal, then for four."""
        check_context(forecast.path, target_pos, context)
        horizon, heat = forecast.path.shape[-2], self.temperature
        now = target_pos.unsqueeze(-2)
        path = torch.cat([now, forecast.path], dim=-2)
        here = eta(now, estimator="soft").steps
        half_edge = torch.linalg.vector_norm(between(path, here) - now, dim=-1, keepdim=True)
        corners = now + half_edge * path.new_tensor(CORNERS)[:, : path.shape[-1]]
        steps, never = eta(corners, estimator="soft")[:2]
        never = never.to(steps.dtype)
        met = between(path, steps)
        miss = torch.linalg.vector_norm(corners - met, dim=-1)
        weights = ((logsigmoid((0.5 - never) / heat) - miss) / heat).softmax(dim=-1)
        return Meeting(
            goal=exact_product(weights.unsqueeze(-2), met).squeeze(-2),
            arrival_steps=(weights * steps.clamp(0.0, horizon)).sum(dim=-1),
            clamped=(weights * (steps > horizon)).sum(dim=-1) + (here.squeeze(-1) > horizon) > 0.5,
            reachable=(weights * never).sum(dim=-1) < 0.5,
        )


def _apart(candidates: Candidates) -> Tensor:
    """Control steps that candidates where the target is lost, or never comes, count as later, as in the hard search."""
    apart = torch.zeros_like(candidates.goals[..., 0])
    if candidates.lost is not None:
        apart = apart + LATE_LOST * candidates.lost
    return apart if candidates.dwell_steps is None else apart + LATE_OUT_OF_REACH * (candidates.dwell_steps == 0)


def between(path: Tensor, steps: Tensor) -> Tensor:
    """Places (*B, K, D) on ``path`` (*B, T, D) at ``steps`` (*B, K), linear between whole steps, cut to 0 … T - 1.

    The gradient reaches path and steps, but not steps that are cut.
    """
    last = path.shape[-2] - 1
    inside = steps.clamp(0.0, float(last))
    before = inside.detach().floor().clamp(max=max(last - 1, 0))
    index = before.to(torch.int64).unsqueeze(-1).expand(*steps.shape, path.shape[-1])
    start, end = path.gather(-2, index), path.gather(-2, (index + 1).clamp(max=last))
    return torch.lerp(start, end, (inside - before).unsqueeze(-1))
