"""Measure the arrival map that ships with the package, from which solvability follows (a minute or two).

python benchmarks/measure_arrivals.py
"""

from dataclasses import dataclass

import torch
import tyro

from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.planners import static_planner
from torchdyn_plan.evaluation.solvability import SHIPPED, arrivals_name, measure_arrivals, save_arrivals


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Drive the arm from home to every point of a grid over the table."""

    static: str = "ik"
    """Static planner."""


def main(arguments: Arguments) -> None:
    """Measure and write into the package."""
    torch.set_num_threads(1)
    scene = TrapperScene()
    arrivals = measure_arrivals(static_planner(arguments.static), scene)
    save_arrivals(arrivals, SHIPPED / arrivals_name(arguments.static, scene))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
