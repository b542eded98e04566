"""Chase with thousands of rows: share met, time compared with the optimum, and duration of a step.

python benchmarks/chase.py --out benchmarks/results/chase.json
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import torch
import tyro
from study import Output, Row, Study, each, measuring, rate_entries

from torchdyn_plan.evaluation.episodes import find_truth
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.chase.optimum import earliest_meeting
from torchdyn_plan.tasks.chase.task import TASK, world


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Meet walkers, all of them side by side."""

    planners: tuple[str, ...] = ("pursuit", "meet")
    """Planners."""
    rows: tuple[int, ...] = (500, 4096)
    """Episodes that run side by side, each one once."""
    speeds: tuple[float, ...] = (1.0,)
    """Speeds of the walkers [m/s]."""
    turning: float = 0.0
    """How fast they turn [deg/s]."""
    split: str = "test"
    """Family of episodes."""
    seed: int = 0
    """Series of episodes."""


def measured(planner: str, rows: int, speed: float, arguments: Arguments) -> Row:
    """Successes and times of ``rows`` episodes, and wall time of a step of all of them."""
    settings: Any = TASK.default_settings(speed=speed, turning=arguments.turning)
    series: dict[str, Any] = {"seed": arguments.seed, "split": arguments.split}
    truth = find_truth(TASK, settings, episodes=rows, **series)
    least = earliest_meeting(world(), truth.future)
    env, acting = TASK.make_env(settings, num_envs=rows, **series), TASK.planner(planner)
    state, met = env.reset(), torch.full((rows,), -1)
    planning = stepping = 0.0
    with torch.no_grad():
        for step in range(1, env.max_steps + 1):
            begun = time.perf_counter()
            state = acting(state)
            planned = time.perf_counter()
            # Without resets: each row plays its own episode, and stands still afterwards for all that counts.
            stepped = env.step(state)["next"]
            planning, stepping = planning + planned - begun, stepping + time.perf_counter() - planned
            met = torch.where((met < 0) & stepped["met"].squeeze(-1), step, met)
            state = stepped.set("plan", state["plan"]) if "plan" in state.keys() else stepped  # noqa: SIM118
    both = (met > 0) & (least > 0)
    count = rows * env.max_steps
    return {
        **rate_entries("success", int((met > 0).sum()), rows),
        "optimum_success": int((least > 0).sum()) / rows,
        "earlier_than_the_optimum": int((met[both] < least[both]).sum()),
        "time_by_least": (met[both] / least[both]).mean().item(),
        "planner_us_per_row_step": 1e6 * planning / count,
        "world_us_per_row_step": 1e6 * stepping / count,
        "row_steps_per_second": count / (planning + stepping),
    }


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    study = Study(arguments, scene=load_task("chase").digest())
    with measuring():
        for rows in each(arguments.rows, "rows"):
            for speed in arguments.speeds:
                for planner in arguments.planners:
                    about = {"planner": planner, "rows": rows, "speed": speed, "turning": arguments.turning}
                    study.row(about, lambda a=about: measured(a["planner"], a["rows"], a["speed"], arguments))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
