"""Errors of forecasts and arrival times on held-out windows and runs."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.nets.eta import ESTIMATORS
from torchdyn_plan.nets.spread import Spread
from torchdyn_plan.planners import Lost
from torchdyn_plan.training.capture_data import Captures
from torchdyn_plan.training.windows import Windows

FAST = 0.004
"""Speed from which a target is fast [m a step]."""
SHARES = (0.5, 0.8, 0.9, 0.95)
"""Probabilities of the intervals whose coverage is reported."""
NEAR = 0.05
"""Distance along both horizontal axes within which a waiting robot has the target [m]."""
CAPTURE_SPEEDS = (0.008, 0.014, 0.018)
"""Speeds between which attempts at a capture are scored together [m a step]."""
SOON = 30
"""Arrivals within fewer control steps than this are also scored separately."""


def forecast_errors(
    forecast: Tensor, windows: Windows, *, ahead: Sequence[int], fast: float = FAST
) -> list[dict[str, Any]]:
    """Distances between forecast and truth, with those of constant velocity for comparison.

    Windows are scored by kind: ``full`` and ``padded`` histories of moving targets that are not lost; those of them
    that are ``fast`` at the present; ``lost`` ones, scored until the target is lost; and ``still`` ones, whose target
    rests.

    Args:
        forecast: ``(n, F, 3)`` [m, world], as cushions reflect it.
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


def _kinds(windows: Windows, fast: float) -> dict[str, Tensor]:
    """Masks ``(n,)`` of the windows that are scored together."""
    padded = windows.history_length < windows.history.shape[-2]
    stays, moving = ~windows.lost, windows.moving
    step = windows.history[:, -1] - windows.history[:, -2]
    return {
        "full": moving & stays & ~padded,
        "padded": moving & stays & padded,
        "fast": moving & stays & (step.norm(dim=-1) >= fast),
        "lost": moving & windows.lost,
        "still": ~moving,
    }


def coverage(
    forecast: Tensor,
    spread: Spread,
    windows: Windows,
    *,
    ahead: Sequence[int],
    fast: float = FAST,
    near: float = NEAR,
) -> list[dict[str, Any]]:
    """Coverage: share of errors within the intervals of the spread, axes pooled.

    Args:
        forecast: ``(n, F, 3)`` [m, world].
        spread: of the forecasts.
        windows: of n targets, whose ``future`` is the path itself.
        ahead: control steps ahead that are scored, but for those beyond the horizon.
        fast: motion from which a target is fast [m a step].
        near: distance along both horizontal axes [m].

    Returns:
        A row for each kind of window (as in `forecast_errors`) and each of ``ahead``: ``windows, ahead, count,
        within_50, within_80, within_90, within_95`` shares of errors, the median ``half_width_90`` [m], the mean
        predicted probability ``near_predicted`` of being within ``near`` along both axes, and its actual share
        ``near``.
    """
    error = (forecast - windows.future)[..., :2].abs()
    rows = []
    for kind, chosen in _kinds(windows, fast).items():
        for steps in (steps for steps in ahead if steps <= forecast.shape[-2]):
            scored = chosen & windows.recorded[:, steps - 1]
            predicted = Spread(*(part[scored, steps - 1] for part in spread))
            size = error[scored, steps - 1]
            row = {"windows": kind, "ahead": steps, "count": int(scored.sum())}
            for share in SHARES:
                row[f"within_{100 * share:.0f}"] = _mean((size <= predicted.interval(share)).float().mean(-1))
            row["half_width_90"] = _median(predicted.interval(0.9).flatten())
            row["near_predicted"] = _mean(predicted.within(near).prod(-1))
            row["near"] = _mean((size <= near).all(-1).float())
            rows.append(row)
    return rows


def lost_probability(spread: Spread, windows: Windows, *, ahead: Sequence[int]) -> list[dict[str, Any]]:
    """Predicted probability of being lost and the actual share among moving targets, with the Brier score.

    ``brier_share`` is the score of predicting the share in every case.
    """
    rows = []
    for steps in (steps for steps in ahead if steps <= spread.gone.shape[-1]):
        truth = (~windows.recorded[windows.moving, steps - 1]).float()
        predicted = spread.gone[windows.moving, steps - 1]
        share = _mean(truth)
        row = {"ahead": steps, "count": len(truth), "predicted": _mean(predicted), "share": share}
        row["brier"] = _mean((predicted - truth).square())
        row["brier_share"] = None if share is None else share * (1.0 - share)
        rows.append(row)
    return rows


def lost_accuracy(forecast: Tensor, windows: Windows, lost: Lost) -> dict[str, Any]:
    """How well the end of the forecast identifies lost targets among moving ones.

    Args:
        forecast: ``(n, F, 3)`` [m, world].
        windows: of n targets.
        lost: decides when a forecast target counts as lost.

    Returns:
        ``count`` of windows, ``lost`` share of them, ``found`` share of the lost that are forecast lost, and ``false``
        share of the others that are forecast lost; shares are None if there are none.
    """
    forecast_lost = lost.forecast(forecast[windows.moving, -1:]).squeeze(-1)
    truth = windows.lost[windows.moving]
    return {
        "count": len(truth),
        "lost": _mean(truth.float()),
        "found": _mean(forecast_lost[truth].float()),
        "false": _mean(forecast_lost[~truth].float()),
    }


def arrival_groups(arrival: Tensor, rest: Tensor | None = None) -> dict[str, Tensor]:
    """Masks ``(n,)`` of the samples that are scored together in any task.

    Args:
        arrival: ``(n,)`` control steps, negative for never.
        rest: ``(n,)`` bool: the robot is at rest; None if that is not scored.
    """
    soon = (arrival >= 0) & (arrival < SOON)
    groups = {"all": torch.ones_like(soon), "soon": soon}
    return groups if rest is None else groups | {"at rest": rest, "in motion": ~rest}


def arrival_errors(
    logits: Tensor, arrival: Tensor, groups: Mapping[str, Tensor], *, bin_width: int = 5
) -> list[dict[str, Any]]:
    """Errors of arrival times if the robot arrives within the bins, and the accuracy of *never*.

    Args:
        logits: ``(n, bins + 1)``.
        arrival: ``(n,)`` control steps, negative or beyond the bins for never.
        groups: masks ``(n,)`` by name, as from `arrival_groups`.
        bin_width: control steps in a bin.

    Returns:
        A row for each group and each estimator: ``samples, estimator, count`` (of arrivals), ``mean`` and ``p95``
        absolute error and ``bias`` [control steps], ``never_accuracy`` over all of the group; None where nothing
        counts.
    """
    never = (arrival < 0) | (arrival >= bin_width * (logits.shape[-1] - 1))
    rows = []
    for estimator, decode in ESTIMATORS.items():
        estimated = decode(logits, bin_width=bin_width)
        difference = estimated.steps - arrival
        for name, group in groups.items():
            error = difference[group & ~never]
            size = error.abs()
            row = {"samples": name, "estimator": estimator, "count": len(error)}
            row |= {"mean": _mean(size), "p95": _quantile(size, 0.95), "bias": _mean(error)}
            row["never_accuracy"] = _mean((estimated.never == never)[group].float())
            rows.append(row)
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


def capture_errors(
    logits: Tensor, held: Captures, *, stride: int, speeds: Sequence[float] = CAPTURE_SPEEDS
) -> list[dict[str, Any]]:
    """How well the probability of a capture is predicted, for all attempts and by the target's speed.

    Args:
        logits: ``(n,)`` of the predicted probability.
        held: the n attempts.
        stride: control steps between the positions of a window.
        speeds: bounds of the groups [m a step].

    Returns:
        A row for each group: ``attempts``, their ``count``, the share ``captured``, the mean probability ``predicted``,
        the ``loss`` (cross-entropy), and ``ranked``, the share of pairs of a captured and another attempt in which the
        captured one has the higher probability; None where there is no such pair.
    """
    speed = (held.window[:, 1:] - held.window[:, :-1]).norm(dim=-1).amax(-1) / stride
    groups = {"all": torch.ones_like(held.captured)}
    for low, high in zip((0.0, *speeds), (*speeds, torch.inf), strict=True):
        name = f"from {low:g}" if high == torch.inf else f"{low:g} to {high:g}"
        groups[f"{name} m a step"] = (speed >= low) & (speed < high)
    rows = []
    for name, chosen in groups.items():
        one, captured = logits[chosen].double(), held.captured[chosen]
        figures = {"captured": None, "predicted": None, "loss": None}
        if len(one):
            figures = {
                "captured": captured.double().mean().item(),
                "predicted": one.sigmoid().mean().item(),
                "loss": torch.nn.functional.binary_cross_entropy_with_logits(one, captured.double()).item(),
            }
        rows.append({"attempts": name, "count": len(one)} | figures | {"ranked": _ranked(one, captured)})
    return rows


def _ranked(score: Tensor, positive: Tensor) -> float | None:
    """Share of pairs of a ``positive`` (n,) row and another that ``score`` (n,) ranks rightly; ties count half."""
    better, worse = score[positive].sort().values, score[~positive]
    if not len(better) or not len(worse):
        return None
    above = len(better) - torch.searchsorted(better, worse, right=True)
    equal = torch.searchsorted(better, worse, right=True) - torch.searchsorted(better, worse)
    return ((above + 0.5 * equal).double().mean() / len(better)).item()
