"""Measure an arrival map that ships with the package, from which solvability follows (a minute or two).

python benchmarks/measure_arrivals.py
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from study import measuring

from torchdyn_plan.envs.trapper.scene import trapper_scene
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.solvable import SHIPPED, arrivals_name, measure_arrivals, save_arrivals


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Drive the arm from home to every point of a grid over the table."""

    static: str = "ik"
    """Static planner."""
    scene: str = "ur5"
    """Scene of the task."""


def main(arguments: Arguments) -> None:
    """Measure and write into the package."""
    task, scene = load_task("trapper", arguments.scene), trapper_scene(arguments.scene)
    planner = task.static_planner(arguments.static, chunk=task.rows_at_once[1])
    with measuring():
        arrivals = measure_arrivals(planner, scene)
    save_arrivals(arrivals, SHIPPED / arrivals_name(arguments.static, scene))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
