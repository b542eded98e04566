"""Curves of success rates, as papers print them."""

import bisect

Curve = tuple[list[float], list[float]]
"""Abscissae, ascending, and the success rate at each."""


def rate_at(curve: Curve, x: float) -> float | None:
    """Success rate at ``x``, on straight lines between the curve's points; None beyond them."""
    xs, ys = curve
    if not xs[0] <= x <= xs[-1]:
        return None
    right = min(bisect.bisect_right(xs, x), len(xs) - 1)
    share = (x - xs[right - 1]) / (xs[right] - xs[right - 1])
    return ys[right - 1] + share * (ys[right] - ys[right - 1])
