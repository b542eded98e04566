"""Where and when robot and target will meet: the choice of a goal on a forecast path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_points, check_trailing_shape
from torchdyn_plan.planners.search.meeting import NO_CONTEXT, Meeting, SearchContext

if TYPE_CHECKING:
    from torchdyn_plan.nets.arrival import ArrivalQuery
    from torchdyn_plan.nets.distributions import Arrival
    from torchdyn_plan.nets.forecast import Forecast

CORNERS = ((1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0), (-1.0, 1.0, 0.0))
"""Of a level square around the target, in half-edges; in a plane without the last coordinate."""


@dataclass(frozen=True, kw_only=True)
class CornerSearch:
    """The paper's search: the corners of a square around the target, in two passes of the arrival predictor."""

    estimator: Literal["mode", "expectation"] = "mode"
    """How a distribution of arrival times becomes one time: the likeliest bin, as in the paper, or its mean."""

    def __post_init__(self) -> None:
        check_choice("estimator", self.estimator, ("mode", "expectation"))

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """Choose a goal as `search_corners` does; the paper's search knows nothing of the context."""
        return search_corners(forecast.path, target_pos, partial(eta, estimator=self.estimator))


def search_corners(forecast: Tensor, target_pos: Tensor, eta: Callable[[Tensor], Arrival]) -> Meeting:
    """Approximate the meeting s̃_{e*} = g̃, ETA(g̃) = e* by four corners (paper, Section III-B.4).

    With the time to the target's present place, e_t = ETA(s_t), the square's half-edge is d = D(s̃_{e_t}, s_t). Of its
    corners c_i, reached in e_i = ETA(c_i) steps, c* is the one nearest to the forecast, argmin D(c_i, s̃_{e_i}); its
    time is e* and the goal g̃ = s̃_{e*}. D is the distance in space; the first of equal corners wins.

    A corner at which the robot never arrives is chosen only if it never arrives at any, which `reachable` tells.
    Where it never arrives, its time is the one that the predictor finds likeliest if it did.

    Args:
        forecast: ``(*B, F, D)`` [m, world], target positions in 1 … F control steps; a meeting in e steps is entry e-1.
        target_pos: ``(*B, D)`` [m, world], the target now: a meeting in 0 steps.
        eta: maps goals ``(*B, K, D)`` to arrivals ``(*B, K)``; called with K = 1, then with K = 4.

    Returns:
        The meeting; indices beyond the horizon are cut to F, which `clamped` tells.

    Raises:
        InputError: ``target_pos`` or ``forecast`` has another shape, or their batches differ.
    """
    size = check_points("target_pos", target_pos)
    horizon = forecast.shape[-2] if forecast.ndim > 1 else 1
    check_trailing_shape("forecast", forecast, *target_pos.shape[:-1], horizon, size)
    now = target_pos.unsqueeze(-2)
    path = torch.cat([now, forecast], dim=-2)

    here = eta(now)
    steps, beyond_here = _on_path(here.steps, horizon)
    away = _at(path, steps) - now
    half_edge = torch.linalg.vector_norm(away, dim=-1, keepdim=True)

    corners = torch.addcmul(now, half_edge, path.new_tensor(CORNERS)[:, :size])
    arrival = eta(corners)
    steps, beyond = _on_path(arrival.steps, horizon)
    met = _at(path, steps)
    miss = torch.linalg.vector_norm(corners - met, dim=-1)
    nowhere = arrival.never.all(dim=-1, keepdim=True)
    best = miss.masked_fill(arrival.never & ~nowhere, torch.inf).argmin(dim=-1, keepdim=True)
    return Meeting(
        goal=_at(met, best).squeeze(-2),
        arrival_steps=steps.gather(-1, best).squeeze(-1),
        clamped=(beyond.gather(-1, best) | beyond_here).squeeze(-1),
        reachable=~nowhere.squeeze(-1),
    )


def _on_path(steps: Tensor, horizon: int) -> tuple[Tensor, Tensor]:
    """Whole steps within 0 … horizon, int64, and whether ``steps`` lay beyond; both of the shape of ``steps``."""
    whole = steps.round()
    return whole.clamp(0, horizon).to(torch.int64), whole > horizon


def _at(path: Tensor, index: Tensor) -> Tensor:
    """Entries ``index`` (*B, K) of ``path`` (*B, T, D): (*B, K, D)."""
    return path.gather(-2, index.unsqueeze(-1).expand(*index.shape, path.shape[-1]))
