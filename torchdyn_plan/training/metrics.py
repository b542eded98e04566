"""How far forecasts and arrival times are off, on windows and runs that no network was fitted to."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.nets.eta import READINGS
from torchdyn_plan.nets.spread import Spread
from torchdyn_plan.training.windows import Windows

AHEAD = (25, 100, 300)
"""Control steps ahead at which forecasts are scored; those beyond a network's horizon are left out."""
STILL = 0.05
"""Joint speed below which an arm is at rest [rad/s]."""
FAST = 0.004
"""Motion from which a target is fast [m a step]."""
SHARES = (0.5, 0.8, 0.9, 0.95)
"""Probabilities of the intervals whose coverage is reported."""
NEAR = 0.055
"""Distance along both axes within which a waiting box has the target [m]."""
SOON = 30
"""Arrivals within fewer steps than this are scored apart too."""


def forecast_errors(
    forecast: Tensor, windows: Windows, *, ahead: Sequence[int] = AHEAD, fast: float = FAST
) -> list[dict[str, Any]]:
    """Distances between forecast and truth, beside those of constant velocity.

    Windows whose target moves are told apart: ``full`` and ``padded`` histories of targets that stay on the table,
    those of them that are ``fast`` at the present, and ``pocketed`` ones, scored while the target is not yet swallowed.
    Targets that lie still are ``still``.

    Args:
        forecast: ``(n, F, 3)`` [m, world], on the table (not unfolded).
        windows: of n targets, whose ``future`` is the path itself.
        ahead: control steps ahead that are scored, but for those beyond the horizon.
        fast: motion from which a target is fast [m a step].

    Returns:
        A row for each kind of window and each of ``ahead``: ``windows, ahead, count, median, mean,
        constant_velocity`` (its median) [m]; errors are None where no window counts.
    """
    now, step = windows.history[:, -1], windows.history[:, -1] - windows.history[:, -2]
    rows = []
    for kind, chosen in _kinds(windows, fast).items():
        for steps in (steps for steps in ahead if steps <= forecast.shape[-2]):
            scored = chosen & windows.recorded[:, steps - 1]
            truth = windows.future[scored, steps - 1]
            error = (forecast[scored, steps - 1] - truth).norm(dim=-1)
            straight = (now[scored] + steps * step[scored] - truth).norm(dim=-1)
            figures = {"median": _median(error), "mean": _mean(error), "constant_velocity": _median(straight)}
            rows.append({"windows": kind, "ahead": steps, "count": int(scored.sum())} | figures)
    return rows


def _kinds(windows: Windows, fast: float = FAST) -> dict[str, Tensor]:
    """Masks ``(n,)`` of the windows that are scored together."""
    padded = windows.history_length < windows.history.shape[-2]
    stays, moving = ~windows.pocketed, windows.moving
    step = windows.history[:, -1] - windows.history[:, -2]
    return {
        "full": moving & stays & ~padded,
        "padded": moving & stays & padded,
        "fast": moving & stays & (step.norm(dim=-1) >= fast),
        "pocketed": moving & windows.pocketed,
        "still": ~moving,
    }


def coverage(forecast: Tensor, spread: Spread, windows: Windows) -> list[dict[str, Any]]:
    """How often errors lie within the intervals that should hold a share of them, axes pooled.

    Args:
        forecast: ``(n, F, 3)`` [m, world].
        spread: of the forecasts.
        windows: of n targets, whose ``future`` is the path itself.

    Returns:
        A row for each kind of window (as `forecast_errors` tells them apart) and each of `AHEAD`: ``windows, ahead,
        count, within_50, within_80, within_90, within_95`` shares of errors, the median ``half_width_90`` [m], and
        the mean probability ``near_told`` of being within `NEAR` along both axes beside its share ``near``.
    """
    error = (forecast - windows.future)[..., :2].abs()
    rows = []
    for kind, chosen in _kinds(windows).items():
        for ahead in (ahead for ahead in AHEAD if ahead <= forecast.shape[-2]):
            scored = chosen & windows.recorded[:, ahead - 1]
            told = Spread(*(part[scored, ahead - 1] for part in spread))
            size = error[scored, ahead - 1]
            held = {f"within_{100 * s:.0f}": _mean((size <= told.interval(s)).float().mean(-1)) for s in SHARES}
            near = _mean((size <= NEAR).all(-1).float())
            told_near = _mean(told.within(NEAR).prod(-1))
            width = {"half_width_90": _median(told.interval(0.9).flatten()), "near_told": told_near, "near": near}
            rows.append({"windows": kind, "ahead": ahead, "count": int(scored.sum())} | held | width)
    return rows


def swallowed_odds(spread: Spread, windows: Windows) -> list[dict[str, Any]]:
    """Probability of being swallowed beside its share among moving targets, and its mean square error (Brier).

    ``brier_share`` is that of always telling the share.
    """
    rows = []
    for ahead in (ahead for ahead in AHEAD if ahead <= spread.gone.shape[-1]):
        truth = (~windows.recorded[windows.moving, ahead - 1]).float()
        told = spread.gone[windows.moving, ahead - 1]
        brier, share = _mean((told - truth).square()), _mean(truth)
        spare = None if share is None else share * (1.0 - share)
        row = {"ahead": ahead, "count": len(truth), "told": _mean(told), "share": share}
        rows.append(row | {"brier": brier, "brier_share": spare})
    return rows


def pocket_accuracy(forecast: Tensor, windows: Windows) -> dict[str, Any]:
    """How well a negative height at the horizon's end tells swallowed targets from the rest, among moving ones.

    Returns:
        ``count`` of windows, ``pocketed`` share of them, ``found`` share of the swallowed that are forecast so, and
        ``false`` share of the others that are forecast swallowed; shares are None where there are none.
    """
    sunk = forecast[windows.moving, -1, 2] < 0.0
    truth = windows.pocketed[windows.moving]
    return {
        "count": len(truth),
        "pocketed": _mean(truth.float()),
        "found": _mean(sunk[truth].float()),
        "false": _mean(sunk[~truth].float()),
    }


def arrival_groups(arrival: Tensor, rest: Tensor) -> dict[str, Tensor]:
    """Masks ``(n,)`` of the samples that are scored together in any task.

    Args:
        arrival: ``(n,)`` control steps, negative for never.
        rest: ``(n,)`` bool: the robot is at rest.
    """
    soon = (arrival >= 0) & (arrival < SOON)
    return {"all": torch.ones_like(rest), "soon": soon, "at rest": rest, "in motion": ~rest}


def arrival_errors(
    logits: Tensor, arrival: Tensor, groups: Mapping[str, Tensor], *, bin_width: int = 5
) -> list[dict[str, Any]]:
    """Errors of arrival times where the robot arrives within the bins, and how often *never* is told rightly.

    Args:
        logits: ``(n, bins + 1)``.
        arrival: ``(n,)`` control steps, negative or beyond the bins for never.
        groups: masks ``(n,)`` by name, as from `arrival_groups`.
        bin_width: control steps in a bin.

    Returns:
        A row for each group and each reading of the distribution: ``samples, reading, count`` (of arrivals), ``mean``
        and ``p95`` absolute error and ``bias`` [control steps], ``never_accuracy`` over all of the group; None where
        nothing counts.
    """
    never = (arrival < 0) | (arrival >= bin_width * (logits.shape[-1] - 1))
    rows = []
    for reading, decode in READINGS.items():
        read = decode(logits, bin_width=bin_width)
        difference = read.steps - arrival
        for name, group in groups.items():
            error = difference[group & ~never]
            size = error.abs()
            figures = {"mean": _mean(size), "p95": _quantile(size, 0.95), "bias": _mean(error)}
            told = _mean((read.never == never)[group].float())
            head = {"samples": name, "reading": reading, "count": len(error)}
            rows.append(head | figures | {"never_accuracy": told})
    return rows


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if len(values) else None


def _median(values: Tensor) -> float | None:
    return _quantile(values, 0.5)


def _quantile(values: Tensor, share: float) -> float | None:
    """Without `torch.quantile`'s limit on the number of values; the nearest rank, rounded up."""
    if not len(values):
        return None
    rank = min(len(values), max(1, -int(-share * len(values) // 1)))
    return float(values.kthvalue(rank).values)
