"""What a better forecast gains: the wait-and-drop planner unchanged, certain of its forecast, or given the true future.

The true future is simulated from the ball's present state, touched or not, with its own friction. All planners play the
same episodes, so that differences to the first are paired.

    python benchmarks/forecast_gain.py --velocity 3 --friction 9.5 --out benchmarks/results/forecast_gain.json
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import tyro
from study import Episodes, Row, Setting, Study, each, measuring
from torch import Tensor

from torchdyn_plan.envs import TrapperScene, TrapperSimulation
from torchdyn_plan.evaluation.episodes import EpisodeLog
from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.planners import DynamicPlanner
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.wait_and_drop import waiting_search

PLANNER = "wait_and_drop"
BALL_STATE = "ball_state"
BALL_SIZES = (3, 4, 3, 3)
"""Entries of a ball's state: place, turn, velocity, spin."""
Z_95 = 1.96
"""Standard deviations of a 95 % interval."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Play the same episodes with each planner."""

    velocity: float = 3.0
    """[m/s]"""
    friction: float = 0.0
    """[N]"""
    seeds: tuple[int, ...] = (1, 2)
    """Series of episodes, in place of one."""
    planners: tuple[str, ...] = (PLANNER, "certain", "truth")
    """The first is what the others are compared to."""


class Foretold(ForecastModel):
    """Stands in for a forecaster and tells how the ball will roll on from its present state if nothing touches it."""

    in_keys = (BALL_STATE,)

    def __init__(self, friction: float, rows: int, horizon: int = 300) -> None:
        """Foretell ``rows`` balls at a time, ``horizon`` control steps, at a friction loss [N]."""
        super().__init__()
        self.rows, self.horizon = rows, horizon
        self.simulation = TrapperSimulation(rows, TrapperScene(), friction=friction, num_threads=1, arm=False)

    def predict(self, *seen: Tensor) -> Forecast:
        """Positions ``(R, F, 3)`` [m, world] after states ``(R, 13)``: place, turn, velocity, spin."""
        simulation, (state,) = self.simulation, seen
        simulation.reset(torch.arange(self.rows), state[:, :2], state[:, 7:9])
        for own, given in zip(_ball(simulation), state.split(BALL_SIZES, dim=-1), strict=True):
            own[:] = given
        path = torch.empty(self.rows, self.horizon, 3)
        for step in range(self.horizon):
            simulation.step()
            path[:, step] = simulation.ball_pos
        return Forecast(path)


def _ball(simulation: TrapperSimulation) -> tuple[Tensor, ...]:
    """Views of the balls' state, `BALL_SIZES` each."""
    return simulation.ball_pos, simulation._ball_turn, simulation.ball_vel, simulation.ball_spin


def planner_of(setting: Setting, name: str) -> DynamicPlanner:
    """The planner of that name."""
    certain = waiting_search(TrapperScene(), by_probability=False)
    parts: dict[str, Any] = {
        PLANNER: {},
        "certain": {"search": certain},
        "truth": {"search": certain, "forecaster": None},
    }[name]
    if "forecaster" in parts:
        friction: Any = setting.changes["friction"]
        parts["forecaster"] = Foretold(friction, setting.task.rows_at_once[0])
    return setting.planner(PLANNER, **parts)


def play(planner: DynamicPlanner, setting: Setting) -> Tensor:
    """Which episodes end with the ball trapped, ``(E,)`` bool."""
    arguments = setting.arguments
    env: Any = setting.task.make_env(
        setting.settings,
        num_envs=min(arguments.episodes, arguments.num_envs),
        seed=arguments.seed,
        split=arguments.split,
        num_threads=arguments.threads,
    )
    log, tensordict = EpisodeLog.empty(arguments.episodes, setting.task, env), env.reset()
    log.traces = None
    foretells = BALL_STATE in planner.in_keys
    while not log.done.all():
        if foretells:
            tensordict[BALL_STATE] = torch.cat(_ball(env.simulation), dim=-1)
        stepped, tensordict = env.step_and_maybe_reset(planner(tensordict))
        log.add(stepped)
    return log.success


def row_of(settings: Sequence[Setting], name: str, first: Row | None) -> Row:
    """Success of a planner over all series, and what it gains over the first one."""
    solvable = torch.cat([setting.solvable for setting in settings])
    caught = torch.cat([play(planner_of(setting, name), setting) for setting in settings])[solvable]
    trapped = caught.nonzero().squeeze(-1).tolist()
    before = torch.zeros(len(caught))
    before[trapped if first is None else first["trapped"]] = 1.0
    gain = caught.double() - before.double()
    return {
        "solvable": len(caught),
        "success_solvable": caught.double().mean().item(),
        "gain": gain.mean().item(),
        "gain_half_width_95": Z_95 * gain.std().item() / len(gain) ** 0.5,
        "trapped": trapped,
    }


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    changes: dict[str, Any] = {"velocity": arguments.velocity, "friction": arguments.friction}
    series = [dataclasses.replace(arguments, seed=seed) for seed in arguments.seeds]
    settings = [Setting(task, one, **changes) for one in series]
    shared = {**settings[0].about, "seed": list(arguments.seeds)}
    first: Row | None = None
    with measuring():
        for name in each(arguments.planners, "forecast gain"):
            row = study.row({"planner": name, **shared}, partial(row_of, settings, name, first))
            first = first or row


if __name__ == "__main__":
    main(tyro.cli(Arguments))
