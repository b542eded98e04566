"""The paper's success rates on Trapper, read off its Figure 4, to stand beside ours."""

import bisect
import json
from functools import cache
from importlib.resources import files
from typing import Any, Literal

Sweep = Literal["velocity", "friction"]
"""What the paper varied: the ball's velocity [m/s] without friction, or its friction loss at `FRICTION_VELOCITY`."""

FRICTION_VELOCITY = 3.0
"""Velocity of the ball in the paper's friction sweep [m/s]."""

_CURVES = {"corner": "dynamic", "pursuit": "pursuit", "oracle": "oracle"}
"""Our names of the paper's planners, and the words that its curves carry."""
_REACH = {"corner": "dynamic", "dher": "dher"}
"""The same for Reach."""


@cache
def _figures() -> dict[str, Any]:
    return json.loads(files("torchdyn_plan.evaluation").joinpath("paper_curves.json").read_text())


def paper_reach(method: str) -> tuple[list[float], list[float]]:
    """The paper's Figure 5, right: goal velocities [m per control step] and success rates.

    ``method`` is ``dynamic``, its own planner, or ``dher``, the rival that learns.
    """
    curve = _figures()["reach_velocity"][method]
    return curve["x"], curve["y"]


def paper_curve(planner: str, static: str, over: Sweep, *, solvable: bool) -> tuple[list[float], list[float]] | None:
    """The paper's curve as abscissae and success rates, or None for a planner that the paper does not have.

    Args:
        planner: ``corner`` (the paper's *Ours*), ``pursuit`` or ``oracle``; any other name has no curve.
        static: ``ik`` or ``rl``.
        over: ``velocity`` or ``friction``.
        solvable: rates over solvable episodes only, instead of all.
    """
    panel = _figures()[f"trapper_{over}_{'solvable' if solvable else 'all'}"]
    curve = panel.get(f"{_CURVES.get(planner)}_{static}")
    return None if curve is None else (curve["x"], curve["y"])


def paper_rate(planner: str, static: str, over: Sweep, x: float, *, solvable: bool) -> float | None:
    """The paper's success rate at ``x``, between its points by straight lines; None where its curve does not reach."""
    return _between(paper_curve(planner, static, over, solvable=solvable), x)


def _between(curve: tuple[list[float], list[float]] | None, x: float) -> float | None:
    """Rate at ``x`` on straight lines between a curve's points; None beyond them."""
    if curve is None or not curve[0][0] <= x <= curve[0][-1]:
        return None
    xs, ys = curve
    right = min(bisect.bisect_right(xs, x), len(xs) - 1)
    share = (x - xs[right - 1]) / (xs[right] - xs[right - 1])
    return ys[right - 1] + share * (ys[right] - ys[right - 1])


def paper_rate_at(
    planner: str,
    static: str,
    velocity: float,
    friction: float,
    *,
    solvable: bool,
    task: str = "trapper",
    motion: str = "straight",
) -> float | None:
    """The paper's success rate for a target of this velocity and friction loss; None if it never ran that."""
    if task == "reach":
        known = planner in _REACH and motion == "straight" and not solvable
        return _between(paper_reach(_REACH[planner]), velocity) if known else None
    if friction == 0.0:
        return paper_rate(planner, static, "velocity", velocity, solvable=solvable)
    if velocity == FRICTION_VELOCITY:
        return paper_rate(planner, static, "friction", friction, solvable=solvable)
    return None
