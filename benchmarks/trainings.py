"""How much a figure depends on the training: one planner with the networks of several trainings, on the same episodes.

    for seed in 0 1 2 3 4; do
        for network in forecaster eta spread capture; do
            torchdyn-plan train $network --seed $seed --out runs/trainings/$seed
        done
    done
    python benchmarks/trainings.py --weights runs/trainings/? --split test --episodes 500 --out runs/trainings.json

With ``--sensors`` the target is measured by these sensors of `sensors.py` and seen through a track.

A row for each training, velocity and sensor; then one for each velocity and sensor, and one for all of them together:
the interquartile mean of success over solvable, with the stratified bootstrap interval over trainings. A killed run
goes on where it was.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro
from sensors import SENSORS, sees_by
from study import Episodes, Row, Setting, Study, each, measuring, success_of

from torchdyn_plan.evaluation.intervals import interquartile_mean_interval
from torchdyn_plan.tasks import load_task

TASK = "trapper"
EXACT = "exact"


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Which trainings are compared, and where."""

    weights: tuple[Path, ...]
    """Folders of the networks, one for each training, as ``train`` leaves them."""
    planner: str = "wait_and_drop"
    """Of the task."""
    velocities: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Of the ball at the start [m/s]."""
    sensors: tuple[str, ...] = (EXACT,)
    """By name, as in `sensors.py`; without a track for the exact one."""
    track: str = "kalman"
    """Through which the planner sees the target with any other sensor."""


def about(arguments: Arguments, setting: Setting, sensor: str) -> Row:
    """What is varied beside the training."""
    varied = setting.about | {"planner": arguments.planner}
    return varied if sensor == EXACT else varied | {"sensor": sensor, "track": arguments.track}


def measure(arguments: Arguments, setting: Setting, sensor: str, weights: Path) -> Row:
    """Success of the planner with the networks in the folder ``weights``."""
    chunk, static_chunk = setting.task.rows_at_once
    how = {"weights": weights, "chunk": chunk, "static_chunk": static_chunk}
    made = setting.task.planner(arguments.planner, setting.static, **how)
    if sensor == EXACT:
        return success_of(setting.play(made, str(weights)))
    seeing = sees_by(made, arguments.track, SENSORS[sensor], setting.task.control_step)
    return success_of(setting.play(seeing, str(weights), SENSORS[sensor]))


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
    cases = list(itertools.product(settings, arguments.sensors))
    rows: list[list[Row]] = []
    with measuring():
        for weights in each(arguments.weights, "trainings"):
            trained = {"weights": str(weights)}
            rows.append(
                [
                    study.row(trained | about(arguments, *case), partial(measure, arguments, *case, weights))
                    for case in cases
                ]
            )
    over = {"over": [str(weights) for weights in arguments.weights]}
    for place, case in enumerate(cases):
        study.row(over | about(arguments, *case), partial(over_trainings, [[row[place]] for row in rows]))
    everything = {"velocities": list(arguments.velocities), "sensors": list(arguments.sensors)}
    study.row(over | {"planner": arguments.planner} | everything, partial(over_trainings, rows))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
