"""Supervised fits of the forecaster, the arrival-time and the capture network to a task's collected data.

Every fit takes the task; the folder ``data`` of its collected shards and their descriptions; a folder ``out``, which
gets a folder of the network's name with checkpoint, curve, weights and card; and a `Recipe`, the task's own for None. A
batch of paths consists of new random windows. A fit returns the weights' file. It raises `InputError` if data is
missing, damaged or of another scene, and `TrainingError` if the loss is NaN or a checkpoint is damaged or of another
recipe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy

from torchdyn_plan.errors import InputError
from torchdyn_plan.files import short_path
from torchdyn_plan.nets.capture import CaptureConfig, CaptureNetwork
from torchdyn_plan.nets.eta import ETAConfig, ETANetwork, arrival_classes
from torchdyn_plan.nets.forecaster import Forecaster, ForecasterConfig
from torchdyn_plan.tasks.task import Task
from torchdyn_plan.training.arrival_data import load_arrivals, split_groups
from torchdyn_plan.training.capture_data import load_captures
from torchdyn_plan.training.card import Tables, write_network
from torchdyn_plan.training.fitting import Fitting
from torchdyn_plan.training.lines import unreflect_paths
from torchdyn_plan.training.metrics import arrival_errors, capture_errors, forecast_errors, lost_accuracy
from torchdyn_plan.training.optimise import Recipe, optimise
from torchdyn_plan.training.path_data import PathSamples
from torchdyn_plan.training.shards import driver_of, read_description
from torchdyn_plan.training.sighted_data import SightedSamples
from torchdyn_plan.training.windows import Windows

ROWS = 4096
"""Rows that a network evaluates at once when it is scored."""


def task_fitting(task: Task) -> Fitting:
    """The `Fitting` of ``task``; raises `InputError` if it has no networks."""
    if task.fitting is None:
        raise InputError(f"{task.name} has no networks to fit")
    return task.fitting()


def words_of(task: Task) -> str:
    """Command-line arguments that select ``task``, including its scene if it is not the default one."""
    return task.name if task.scene == next(iter(task.scenes), "") else f"{task.name} --scene {task.scene}"


def fit_forecaster(
    task: Task,
    data: Path,
    out: Path,
    recipe: Recipe | None = None,
    *,
    config: ForecasterConfig | None = None,
    resume: bool = True,
    name: str = Forecaster.kind,
) -> Path:
    """Fit a `Forecaster` to the ``paths`` in ``data``; one in ten episodes is held out and scored.

    A ``tracked`` forecaster sees the paths through sensors and a track, see `Fitting.sighting`. ``config`` is the
    task's by default; ``name`` is the name of its folder in ``out``; without ``resume`` a checkpoint in ``out`` is not
    continued.
    """
    fitting = task_fitting(task)
    config, recipe = config or fitting.forecaster, recipe or fitting.recipe("forecaster")
    about = read_description(data, "paths", scene=task.digest())
    samples = path_samples(task, data, config, recipe.seed)
    lines = unreflect_paths(samples.paths.positions, samples.paths.start, config.half_extent)
    torch.manual_seed(recipe.seed)
    network = Forecaster(config).to(recipe.device)
    regimes = samples.regimes(recipe.seed)

    def loss(generator: torch.Generator) -> Tensor:
        return line_loss(network, samples.draw(recipe.batch, generator, lines=lines), control_step=task.control_step)

    def score() -> Tables:
        errors, lost = [], []
        for sensor, windows in regimes.items():
            forecast = _forecasts(network, windows, recipe.device)
            columns = {"sensor": sensor} if sensor else {}
            rows = forecast_errors(forecast, windows, ahead=fitting.ahead, fast=fitting.fast)
            errors += [columns | row for row in rows]
            if fitting.lost is not None:
                lost.append(columns | lost_accuracy(forecast, windows, fitting.lost))
        tables = {"Errors on held-out windows [m]": errors}
        return tables | {"Lost targets": lost} if lost else tables

    episodes = len(samples.paths.length)
    settings = {"network": asdict(config), "scene": about["scene"], "episodes": episodes}
    folder = out / name
    optimise(network, loss, lambda: _forecast_figures(score()), recipe, out=folder, settings=settings, resume=resume)
    counts = {"episodes": episodes, "held out": len(samples.held)}
    facts = about | counts
    return write_network(network, folder, score, task=words_of(task), recipe=recipe, facts=facts, network_name=name)


def path_samples(task: Task, data: Path, config: ForecasterConfig, seed: int) -> PathSamples | SightedSamples:
    """The paths in ``data`` as windows for a forecaster of ``config``; ``seed`` selects the held-out ones."""
    fitting = task_fitting(task)
    drawing = replace(fitting.windows, history=config.history, horizon=config.horizon)
    if not config.tracked:
        return PathSamples.load(data, drawing, seed)
    # A track is usable from its second measurement on.
    drawing = replace(drawing, first_step=1)
    return SightedSamples.load(data, drawing, seed, fitting.sighting, control_step=task.control_step)


def line_loss(network: Forecaster, windows: Windows, *, control_step: float) -> Tensor:
    """Mean absolute error on the unreflected line, scaled by the step ahead and by the track's uncertainty.

    Horizontal errors count until the target is lost, so that the line continues as if it were not lost; heights always
    count, so that they show which outcome is likelier.
    """
    device = network.head.weight.device
    difference = network.unreflected(*(part.to(device) for part in windows.seen)) - windows.future.to(device)
    scale = LEVEL_SCALE * (network.steps_ahead + LEVEL_START) + windows.doubt(control_step).to(device)
    weight = windows.recorded.to(device) / scale
    level = difference[..., :2].abs().sum(dim=-1).mul(weight).sum() / weight.numel()
    return level + difference[..., 2].abs().mean() / HEIGHT_SCALE


LEVEL_SCALE, LEVEL_START = 1e-3, 15.0
"""An error of ``LEVEL_SCALE·(e + LEVEL_START)`` [m] in e steps counts as one."""
HEIGHT_SCALE = 0.1
"""An error in height that counts as one [m]."""


def fit_eta(
    task: Task,
    data: Path,
    out: Path,
    recipe: Recipe | None = None,
    *,
    config: ETAConfig | None = None,
    static: str | None = None,
    resume: bool = True,
    name: str = ETANetwork.kind,
) -> Path:
    """Fit an `ETANetwork` to the ``arrivals`` in ``data``; one in ten runs is held out and scored.

    A network without the class *never* is fitted to the times until the robot was nearest to the goal. ``config`` is
    the task's by default; ``name`` is the name of its folder in ``out``; data of another static planner than ``static``
    is refused, unless it is None; without ``resume`` a checkpoint in ``out`` is not continued.
    """
    fitting = task_fitting(task)
    config, recipe = config or fitting.eta, recipe or fitting.recipe("eta")
    about = read_description(data, "arrivals", scene=task.digest())
    check_driver(about, static, data)
    samples = load_arrivals(data, state_size=config.robot_state_size)
    if not config.never:
        latest = config.bins * config.bin_width - 1
        samples = samples._replace(arrival=samples.nearest.clamp(max=latest))
    train, held = (samples.take(rows) for rows in split_groups(samples.run, recipe.seed))
    device = recipe.device
    torch.manual_seed(recipe.seed)
    network = ETANetwork(config)
    network.set_input_statistics(train.robot_state, train.goal)
    network.to(device)
    groups = fitting.groups(held)

    def loss(generator: torch.Generator) -> Tensor:
        rows = torch.randint(len(train.run), (recipe.batch,), generator=generator)
        drawn = train.take(rows)
        classes, _ = arrival_classes(drawn.arrival, bins=config.bins, bin_width=config.bin_width)
        scores, known = network(drawn.robot_state.to(device), drawn.goal.to(device)), config.bins + config.never
        return cross_entropy(scores[:, :known], classes[:, :known].to(device))

    def score() -> Tables:
        logits = _in_parts(
            lambda rows: network(held.robot_state[rows].to(device), held.goal[rows].to(device)), len(held.run)
        )
        rows = arrival_errors(logits, held.arrival, groups, bin_width=config.bin_width)
        return {"Errors on held-out runs [control steps]": rows}

    settings = {"network": asdict(config), "scene": about["scene"], "samples": len(samples.run)}
    settings |= driver_of(about)
    folder = out / name
    optimise(network, loss, lambda: _arrival_figures(score()), recipe, out=folder, settings=settings, resume=resume)
    facts = about | {"samples": len(samples.run), "held out": len(held.run)}
    return write_network(network, folder, score, task=words_of(task), recipe=recipe, facts=facts, network_name=name)


def fit_capture(
    task: Task,
    data: Path,
    out: Path,
    recipe: Recipe | None = None,
    *,
    config: CaptureConfig | None = None,
    static: str | None = None,
    resume: bool = True,
    name: str = CaptureNetwork.kind,
) -> Path:
    """Fit a `CaptureNetwork` to the ``captures`` in ``data``; one in ten runs is held out and scored.

    ``config`` is the task's by default; ``name`` is the name of its folder in ``out``; data of another static planner
    than ``static`` is refused, unless it is None; without ``resume`` a checkpoint in ``out`` is not continued.
    """
    fitting = task_fitting(task)
    config, recipe = config or fitting.capture, recipe or fitting.recipe("capture")
    if config is None:
        raise InputError(f"{task.name} has no network of captures to fit")
    about = read_description(data, "captures", scene=task.digest())
    check_driver(about, static, data)
    samples = load_captures(data, config)
    train, held = (samples.take(rows) for rows in split_groups(samples.run, recipe.seed))
    device = recipe.device
    torch.manual_seed(recipe.seed)
    network = CaptureNetwork(config)
    network.set_input_statistics(train.window, train.goal)
    network.to(device)

    def loss(generator: torch.Generator) -> Tensor:
        drawn = train.take(torch.randint(len(train.run), (recipe.batch,), generator=generator))
        logits = network(drawn.window.to(device), drawn.goal.to(device))
        return binary_cross_entropy_with_logits(logits, drawn.captured.to(logits))

    def score() -> Tables:
        logits = _in_parts(
            lambda rows: network(held.window[rows].to(device), held.goal[rows].to(device)), len(held.run)
        )
        return {"Held-out attempts": capture_errors(logits, held, stride=config.stride)}

    settings = {"network": asdict(config), "scene": about["scene"], "samples": len(samples.run)}
    settings |= driver_of(about)
    folder = out / name
    optimise(network, loss, lambda: _capture_figures(score()), recipe, out=folder, settings=settings, resume=resume)
    facts = about | {"samples": len(samples.run), "held out": len(held.run)}
    return write_network(network, folder, score, task=words_of(task), recipe=recipe, facts=facts, network_name=name)


def check_driver(about: dict[str, Any], static: str | None, data: Path) -> None:
    """Raise `InputError` if the data described by ``about`` is of another static planner than ``static``, if given."""
    if static not in (None, about["static"]):
        raise InputError(f"the data in {short_path(Path(data))} is of {about['static']}, not of {static}")


def _forecasts(network: Forecaster, windows: Windows, device: str) -> Tensor:
    """Forecasts of ``windows``, on the CPU."""
    return _in_parts(lambda rows: network(*(part[rows].to(device) for part in windows.seen)), len(windows.history))


def _in_parts(forward: Callable[[slice], Tensor], count: int) -> Tensor:
    """Outputs for ``count`` rows, `ROWS` at a time, on the CPU."""
    return torch.cat([forward(slice(first, first + ROWS)).cpu() for first in range(0, count, ROWS)])


def _forecast_figures(tables: Tables) -> dict[str, float]:
    errors, *lost = tables.values()
    figures: dict[str, Any] = {}
    for row in errors:
        # A curve for every kind and every sensor would be unreadable.
        if row["windows"] == "fast" or (row["windows"] != "still" and "sensor" not in row):
            figures[f"{_of(row)}{row['windows']}_{row['ahead']}"] = row["median"]
    for row in (row for rows in lost for row in rows):
        figures |= {f"{_of(row)}lost_found": row["found"], f"{_of(row)}lost_false": row["false"]}
    return {name: value for name, value in figures.items() if value is not None}


def _of(row: dict[str, Any]) -> str:
    """Prefix of a figure's name: its sensor, if any."""
    return f"{row['sensor']}: " if "sensor" in row else ""


def _arrival_figures(tables: Tables) -> dict[str, float]:
    (rows,) = tables.values()
    figures: dict[str, Any] = {}
    for row in rows:
        if row["samples"] in ("all", "soon"):
            head = f"{row['estimator']}_{row['samples']}"
            figures |= {f"{head}_{name}": row[name] for name in ("mean", "p95", "never_accuracy")}
    return {name: value for name, value in figures.items() if value is not None}


def _capture_figures(tables: Tables) -> dict[str, float]:
    (rows,) = tables.values()
    # By speed, groups may be empty.
    return {name: rows[0][name] for name in ("loss", "ranked") if rows[0][name] is not None}
