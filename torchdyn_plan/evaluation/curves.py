"""Curves of success rates, as papers print them, and the figures that hold them."""

import bisect
from collections.abc import Mapping
from typing import Any, NamedTuple

Curve = tuple[list[float], list[float]]
"""Abscissae, ascending, and the success rate at each."""


class PaperLine(NamedTuple):
    """A curve of a paper's figure: a planner for the moving target on a static planner, by our names of them."""

    planner: str
    static: str
    label: str
    """As the legend has it."""


class PaperPanel(NamedTuple):
    """One diagram of a paper's figure: success rates over a setting."""

    figure: str
    """Name of the file that the figure is drawn into."""
    place: tuple[int, int]
    """Row and column in the figure, from 0."""
    title: str
    over: str
    """Setting along the axis."""
    settings: Mapping[str, Any]
    """The other settings; those left out are at their defaults."""
    lines: tuple[PaperLine, ...]
    solvable: bool = False
    """Of solvable episodes, not of all."""
    scene: str = ""
    """Scene of the task in which it is measured; the first one when empty."""


class PaperMoments(NamedTuple):
    """A number line of a paper's figure: moments of an episode, a row for the paper's and a row for ours."""

    figure: str
    place: tuple[int, int]
    title: str
    axis: str
    """Name of the axis, with its unit."""
    end: float
    """Where the axis ends; it begins at 0."""
    rows: Mapping[str, list[int]]
    """Moments by the name of their row."""


def rate_at(curve: Curve, x: float) -> float | None:
    """Success rate at ``x``, on straight lines between the curve's points; None beyond them."""
    xs, ys = curve
    if not xs[0] <= x <= xs[-1]:
        return None
    right = min(bisect.bisect_right(xs, x), len(xs) - 1)
    share = (x - xs[right - 1]) / (xs[right] - xs[right - 1])
    return ys[right - 1] + share * (ys[right] - ys[right - 1])
