"""Balls caught in the air: of those that can be caught at all, how many are, as they are measured and as they fly.

python benchmarks/catch.py --out benchmarks/results/catch.json
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any

import tyro
from study import Episodes, Row, Setting, Study, measuring, rate_entries, success_of

from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.evaluation.tracks import track_named
from torchdyn_plan.planners import TrackedPlanner
from torchdyn_plan.tasks import load_task

SENSORS = {"exact": Sensor()} | {f"{noise} mm, 60 Hz": Sensor(noise=noise / 1000, rate=60.0) for noise in (1, 3, 5, 10)}
"""By name. Behind all but the exact one there is a track."""
TRACKS = {"ballistic": {}, "kalman": {"accelerates": True, "acceleration": 10.0}}
"""Settings of each track."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Catch balls."""

    planners: tuple[str, ...] = ("meet", "learned", "pursuit", "oracle")
    """Planners of the task; the oracle knows the flight, whatever is measured."""
    sensors: tuple[str, ...] = ("3 mm, 60 Hz", "exact")
    """By name."""
    tracks: tuple[str, ...] = ("ballistic",)
    """By name."""
    flights: tuple[float, ...] = (0.7,)
    """Mean time of flight [s]."""
    drags: tuple[float, ...] = (0.0195,)
    """Of the ball [1/m]."""
    episodes: int = 500
    """Episodes for each row."""
    num_envs: int = 250
    """Episodes side by side; does not change the figures."""
    split: str = "test"
    """Series of episodes: test, or dev while tuning."""
    threads: int = 1
    """Threads of the simulation; does not change the figures."""


def measure(setting: Setting, planner: str, sensor: str, track: str) -> Row:
    """Balls caught by ``planner`` that are measured by ``sensor``."""
    seen, acting = SENSORS[sensor], setting.planner(planner)
    if not seen.is_exact:
        followed: Any = track_named(track, seen, **TRACKS[track])
        acting = TrackedPlanner(acting, followed, control_step=setting.task.control_step)
    found = setting.play(acting, planner, seen)
    caught, step = found.success, setting.task.control_step
    return {
        **success_of(found),
        **rate_entries("success", int(caught.sum()), found.episodes),
        "caught_but_not_solvable": int((caught & ~found.solvable).sum()),
        "seconds_to_hold": found.steps[caught].double().mean().item() * step if bool(caught.any()) else None,
        "episodes_per_second": found.episodes / found.seconds,
    }


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("catch")
    study = Study(arguments, scene=task.digest())
    with measuring():
        for flight, drag in itertools.product(arguments.flights, arguments.drags):
            setting = Setting(task, arguments, flight=flight, drag=drag)
            for sensor, track, planner in itertools.product(arguments.sensors, arguments.tracks, arguments.planners):
                if planner == "oracle" and sensor != "exact":
                    continue
                about = setting.about | {"planner": planner, "sensor": sensor}
                about |= {"track": "none" if sensor == "exact" else track}
                study.row(about, partial(measure, setting, planner, sensor, track))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
