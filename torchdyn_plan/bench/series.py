"""All benchmarks in one run and one file, so that versions of the package can be compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torchdyn_plan.bench import env, kinematics, replan
from torchdyn_plan.bench.record import Record, Row
from torchdyn_plan.checks import check_number
from torchdyn_plan.tasks import DEFAULT, Task, load_task

BENCHMARKS: Mapping[str, Callable[..., Sequence[Row]]] = {
    "kinematics": kinematics.bench,
    "replan": replan.bench,
    "env": env.bench,
}
"""Each benchmark, in the order in which they run."""


def bench(
    task: Task | str = DEFAULT,
    *,
    seconds: float = 0.2,
    compiled: bool = False,
    only: Mapping[str, Mapping[str, Any]] | None = None,
    out: str | Path | None = None,
    progress: bool = True,
    show: Callable[[Row], object] | None = None,
) -> list[Row]:
    """The rows of every benchmark, each with the ``benchmark`` that it is of.

    Args:
        task: whose planners and simulation are measured.
        seconds: time spent on each figure of kinematics and re-plans.
        compiled: measure compiled forms too, which take minutes to compile.
        only: further arguments of each benchmark by its name; the others are left out. None runs all of them.
        out: JSON file for the rows, with versions, machine and commit, written with each row.
        progress: show progress bars.
        show: is given each row once it is measured and saved.

    Raises:
        InputError: a number is out of range, or an argument of a benchmark is wrong.
        OutputError: the file cannot be written.
    """
    task = load_task(task)
    check_number("seconds", seconds, minimum=0.0)
    about = {"task": task.name, "seconds": seconds, "compiled": compiled}
    chosen = {name: {} for name in BENCHMARKS} if only is None else only
    record = Record(
        out, show=show, benchmark="all", **about, benchmarks={name: dict(own) for name, own in chosen.items()}
    )
    timing = {"seconds": seconds, "compiled": compiled}
    for name, own in chosen.items():
        shared = {"task": task, "progress": progress} | ({} if name == "env" else timing)
        BENCHMARKS[name](**shared | dict(own), show=partial(_add, record, name))
    return record.end()


def _add(record: Record, name: str, row: Mapping[str, Any]) -> None:
    record.add({"benchmark": name, **row})
