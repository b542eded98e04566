"""How likely a meeting is: that the robot is there in time, and that the target comes to where it is forecast."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchdyn_plan.nets.eta import Arrival
    from torchdyn_plan.nets.spread import Spread


def meeting_odds(
    arrival: Arrival,
    needed: Tensor,
    time: Tensor,
    spread: Spread | None,
    offset: Tensor,
    *,
    half_width: float,
) -> Tensor:
    """Probability of each of K meetings, ``(*B, K)`` in 0 … 1: P(robot there by ``time``) · P(target there).

    Arrival time and forecast error are taken to be independent, and so are the errors along x and y.

    Args:
        arrival: at the goals; if it is no `ArrivalOdds`, the robot is there for certain after ``needed`` steps.
        needed: ``(*B, K)`` control steps to each goal, 0 for one that is reached now.
        time: ``(*B, K)`` control steps from now at which the robot should be there.
        spread: of the forecast at each meeting; ``(*B, K, 2)``, ``gone`` ``(*B, K)``. None: no error.
        offset: ``(*B, K, 2)`` of each goal from the forecast place [m].
        half_width: a target within it of the goal, along both axes, is there [m].
    """
    there = (needed <= time).to(offset.dtype)
    by = getattr(arrival, "by", None)
    if by is not None:
        there = torch.where(needed <= 0.0, there, by(time))
    if spread is None:
        return there * (offset.abs() <= half_width).all(-1)
    return there * spread.between(offset, half_width).prod(-1) * (1.0 - spread.gone)
