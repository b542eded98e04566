"""What went wrong in an episode, in four words."""

import torch
from torch import Tensor

CAUSES = ("out_of_reach", "too_early", "pocketed", "too_late")
"""In the order in which they are asked: the ball could not be had at all; it bounced off the outside of a box that
was down already; it fell into a pocket; or time ran out."""

SUCCESS = -1
"""Code of an episode that did not fail."""


def failure_cause(trapped: Tensor, solvable: Tensor, touched: Tensor, pocketed: Tensor) -> Tensor:
    """Index into `CAUSES` of the first cause that holds, or `SUCCESS`; int64 ``(*B,)`` from bools ``(*B,)``.

    Args:
        trapped: the ball is covered and kept, whatever else happened.
        solvable: the static planner could have been at some future place of the ball in time (paper, Section IV-B).
        touched: the ball bounced off the outside of the box.
        pocketed: the ball fell into a pocket.
    """
    last = torch.ones_like(trapped)
    holds = torch.stack([~solvable, touched, pocketed, last], dim=-1)
    first = holds.to(torch.int64).argmax(dim=-1)
    return torch.where(trapped, SUCCESS, first)


def failure_shares(causes: Tensor) -> dict[str, float]:
    """Share of all episodes that failed of each cause, from codes ``(E,)`` of `failure_cause`."""
    counts = torch.bincount(causes[causes != SUCCESS], minlength=len(CAUSES))
    return {name: count / max(len(causes), 1) for name, count in zip(CAUSES, counts.tolist(), strict=True)}
