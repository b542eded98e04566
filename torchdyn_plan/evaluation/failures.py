"""What went wrong in an episode: one cause for each that failed, from what was recorded in it."""

import torch
from torch import Tensor

from torchdyn_plan.evaluation.evidence import Evidence

CAUSES = ("unreachable", "planner_too_slow", "forecast", "eta", "early_contact", "pocketed", "late")
"""In the order in which they are asked; `failure_cause` has their rules."""

SUCCESS = -1
"""Code of an episode that did not fail."""
FORECAST_TOLERANCE = 0.04
"""A ball that comes no nearer than this to the promised place about the promised time is elsewhere [m]."""
ETA_TOLERANCE = 5
"""An arm that comes later than promised by more than this is late: a bin of the arrival predictor [control steps]."""


def failure_cause(trapped: Tensor, solvable: Tensor, touched: Tensor, pocketed: Tensor, evidence: Evidence) -> Tensor:
    """Index into `CAUSES` of the first cause that holds, or `SUCCESS`; int64 ``(*B,)``.

    - unreachable: not solvable, so nothing that the planner does can help.
    - planner_too_slow: it made plans, but none promised a meeting that the arm could be in time for.
    - forecast: the ball did not come to the promised place about the promised time (`FORECAST_TOLERANCE`).
    - eta: the arm came to its goal later than promised, by more than `ETA_TOLERANCE`, or never.
    - early_contact: the ball ran into a box that was down already, or rested where the box came down.
    - pocketed: no meeting was promised, nothing was touched, and the ball fell into a pocket.
    - late: all else. The box came down behind the ball or not at all, or time ran out.

    Args:
        trapped: ``(*B,)`` bool, the ball is covered and kept, whatever else happened.
        solvable: ``(*B,)`` bool, the static planner could have been at some future place of the ball in time
            (paper, Section IV-B).
        touched: ``(*B,)`` bool, the ball met the outside of the box.
        pocketed: ``(*B,)`` bool, the ball fell into a pocket.
        evidence: ``(*B,)`` each.
    """
    elsewhere = evidence.promised & (evidence.forecast_error > FORECAST_TOLERANCE)
    arm_late = evidence.promised & (evidence.eta_error > ETA_TOLERANCE)
    holds = torch.stack(
        [
            ~solvable, evidence.planned & ~evidence.promised, elsewhere, arm_late, touched & ~evidence.receding,
            pocketed & ~touched & ~evidence.promised, torch.ones_like(trapped),
        ],
        dim=-1,
    )  # fmt: skip
    return torch.where(trapped, SUCCESS, holds.to(torch.int64).argmax(dim=-1))


def failure_shares(causes: Tensor) -> dict[str, float]:
    """Share of all episodes that failed of each cause, from codes ``(E,)`` of `failure_cause`."""
    counts = torch.bincount(causes[causes != SUCCESS], minlength=len(CAUSES))
    return {name: count / max(len(causes), 1) for name, count in zip(CAUSES, counts.tolist(), strict=True)}
