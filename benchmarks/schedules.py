"""When to plan anew: success against what planning costs, for schedules of every kind.

    python benchmarks/schedules.py --out benchmarks/results/schedules.json

Cost: plans and looks (an event-triggered schedule's, one arrival pass each) of an episode, times what one of them takes
on one thread for one robot. A killed run continues: rows that the file holds already are not run again, but how long a
plan takes is measured anew.
"""

import dataclasses
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.bench_replan import observations
from torchdyn_plan.evaluation.planners import PLANNERS
from torchdyn_plan.evaluation.play import one_thread
from torchdyn_plan.evaluation.results import summarize
from torchdyn_plan.evaluation.run import record_truth, run_episodes
from torchdyn_plan.evaluation.timing import figures, sample
from torchdyn_plan.files import write_json
from torchdyn_plan.planners import DynamicPlanner, EventSchedule, ReplanSchedule, Schedule
from torchdyn_plan.planners.schedule import Clock, Drift, Look
from torchdyn_plan.versions import library_versions, machine

SCHEDULES: dict[str, Schedule] = {
    "paper": ReplanSchedule(),
    "every 25": ReplanSchedule.every(25),
    "every 10": ReplanSchedule.every(10),
    "every 5": ReplanSchedule.every(5),
    "events, up to 25": EventSchedule(maximum=25),
    "events, up to 50": EventSchedule(maximum=50),
    "events, up to 50, 1 mm": EventSchedule(maximum=50, miss=0.001),
}


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Compare schedules."""

    out: Path
    """JSON file for the figures."""
    planners: tuple[str, ...] = ("meet", "exact")
    """Planners for the moving target."""
    velocities: tuple[float, ...] = (3.0, 5.0)
    """[m/s]"""
    schedules: tuple[str, ...] = tuple(SCHEDULES)
    """Names of schedules."""
    episodes: int = 128
    """Episodes a row."""
    split: str = "dev"
    """Series of episodes."""
    seed: int = 1
    """Which of them."""
    threads: int = 1
    """Threads of the simulation, 0 for all cores."""


class Counted:
    """A schedule that counts its plans and the looks that it takes."""

    def __init__(self, schedule: Schedule) -> None:
        """Count those of ``schedule``."""
        self.schedule, self.watches, self.longest = schedule, schedule.watches, schedule.longest
        self.plans, self.looks = 0, 0

    def start(self, step_count: Tensor) -> Clock:
        """As the schedule's own."""
        return self.schedule.start(step_count)

    def tick(
        self, clock: Clock | None, step_count: Tensor, *, busy: Tensor | None = None, look: Look
    ) -> tuple[Clock, Tensor]:
        """As the schedule's own."""

        def counted(rows: Tensor) -> Drift:
            self.looks += int(rows.sum())
            return look(rows)

        clock, due = self.schedule.tick(clock, step_count, busy=busy, look=counted)
        self.plans += int(due.sum())
        return clock, due


def durations(planner: DynamicPlanner) -> tuple[float, float]:
    """Medians of what a plan and a look take, for one robot on one thread [ms]."""
    seen = observations(1)
    state, target, tool = seen[keys.ROBOT_STATE], seen[keys.TARGET_POS], seen[keys.TOOL_POS]
    steps = torch.tensor([50])
    plan = partial(planner.plan_ahead, state, target, tool, steps, seen[keys.TARGET_HISTORY])
    look = partial(planner.eta.arrival, state.unsqueeze(1), target.unsqueeze(1), reading="expectation")
    medians = [figures(sample(function), 1)["median_us"] / 1000 for function in (plan, look)]
    return medians[0], medians[1]


def run(arguments: Arguments, velocity: float) -> None:
    """Run the rows at one velocity that the file lacks, and write each when it is done."""
    setting = EvaluateArguments(
        velocity=velocity, episodes=arguments.episodes, split=arguments.split, seed=arguments.seed,
        num_envs=arguments.episodes, threads=arguments.threads,
    )  # fmt: skip
    future, solvable = record_truth(setting)
    for name in arguments.planners:
        for label in arguments.schedules:
            about = {
                "planner": name, "velocity": velocity, "schedule": label, "split": arguments.split,
                "seed": arguments.seed, "episodes": arguments.episodes,
            }  # fmt: skip
            rows = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
            if any(about.items() <= row.items() for row in rows):
                continue
            planner = PLANNERS[name]("ik")
            assert isinstance(planner, DynamicPlanner)
            planner.schedule = schedule = Counted(SCHEDULES[label])
            outcomes = run_episodes(planner, setting, future, solvable, f"{name}, {label}")
            row = summarize(outcomes, planner=name, static="ik", velocity=velocity, friction=0.0)
            # Environments go on after the last episode that counts: the ratio does not mind.
            looks = row.replans * schedule.looks / schedule.plans
            result = about | {
                "success_solvable": row.success_solvable, "success_solvable_ci": row.success_solvable_ci,
                "replans": row.replans, "looks": looks, "failures": row.failures,
                "settings": dataclasses.asdict(schedule.schedule),  # pyright: ignore
            }  # fmt: skip
            print({key: value for key, value in result.items() if key != "settings"}, flush=True)
            write(arguments, [*rows, result])


def write(arguments: Arguments, rows: list[dict[str, Any]]) -> None:
    """Write ``rows`` with what planning costs: how long plans and looks take is measured anew, for all alike."""
    costs: dict[str, tuple[float, float]] = {}
    for row in rows:
        name = row["planner"]
        if name not in costs:
            planner = PLANNERS[name]("ik")
            assert isinstance(planner, DynamicPlanner)
            costs[name] = durations(planner)
        plan_ms, look_ms = costs[name]
        row |= {"plan_ms": plan_ms, "look_ms": look_ms}
        row |= {"planning_ms": row["replans"] * plan_ms + row["looks"] * look_ms}
    about = {"machine": machine(), "versions": library_versions(), "scene": TrapperScene().digest()}
    write_json(arguments.out, about | {"arguments": dataclasses.asdict(arguments) | {"out": None}, "rows": rows})


if __name__ == "__main__":
    arguments = tyro.cli(Arguments)
    with torch.no_grad(), one_thread():
        for velocity in arguments.velocities:
            run(arguments, velocity)
        write(arguments, json.loads(arguments.out.read_text())["rows"])
