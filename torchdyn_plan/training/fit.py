"""Supervised fits of the two networks to collected data."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.eta import ETAConfig, ETANetwork, arrival_classes
from torchdyn_plan.nets.forecaster import Forecaster, ForecasterConfig
from torchdyn_plan.training.arrivals import load_arrivals, split_groups
from torchdyn_plan.training.card import read_description, write_card
from torchdyn_plan.training.lines import unfold_paths
from torchdyn_plan.training.metrics import arrival_errors, forecast_errors, pocket_accuracy
from torchdyn_plan.training.optimise import Recipe, optimise
from torchdyn_plan.training.tasks import FitTask, trapper_task
from torchdyn_plan.training.windows import Paths, WindowConfig, Windows, draw_windows, last_useful_step, load_paths

SCORED = 4096
"""Held-out windows of each kind, or held-out samples, in one pass of validation."""

Tables = dict[str, list[dict[str, Any]]]


def fit_forecaster(
    data: Path,
    out: Path,
    *,
    steps: int = 20_000,
    batch: int = 512,
    lr: float = 2e-3,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = True,
    config: ForecasterConfig | None = None,
    task: FitTask | None = None,
) -> Path:
    """Fit a `Forecaster` to the ``paths`` in ``data``; one in ten episodes is held out and scored.

    Args:
        data: folder of ``paths-*.safetensors`` and their descriptions.
        out: gets a folder ``forecaster`` with checkpoint, curve, weights and card.
        steps: optimiser steps.
        batch: fresh random windows a step.
        lr: highest learning rate.
        seed: of initialisation, held-out episodes and draws.
        device: where to train.
        resume: whether to continue from the checkpoint in ``out``.
        config: of the network; the task's by default.
        task: that the data must come from; Trapper by default.

    Returns:
        The weights' file.

    Raises:
        InputError: data is missing, damaged or of another scene, or an argument is wrong.
        TrainingError: the loss is NaN, or the checkpoint is damaged or has other settings.
    """
    recipe = Recipe(steps=steps, batch=batch, lr=lr, seed=seed, device=device)
    task = task or trapper_task()
    config = config or task.forecaster
    about = read_description(data, "paths", scene=task.digest)
    folder = out / Forecaster.kind
    drawing = replace(task.windows, history=config.history, horizon=config.horizon)
    paths = load_paths(data)
    last = last_useful_step(paths, drawing)
    usable = (last >= drawing.first_step).nonzero().squeeze(-1)
    train, held = (usable[rows] for rows in split_groups(usable, seed))
    lines = unfold_paths(paths.positions, paths.start, config.half_extent)
    torch.manual_seed(seed)
    network = Forecaster(config).to(device)

    def loss(generator: torch.Generator) -> Tensor:
        episodes = train[torch.randint(len(train), (batch,), generator=generator)]
        return line_loss(network, draw_windows(paths, last, episodes, drawing, generator, lines=lines))

    windows = held_windows(paths, last, held, drawing, seed)
    settings = {"network": asdict(config), "scene": about["scene"], "episodes": len(paths.length)}

    def score() -> Tables:
        forecast = _in_parts(lambda rows: network(windows.history[rows].to(device)), len(windows.history))
        errors = forecast_errors(forecast, windows, ahead=task.ahead, fast=task.fast)
        tables = {"Errors on held-out windows [m]": errors}
        return tables | ({"Swallowed targets": [pocket_accuracy(forecast, windows)]} if task.pockets else {})

    optimise(network, loss, lambda: _forecast_figures(score()), recipe, out=folder, settings=settings, resume=resume)
    facts = {"data": about["arguments"], "scene": about["scene"]}
    facts |= {"episodes": len(paths.length), "held out": len(held), "network": asdict(config)}
    return _finish(network, folder, score, recipe=recipe, task=task.name, facts=facts)


def held_windows(paths: Paths, last: Tensor, held: Tensor, drawing: WindowConfig, seed: int) -> Windows:
    """`SCORED` windows with full histories and as many with padded ones, of the episodes ``held``."""
    draws = torch.Generator().manual_seed(seed)
    full = replace(drawing, first_step=drawing.history, early_share=0.0, shortened_share=0.0)
    scored = [
        draw_windows(paths, last, _some(held[last[held] >= kind.first_step], SCORED), kind, draws)
        for kind in (full, replace(drawing, early_share=0.0, shortened_share=1.0))
    ]
    return Windows(*(torch.cat(tensors) for tensors in zip(*scored, strict=True)))


def line_loss(network: Forecaster, windows: Windows) -> Tensor:
    """Mean absolute error on the unfolded line, relative to what a step ahead is worth.

    Level errors count until the target is swallowed, so that the line is where it would be if it were not; heights
    count always, so that their sign tells what is likelier.
    """
    device = network.head.weight.device
    difference = network.unfolded(windows.history.to(device)) - windows.future.to(device)
    ahead = network.steps_ahead
    weight = windows.recorded.to(device) / (LEVEL_SCALE * (ahead + LEVEL_START))
    level = difference[..., :2].abs().sum(dim=-1).mul(weight).sum() / weight.numel()
    return level + difference[..., 2].abs().mean() / HEIGHT_SCALE


LEVEL_SCALE, LEVEL_START = 1e-3, 15.0
"""An error of ``LEVEL_SCALE·(e + LEVEL_START)`` [m] in e steps counts as one."""
HEIGHT_SCALE = 0.1
"""An error in height that counts as one [m]."""


def fit_eta(
    data: Path,
    out: Path,
    *,
    steps: int = 64_000,
    batch: int = 1024,
    lr: float = 2e-3,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = True,
    config: ETAConfig | None = None,
    task: FitTask | None = None,
) -> Path:
    """Fit an `ETANetwork` to the ``arrivals`` in ``data``; one in ten runs is held out and scored.

    Args:
        data: folder of ``arrivals-*.safetensors`` and their descriptions.
        out: gets a folder ``eta`` with checkpoint, curve, weights and card.
        steps: optimiser steps.
        batch: samples a step.
        lr: highest learning rate.
        seed: of initialisation, held-out runs and draws.
        device: where to train.
        resume: whether to continue from the checkpoint in ``out``.
        config: of the network; the task's by default.
        task: that the data must come from; Trapper by default.

    Returns:
        The weights' file.

    Raises:
        InputError: data is missing, damaged or of another scene, or an argument is wrong.
        TrainingError: the loss is NaN, or the checkpoint is damaged or has other settings.
    """
    recipe = Recipe(steps=steps, batch=batch, lr=lr, seed=seed, device=device)
    task = task or trapper_task()
    config = config or task.eta
    about = read_description(data, "arrivals", scene=task.digest)
    folder = out / ETANetwork.kind
    samples = load_arrivals(data)
    if samples.robot_state.shape[-1] != config.robot_state_size:
        size = samples.robot_state.shape[-1]
        raise InputError(f"robot_state of the arrivals has {size} entries, expected {config.robot_state_size}")
    train, held = (samples.take(rows) for rows in split_groups(samples.run, seed))
    torch.manual_seed(seed)
    network = ETANetwork(config)
    network.set_input_statistics(train.robot_state, train.goal)
    network.to(device)

    def loss(generator: torch.Generator) -> Tensor:
        rows = torch.randint(len(train.run), (batch,), generator=generator)
        state, goal, arrival, _ = train.take(rows)
        classes, _ = arrival_classes(arrival, bins=config.bins, bin_width=config.bin_width)
        return cross_entropy(network(state.to(device), goal.to(device)), classes.to(device))

    groups = task.groups(held)
    settings = {"network": asdict(config), "scene": about["scene"], "samples": len(samples.run)}

    def score() -> Tables:
        logits = _in_parts(
            lambda rows: network(held.robot_state[rows].to(device), held.goal[rows].to(device)), len(held.run)
        )
        rows = arrival_errors(logits, held.arrival, groups, bin_width=config.bin_width)
        return {"Errors on held-out runs [control steps]": rows}

    optimise(network, loss, lambda: _arrival_figures(score()), recipe, out=folder, settings=settings, resume=resume)
    facts = {"data": about["arguments"], "scene": about["scene"]}
    facts |= {"samples": len(samples.run), "held out": len(held.run), "network": asdict(config)}
    return _finish(network, folder, score, recipe=recipe, task=task.name, facts=facts)


def _some(rows: Tensor, count: int) -> Tensor:
    """``count`` of ``rows``, over and over if there are fewer."""
    if not len(rows):
        raise InputError("no held-out episode is long enough for a window: collect more episodes")
    return rows.repeat(-(-count // len(rows)))[:count]


def _in_parts(forward: Callable[[slice], Tensor], count: int) -> Tensor:
    """Outputs for ``count`` rows, `SCORED` at a time, on the CPU."""
    return torch.cat([forward(slice(first, first + SCORED)).cpu() for first in range(0, count, SCORED)])


def _forecast_figures(tables: Tables) -> dict[str, float]:
    errors, *pockets = tables.values()
    figures = {f"{row['windows']}_{row['ahead']}": row["median"] for row in errors if row["windows"] != "still"}
    for (table,) in pockets:
        figures |= {f"pocket_{name}": table[name] for name in ("found", "false")}
    return {name: value for name, value in figures.items() if value is not None}


def _arrival_figures(tables: Tables) -> dict[str, float]:
    (rows,) = tables.values()
    figures = {}
    for row in rows:
        if row["samples"] in ("all", "soon"):
            head = f"{row['reading']}_{row['samples']}"
            figures |= {f"{head}_{name}": row[name] for name in ("mean", "p95", "never_accuracy")}
    return {name: value for name, value in figures.items() if value is not None}


def _finish(
    network: Forecaster | ETANetwork,
    folder: Path,
    score: Callable[[], Tables],
    *,
    recipe: Recipe,
    task: str,
    facts: Mapping[str, Any],
) -> Path:
    """Write weights and card."""
    network.eval()
    with torch.no_grad():
        tables = score()
    file = network.save_pretrained(folder)
    settings = f"--steps {recipe.steps} --batch {recipe.batch} --lr {recipe.lr:g} --seed {recipe.seed}"
    facts = {
        "command": f"`torchdyn-plan train {network.kind} --task {task} {settings}`",
        "recipe": asdict(recipe),
    } | dict(facts)
    write_card(file.with_suffix(".md"), f"{type(network).__name__} of {task.title()}", facts, tables)
    return file
