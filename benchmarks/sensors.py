"""What sensors cost, and what tracks and forecasters recover, on the same episodes.

    python benchmarks/sensors.py --split test --episodes 1000 --out benchmarks/results/sensors.json

Each row is one sensor, one velocity and one planner; ``success_solvable`` is over the episodes that can be solved.
``held`` is the planner that sees the newest measurement, held from step to step; the others have a track set to the
sensor's noise. A killed run continues where it was, so that rows can be added a few at a time.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import tyro
from study import Episodes, Row, Setting, Study, measuring, success_of

from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.envs.trapper.scene import trapper_scene
from torchdyn_plan.evaluation.tracks import track_named
from torchdyn_plan.nets import ConstantVelocity, ForecastByNoise
from torchdyn_plan.planners import DynamicPlanner, Track, TrackedPlanner
from torchdyn_plan.planners.schedule import starting_at
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.untrained import billiard

TASK = "trapper"
SENSORS = {
    "exact": Sensor(),
    "2 mm, 250 Hz": Sensor(noise=0.002),
    "5 mm, 60 Hz, 20 ms late": Sensor(noise=0.005, rate=60.0, latency=0.02),
    "5 mm, 30 Hz, 5 % lost, 3 ms jitter": Sensor(noise=0.005, rate=30.0, dropout=0.05, jitter=0.003),
} | {f"{noise:g} mm, 60 Hz": Sensor(noise=noise / 1000.0, rate=60.0) for noise in (0, 0.5, 1, 2, 3, 5, 8)}
"""By name; those at 60 Hz that differ in noise alone are for the plot."""
TABLE = tuple(SENSORS)[:4]
TRACKS: dict[str, Callable[[Sensor], Track | None]] = {
    "held": lambda sensor: None,
    "kalman": lambda sensor: track_named("kalman", sensor),
    "least_squares": lambda sensor: track_named("least_squares", sensor, window=0.2),
}


def without_noise(planner: DynamicPlanner) -> DynamicPlanner:
    """With the forecaster that has seen no noise, whatever a track says."""
    assert isinstance(planner.forecaster, ForecastByNoise)
    return planner.with_parts(forecaster=planner.forecaster.exact)


def analytic(planner: DynamicPlanner, model: Any) -> DynamicPlanner:
    """With a forecaster that needs no training, from the second measurement on."""
    return planner.with_parts(forecaster=model, schedule=starting_at(planner.schedule, 1))


FORECASTS: dict[str, Callable[[DynamicPlanner], DynamicPlanner]] = {
    "exact_forecast": without_noise,
    "constant_velocity": lambda planner: analytic(planner, ConstantVelocity(tracked=True)),
    "billiard": lambda planner: analytic(planner, billiard(trapper_scene(None), tracked=True)),
}
"""``wait_and_drop`` with other forecasts and the same arrival times: by the forecaster that has seen no noise, and by
mechanics alone."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Which rows are measured."""

    episodes: int = 200
    """Episodes for each row."""
    num_envs: int = 200
    """Episodes side by side; does not change the figures."""
    velocities: tuple[float, ...] = (3.0, 1.0, 5.0)
    """Of the ball at the start [m/s]."""
    sensors: tuple[str, ...] = TABLE
    """By name."""
    planners: tuple[str, ...] = ("wait_and_drop", *FORECASTS, "untrained")
    """Of the task, or of `FORECASTS`."""
    tracks: tuple[str, ...] = ("kalman",)
    """By name; with ``held`` there is none."""


def sees_by(planner: DynamicPlanner, track: str, sensor: Sensor, control_step: float) -> Any:
    """``planner`` behind the track of that name, told the noise of ``sensor``."""
    found = TRACKS[track](sensor)
    return planner if found is None else TrackedPlanner(planner, found, control_step=control_step)


def main(arguments: Arguments) -> None:
    """Measure every row."""
    task = load_task(TASK)
    study = Study(arguments, scene=task.digest())
    settings = [Setting(task, arguments, velocity=velocity) for velocity in arguments.velocities]
    cases = itertools.product(arguments.tracks, settings, arguments.sensors, arguments.planners)
    with measuring():
        for track, setting, sensor, name in cases:
            about = setting.about | {"sensor": sensor, "planner": name, "track": track}
            study.row(about, partial(measure, setting, sensor, name, track))


def measure(setting: Setting, sensor: str, name: str, track: str) -> Row:
    """Success of the planner ``name`` behind ``track``, with ``sensor``."""
    planner = FORECASTS[name](setting.planner("wait_and_drop")) if name in FORECASTS else setting.planner(name)
    seeing = sees_by(planner, track, SENSORS[sensor], setting.task.control_step)
    return success_of(setting.play(seeing, name, SENSORS[sensor]))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
