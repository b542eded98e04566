"""How much a figure depends on the training: one planner with the networks of several trainings, on the same episodes.

    for seed in 0 1 2 3 4; do
        for network in forecaster eta spread capture; do
            torchdyn-plan train $network --seed $seed --out runs/trainings/$seed
        done
    done
    python benchmarks/trainings.py --weights runs/trainings/? --split test --episodes 500 --out runs/trainings.json

A row for each training and velocity; then one for each velocity, and one for all of them together: the interquartile
mean of success over solvable, with the stratified bootstrap interval over trainings. A killed run goes on where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro
from study import Episodes, Row, Setting, Study, each, measuring, success_of

from torchdyn_plan.evaluation.intervals import interquartile_mean_interval
from torchdyn_plan.tasks import load_task

TASK = "trapper"


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Which trainings are compared, and where."""

    weights: tuple[Path, ...]
    """Folders of the networks, one for each training, as ``train`` leaves them."""
    planner: str = "wait_and_drop"
    """Of the task."""
    velocities: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Of the ball at the start [m/s]."""


def measure(setting: Setting, planner: str, weights: Path) -> Row:
    """Success of ``planner`` with the networks in the folder ``weights``."""
    chunk, static_chunk = setting.task.rows_at_once
    made = setting.task.planner(planner, setting.static, weights=weights, chunk=chunk, static_chunk=static_chunk)
    return success_of(setting.play(made, str(weights)))


def over_trainings(rows: Sequence[Sequence[Row]]) -> Row:
    """Interquartile mean of the success of R trainings in K settings, from R lists of K rows."""
    scores = torch.tensor([[row["success_solvable"] for row in of_training] for of_training in rows])
    value, low, high = interquartile_mean_interval(scores)
    return {"trainings": len(rows), "interquartile_mean": value, "interquartile_mean_ci": [low, high]}


def main(arguments: Arguments) -> None:
    """Measure every training, and put them together."""
    task = load_task(TASK)
    study = Study(arguments, scene=task.digest())
    settings = [Setting(task, arguments, velocity=velocity) for velocity in arguments.velocities]
    rows: list[list[Row]] = []
    with measuring():
        for weights in each(arguments.weights, "trainings"):
            about = {"weights": str(weights), "planner": arguments.planner}
            measured = (
                study.row(about | setting.about, partial(measure, setting, arguments.planner, weights))
                for setting in settings
            )
            rows.append(list(measured))
    about = {"planner": arguments.planner, "over": [str(weights) for weights in arguments.weights]}
    for place, velocity in enumerate(arguments.velocities):
        study.row(about | {"velocity": velocity}, partial(over_trainings, [[row[place]] for row in rows]))
    study.row(about | {"velocities": list(arguments.velocities)}, partial(over_trainings, rows))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
