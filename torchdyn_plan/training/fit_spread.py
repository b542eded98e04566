"""The fit of a spread to a frozen forecaster's errors, and its calibration; see `fit` for the common arguments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, softplus

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.forecaster import Forecaster
from torchdyn_plan.nets.spread import Spread, SpreadConfig, SpreadNetwork
from torchdyn_plan.tasks.task import Task
from torchdyn_plan.training.card import Rows, Tables, write_network
from torchdyn_plan.training.fit import path_samples, task_fitting, words_of
from torchdyn_plan.training.fitting import Fitting
from torchdyn_plan.training.metrics import coverage, lost_probability
from torchdyn_plan.training.optimise import Recipe, optimise
from torchdyn_plan.training.path_data import PathSamples
from torchdyn_plan.training.shards import read_description
from torchdyn_plan.training.sighted_data import SightedSamples
from torchdyn_plan.training.windows import Windows

ROWS = 1024
"""Rows that the networks evaluate at once when they are scored."""


def fit_spread(
    task: Task,
    data: Path,
    out: Path,
    recipe: Recipe | None = None,
    *,
    forecaster: str | Path,
    config: SpreadConfig | None = None,
    resume: bool = True,
    name: str = SpreadNetwork.kind,
) -> Path:
    """Fit a `SpreadNetwork` to the errors of ``forecaster``, which does not change, on the ``paths`` in ``data``.

    With the paths and the seed of the forecaster's own fit, the same episodes are held out, so that coverage is
    measured on errors that neither network was fitted to.

    ``forecaster`` is a shipped name, a file or a folder; otherwise a `WeightsError` is raised. ``config`` has the
    forecaster's sizes by default; ``name`` is the name of its folder in ``out``; without ``resume`` a checkpoint in
    ``out`` is not continued.
    """
    fitting = task_fitting(task)
    if not fitting.spread:
        raise InputError(f"{task.name} has no spread to fit")
    recipe = recipe or fitting.recipe("spread")
    frozen = Forecaster.from_pretrained(forecaster, device=recipe.device).requires_grad_(False)
    sizes = frozen.config
    config = config or SpreadConfig(features=sizes.hidden, horizon=sizes.horizon, tracked=sizes.tracked)
    about = read_description(data, "paths", scene=task.digest())
    samples = path_samples(task, data, sizes, recipe.seed)
    torch.manual_seed(recipe.seed)
    network = SpreadNetwork(config).to(recipe.device)
    windows = samples.held_windows(recipe.seed)

    def loss(generator: torch.Generator) -> Tensor:
        return spread_loss(frozen, network, samples.draw(recipe.batch, generator))

    def validate() -> dict[str, float]:
        return {"loss_held": float(spread_loss(frozen, network, windows))}

    def score() -> Tables:
        return _tables(frozen, network, samples, fitting, recipe.seed)

    episodes = len(samples.paths.length)
    settings = {"network": asdict(config), "scene": about["scene"], "episodes": episodes, "forecaster": str(forecaster)}
    folder = out / name
    optimise(network, loss, validate, recipe, out=folder, settings=settings, resume=resume)
    counts = {"episodes": episodes, "held out": len(samples.held), "forecaster": forecaster}
    facts = about | counts
    return write_network(network, folder, score, task=words_of(task), recipe=recipe, facts=facts, network_name=name)


def spread_loss(forecaster: Forecaster, network: SpreadNetwork, windows: Windows) -> Tensor:
    """Negative log-likelihood of the errors' sizes (logistic in their logarithm), and of being lost or not.

    A tracked forecaster's errors come from the measurements and have lighter tails than the spread's distribution. For
    it the quantiles `QUANTILES` of their logarithm are fitted (pinball loss) instead of the likelihood, so that the
    intervals have the right coverage. All are proper scores, averaged over the steps ahead. Errors count until the
    target is lost.
    """
    device = network.head.weight.device
    with torch.no_grad():
        forecast, features, swapped = forecaster.describe(*(part.to(device) for part in windows.seen))
        error = (forecast - windows.future.to(device))[..., :2].abs() + network.config.finest
    recorded = windows.recorded.to(device)
    log_scale, log_shape, gone = network.raw(features, swapped)
    beyond = error.log() - log_scale
    if forecaster.config.tracked:
        wide = log_shape.exp()
        parts = [_pinball(beyond - math.log(share / (1.0 - share)) / wide, share) for share in QUANTILES]
        score = torch.stack(parts).sum(0)
    else:
        beyond = log_shape.exp() * beyond
        score = 2.0 * softplus(-beyond) + beyond - log_shape
    size = (score.mean(-1) * recorded).sum() / recorded.sum().clamp_min(1)
    return size + binary_cross_entropy_with_logits(gone, (~recorded).to(gone.dtype))


QUANTILES = (0.5, 0.8, 0.95)
"""Coverage of the intervals to which the spread of a tracked forecaster is fitted."""


def _pinball(beyond: Tensor, share: float) -> Tensor:
    """Pinball loss: its mean is smallest if a ``share`` of the values ``beyond`` (*B,) is negative."""
    return torch.maximum(share * beyond, (share - 1.0) * beyond)


def _tables(
    forecaster: Forecaster,
    network: SpreadNetwork,
    samples: PathSamples | SightedSamples,
    fitting: Fitting,
    seed: int,
) -> Tables:
    def covered(seen: Windows) -> tuple[Spread, Rows]:
        forecast, spread = predict(forecaster, network, *seen.seen)
        return spread, coverage(forecast, spread, seen, ahead=fitting.ahead, fast=fitting.fast, near=fitting.near)

    covers: Rows = []
    lost: Rows = []
    for name, windows in samples.regimes(seed).items():
        spread, rows = covered(windows)
        columns = {"sensor": name} if name else {}
        covers += [columns | row for row in rows]
        lost += [columns | row for row in lost_probability(spread, windows, ahead=fitting.ahead)]
    tables = {"Coverage on held-out windows": covers}
    if fitting.lost is not None:
        tables["Lost targets"] = lost
    if fitting.extra_coverage is not None and not forecaster.config.tracked:
        extra = fitting.extra_coverage(samples.drawing)
        tables[extra.caption] = [
            columns | row for columns, seen in extra.windows for row in covered(seen)[1] if row["windows"] == "full"
        ]
    return tables


def predict(forecaster: Forecaster, network: SpreadNetwork, *seen: Tensor) -> tuple[Tensor, Spread]:
    """Forecasts ``(n, F, 3)`` [m, world] and their spread for the inputs ``seen`` of n targets, on the CPU."""
    device = network.head.weight.device
    parts: list[Sequence[Tensor]] = []
    for rows in zip(*(part.split(ROWS) for part in seen), strict=True):
        forecast, features, swapped = forecaster.describe(*(part.to(device) for part in rows))
        parts.append([forecast.cpu(), *(part.cpu() for part in network(features, swapped))])
    forecast, *spread = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
    return forecast, Spread(*spread)
