"""Training data of Catch: flights of balls, arrivals of the UR10 at poses; and how networks are scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchdyn_plan.envs.arm_runner import EnvRunner
from torchdyn_plan.envs.catch.env import CatchEnv
from torchdyn_plan.envs.catch.scene import GRAVITY
from torchdyn_plan.envs.catch.throws import draw_throws
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.kinematics.flight import fly
from torchdyn_plan.nets.eta import ETAConfig
from torchdyn_plan.nets.forecaster import ForecasterConfig
from torchdyn_plan.planners import AgainstVelocity, BallisticTrack, StaticPlanner
from torchdyn_plan.tasks.catch.task import DRAG, HORIZON, ik, scene
from torchdyn_plan.training.arrival_data import Arrivals
from torchdyn_plan.training.collect import SERIES
from torchdyn_plan.training.fitting import Fitting
from torchdyn_plan.training.metrics import arrival_groups
from torchdyn_plan.training.optimise import Recipe
from torchdyn_plan.training.path_data import lay_end_to_end
from torchdyn_plan.training.runs import RunPlan, record_runs
from torchdyn_plan.training.sighted_data import Sighting
from torchdyn_plan.training.sightings import SensorRange
from torchdyn_plan.training.windows import WindowConfig

PATH_STEPS = 240
"""Control steps of a recorded flight, through arm and floor: a forecast from any step of the first 0.9 s."""
LATEST = 115
"""Last control step from which a flight is forecast in training behind a track."""
FLIGHTS = (0.4, 1.0)
"""Least and greatest mean time of flight to the place that is aimed at [s]."""
MOST_DRAG, TENNIS = 0.1, 0.5
"""Greatest drag of a ball [1/m]; share of the balls that have a tennis ball's."""
NEAR, NEARBY = 0.15, 0.85
"""Share `NEARBY` of the arm's goals is on flights within `NEAR` of the time of their aim [s]; the others are anywhere
on them."""
AT_REST = 0.05
"""An arm whose joints are slower than this is at rest [rad/s]."""
SENSORS = {
    "exact": Sensor(),
    "1 mm, 60 Hz": Sensor(noise=0.001, rate=60.0),
    "3 mm, 60 Hz": Sensor(noise=0.003, rate=60.0),
    "10 mm, 60 Hz": Sensor(noise=0.01, rate=60.0),
}
"""Sensors for which forecasts behind a track are scored, by name."""


def record_flights(blocks: Sequence[Tensor], *, seed: int, num_threads: int = 0) -> dict[str, Tensor]:
    """Flights of balls, no arm and no floor in their way, by the law that a test holds against the simulation.

    Half of them are tennis balls. The drag of the others is uniform up to `MOST_DRAG`, as is the mean time of flight.

    Args:
        blocks: numbers of the episodes of the split ``train``; all of them are drawn together.
        seed: which series of episodes.
        num_threads: of no use, as nothing is simulated.

    Returns:
        What `lay_end_to_end` does; the velocity is that of the throw [m/s].
    """
    episodes = torch.cat([*blocks])
    draw = torch.Generator().manual_seed(seed * SERIES + int(episodes[0]))
    path, _, speed = draw_flights(episodes, seed, draw)
    return lay_end_to_end(path.float(), speed)


def draw_flights(episodes: Tensor, seed: int, draw: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Paths (M, PATH_STEPS + 1, 3) [m, world], mean times to their aims (M,) [s] and speeds (M,) [m/s], float64.

    Starts and aims are those of ``episodes`` (M,) of the split ``train``; drags and times of flight come from ``draw``.
    """
    kind, share, time = torch.rand(3, len(episodes), generator=draw, dtype=torch.float64)
    drag = torch.where(kind < TENNIS, DRAG, MOST_DRAG * share).unsqueeze(-1)
    flight = FLIGHTS[0] + time * (FLIGHTS[1] - FLIGHTS[0])
    place, velocity = draw_throws(scene(), episodes, flight=flight, drag=drag, split="train", seed=seed)
    path, _ = fly(place, velocity, step=scene().control_step, count=PATH_STEPS, gravity=GRAVITY, drag=drag)
    return torch.cat([place.unsqueeze(-2), path], dim=-2), flight, velocity.norm(dim=-1)


def record_arm_runs(
    planner: StaticPlanner, *, num_envs: int, sequences: int, seed: int, num_threads: int = 0
) -> dict[str, Tensor]:
    """Runs of ``planner``: ``sequences`` times one sequence of each of ``num_envs`` arms, as `record_runs` returns.

    The balls of the environment fly past: they are on the floor when the second goal is given.
    """
    env = CatchEnv(num_envs, scene=scene(), seed=seed, split="train", num_threads=num_threads)
    runner = EnvRunner(planner, env, at_goal=ik().is_at)
    return record_runs(runner, run_plan(), sequences=sequences, seed=seed)


def run_plan() -> RunPlan:
    """How runs follow one another: goals of `draw_poses`; an arm whose joints are slower than `AT_REST` is at rest."""
    return RunPlan(
        goals=draw_poses,
        at_rest=lambda state: (state[:, 6:12].abs() < AT_REST).all(-1),
        sequence=240,
        longest=120,
        states=12,
        comes_to_rest=False,
        redirected_within=60,
        starting=8,
    )


def draw_poses(count: int, draw: torch.Generator) -> Tensor:
    """Goals ``(count, 7)`` [m, wxyz, world]: places on flights, the cup against the ball's velocity."""
    episodes = torch.randint(2**31, (count,), generator=draw)
    path, flight, _ = draw_flights(episodes, 0, draw)
    kind, share = torch.rand(2, count, generator=draw)
    about = flight + NEAR * (2.0 * share - 1.0)
    anywhere = (FLIGHTS[1] + scene().flight_spread) * share
    step = (torch.where(kind < NEARBY, about, anywhere) / scene().control_step).long().clamp(1, PATH_STEPS)
    turn = AgainstVelocity()(path[:, 1:], path[:, 0], path[:, :1].expand(-1, 2, 3))
    rows = torch.arange(count)
    return torch.cat([path[rows, step], turn[rows, step - 1]], dim=-1).float()


def catch_fitting() -> Fitting:
    """Networks that learn what a tennis ball's flight leaves out, and the arrivals of a cup that is turned."""

    def groups(held: Arrivals) -> dict[str, Tensor]:
        return arrival_groups(held.arrival, held.robot_state[:, 6:12].abs().amax(-1) < AT_REST)

    forecaster = ForecasterConfig(
        history=8,
        horizon=HORIZON,
        channels=16,
        convolutions=2,
        hidden=128,
        rank=16,
        step_scale=0.06,
        length_scale=2.0,
        change_scale=1e-4,
        gravity=GRAVITY,
        drag=DRAG,
        control_step=scene().control_step,
    )
    return Fitting(
        forecaster=forecaster,
        noisy_forecaster=replace(forecaster, tracked=True),
        sighting=Sighting(
            track=BallisticTrack,
            sensors=SensorRange(noise=0.01, latency=0.02),
            regimes=SENSORS,
            steps=LATEST,
        ),
        eta=ETAConfig(robot_state_size=15, tool_slice=(12, 15), bins=60, bin_width=3, hidden=128, turned=True),
        groups=groups,
        windows=WindowConfig(first_step=1, early_share=0.2, shortened_share=0.2),
        ahead=(12, 50, HORIZON),
        fast=0.02,
        recipes={
            "forecaster": Recipe(steps=6_000, batch=256, lr=2e-3, validations=6),
            "eta": Recipe(steps=10_000, batch=512, lr=2e-3, validations=5),
        },
    )
