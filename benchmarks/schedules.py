"""When to plan again: success and planning cost for different schedules.

    python benchmarks/schedules.py --out benchmarks/results/schedules.json

Cost: the number of plans and checks in an episode (an event-triggered schedule's checks, one arrival pass each), times
the duration of one on one thread for one robot. Durations are measured at the end of a run, for all rows in the file.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import tyro
from study import Episodes, Row, Setting, Study, each, measuring, success_of
from torch import Tensor

from torchdyn_plan.bench.observations import moments, observe
from torchdyn_plan.bench.timing import figures, sample
from torchdyn_plan.evaluation.results import failure_shares
from torchdyn_plan.planners import EventSchedule, Observation, Plan, ReplanSchedule, Schedule
from torchdyn_plan.planners.schedule import Clock, Late
from torchdyn_plan.tasks import Task, load_task

SCHEDULES: dict[str, ReplanSchedule | EventSchedule] = {
    "paper": ReplanSchedule(),
    "every 25": ReplanSchedule.every(25, first_step=3),
    "every 10": ReplanSchedule.every(10, first_step=3),
    "every 5": ReplanSchedule.every(5, first_step=3),
    "events, up to 25": EventSchedule(first_step=3, maximum=25),
    "events, up to 50": EventSchedule(first_step=3, maximum=50),
    "events, up to 50, 1 mm": EventSchedule(first_step=3, maximum=50, miss=0.001),
}


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Compare schedules."""

    planners: tuple[str, ...] = ("wait_and_drop", "exact")
    """Planners for the moving target."""
    velocities: tuple[float, ...] = (3.0, 5.0)
    """[m/s]"""
    schedules: tuple[str, ...] = tuple(SCHEDULES)
    """Names of schedules."""
    episodes: int = 128
    seed: int = 1


class Counted:
    """A schedule that counts its plans and the looks that it takes."""

    def __init__(self, schedule: Schedule) -> None:
        """Count those of ``schedule``."""
        self.schedule, self.watches, self.longest = schedule, schedule.watches, schedule.longest
        self.plans, self.looks = 0, 0

    def start(self, observation: Observation) -> Clock:
        """As the schedule's own."""
        return self.schedule.start(observation)

    def tick(
        self, clock: Clock, observation: Observation, plan: Plan, *, busy: Tensor | None, late: Late
    ) -> tuple[Clock, Tensor]:
        """As the schedule's own."""

        def counted(rows: Tensor) -> Tensor:
            self.looks += int(rows.sum())
            return late(rows)

        clock, due = self.schedule.tick(clock, observation, plan, busy=busy, late=counted)
        self.plans += int(due.sum())
        return clock, due


def row_of(setting: Setting, name: str, label: str) -> Row:
    """Success under a schedule, and how often it plans and looks."""
    schedule: Any = Counted(SCHEDULES[label])
    outcomes = setting.play(setting.planner(name, schedule=schedule), f"{name}, {label}")
    found = success_of(outcomes)
    # Environments go on after the last episode that counts: the ratio does not mind.
    looks = found["replans"] * schedule.looks / schedule.plans
    settings = dataclasses.asdict(SCHEDULES[label])
    return found | {"looks": looks, "failures": failure_shares(outcomes), "settings": settings}


def durations(task: Task, name: str) -> tuple[float, float]:
    """Medians of what a plan and a look take, for one robot on one thread [ms]."""
    planner = task.planner(name)
    observation = observe(planner, moments(task, planner, name).planning[:1])
    state, goal = observation.robot_state.unsqueeze(1), observation.target_pos.unsqueeze(1)
    plan = partial(planner.replan, observation, Plan.hold(observation, 0))
    look = partial(planner.eta.arrival, state, goal, estimator="expectation")
    plan_ms, look_ms = (figures(sample(function), 1)["median_us"] / 1000 for function in (plan, look))
    return plan_ms, look_ms


def add_costs(study: Study, task: Task) -> None:
    """Add what planning costs to every row."""
    costs = {name: durations(task, name) for name in dict.fromkeys(row["planner"] for row in study.rows)}
    for row in study.rows:
        plan_ms, look_ms = costs[row["planner"]]
        row |= {"plan_ms": plan_ms, "look_ms": look_ms}
        row["planning_ms"] = row["replans"] * plan_ms + row["looks"] * look_ms
    study.save()
    for name, (plan_ms, look_ms) in costs.items():
        print(f"{name}: a plan takes {plan_ms:.3f} ms, a look {look_ms:.3f} ms")


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    with measuring():
        for velocity in arguments.velocities:
            setting = Setting(task, arguments, velocity=velocity)
            for name in arguments.planners:
                for label in each(arguments.schedules, name):
                    about = {"planner": name, "schedule": label, **setting.about}
                    study.row(about, partial(row_of, setting, name, label))
        add_costs(study, task)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
