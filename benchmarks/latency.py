"""Cost of planning latency: the same episodes with delayed plans, compensated or not.

python benchmarks/latency.py --split test --episodes 1000 --out benchmarks/results/latency/results.json
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from study import Episodes, Row, Setting, Study, change_entries, each, measuring, success_of

from torchdyn_plan.evaluation.results import failure_shares
from torchdyn_plan.planners import Delayed
from torchdyn_plan.tasks import load_task


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Measure what latency costs."""

    planners: tuple[str, ...] = ("wait_and_drop",)
    """Planners for the moving target."""
    velocities: tuple[float, ...] = (3.0, 5.0)
    """[m/s]"""
    latencies: tuple[int, ...] = (0, 4, 20, 36)
    """[ms]; the first is what the others are compared with."""
    not_compensated: tuple[int, ...] = (20,)
    """Those that are run with a planner that does not allow for it, too [ms]."""


def compare(study: Study, setting: Setting, name: str, arguments: Arguments) -> None:
    """A row for each latency of one planner at one setting."""
    cases = [(latency, True) for latency in arguments.latencies]
    cases += [(latency, False) for latency in arguments.not_compensated]
    first: Row | None = None
    for latency, compensate in each(cases, name):
        steps = round(latency / (1000 * setting.task.control_step))
        delivery = Delayed(steps, compensate=compensate) if steps else None

        def measure(delivery: Delayed | None = delivery, first: Row | None = first) -> Row:
            outcomes = setting.play(setting.planner(name, delivery=delivery), name)
            found = success_of(outcomes) | {"failures": failure_shares(outcomes)}
            return found | change_entries(first or found, found)

        about = {"planner": name, "latency_ms": latency, "compensate": compensate}
        row = study.row(about | setting.about, measure)
        first = first or row


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    with measuring():
        for velocity in arguments.velocities:
            setting = Setting(task, arguments, velocity=velocity)
            for name in arguments.planners:
                compare(study, setting, name, arguments)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
