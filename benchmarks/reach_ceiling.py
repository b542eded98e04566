"""Which moving goals of Reach can be reached at all, and in which variant of the task the paper's curve is possible.

With the goal's whole path known, the gripper is driven from the first step to the goal's position at some step, for
every step that is not impossible; the ceiling is the share of episodes in which this meets the goal, verified by
simulation. The bound counts episodes whose goal is, at some step, within the distance the gripper could have moved
along each axis.

python benchmarks/reach_ceiling.py --out benchmarks/results/reach_ceiling.json
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial

import torch
import tyro
from study import Episodes, Row, Study, each, measuring, rate_entries
from torch import Tensor

from torchdyn_plan.envs.fetch_reach.env import MAX_STEPS, THRESHOLD
from torchdyn_plan.envs.fetch_reach.goal_motion import draw_goals, goal_places
from torchdyn_plan.envs.fetch_reach.simulation import compile_fetch, settle
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.fetch_reach.ceiling import earliest_meeting, is_in_range


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to understand the task: DHER's code, but for what is named."""

    motion: str = "straight"
    threshold: float = THRESHOLD
    goal_range: float = 0.1
    level: bool = True
    goal_first: bool = True
    unit: float = 1.0
    """Metres a step for a velocity of one; 0.04 if the paper's velocities are metres per second."""


VARIANTS = {
    "DHER's code": Variant(),
    "goal moves after the physics": Variant(goal_first=False),
    "threshold 0.02 m": Variant(threshold=0.02),
    "threshold 0.05 m, FetchReach's": Variant(threshold=0.05),
    "start within 0.15 m, FetchReach's": Variant(goal_range=0.15),
    "start within 0.15 m, threshold 0.02 m": Variant(goal_range=0.15, threshold=0.02),
    "start within 0.15 m, any direction": Variant(goal_range=0.15, motion="random"),
    "start at any height": Variant(level=False),
    "any direction": Variant(motion="random"),
    "any direction, threshold 0.02 m": Variant(motion="random", threshold=0.02),
    "metres per second": Variant(unit=0.04),
    "circle": Variant(motion="circle"),
}
FIRST = "DHER's code"
"""Measured at all velocities, the others at fewer."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Measure the ceilings."""

    velocities: tuple[float, ...] = (0.001, 0.006, 0.011, 0.016, 0.021, 0.026, 0.031, 0.036, 0.041, 0.046, 0.051)
    """The paper's, for DHER's code [m per control step]."""
    episodes: int = 1000
    other_velocities: tuple[float, ...] = (0.011, 0.021, 0.031, 0.041, 0.051)
    """For the other variants [m per control step]."""
    other_episodes: int = 1000
    """Episodes for each row of the other variants."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which variants."""
    split: str = "test"
    bounds_alone: bool = False
    """Leave out the simulation: no ceilings, and the bounds in seconds."""


def row_of(variant: Variant, velocity: float, count: int, arguments: Arguments, paper: float | None) -> Row:
    """Ceiling and bound of one variant at one velocity, beside the paper's success."""
    tool_pos = settle(compile_fetch()).tool_pos
    starts = draw_goals(
        torch.arange(count),
        tool_pos,
        motion=variant.motion,
        goal_range=variant.goal_range,
        split=arguments.split,
        seed=arguments.seed,
        level=variant.level,
    )
    motion, moved = variant.motion, velocity * variant.unit
    possible = torch.zeros(count, dtype=torch.bool)
    for step in range(1, MAX_STEPS + 1):
        moves = torch.full((count,), step - (not variant.goal_first))
        places = goal_places(starts, moves, motion=motion, velocity=moved)
        possible |= is_in_range(places, tool_pos, step, variant.threshold)
    bound: Row = {"bound": float(possible.double().mean()), "paper": paper}
    if arguments.bounds_alone:
        return {"ceiling": None, "ceiling_ci": None, "steps": None} | bound
    found = earliest_meeting(
        starts,
        motion=motion,
        velocity=moved,
        threshold=variant.threshold,
        goal_first=variant.goal_first,
        num_threads=arguments.threads,
    )
    met = found > 0
    return rate_entries("ceiling", int(met.sum()), count) | {"steps": _mean(found[met].double())} | bound


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if len(values) else None


def main(arguments: Arguments) -> None:
    """Measure, save and print."""
    task = load_task("fetch_reach")
    assert task.paper
    curve = task.paper().curve("corner", task.default_static, "velocity", task.default_settings(), solvable=False)
    paper = dict(zip(*curve, strict=True)) if curve else {}
    study = Study(arguments, scene=task.digest())
    shared = {"split": arguments.split, "seed": arguments.seed, "bounds_alone": arguments.bounds_alone}
    with measuring():
        for name in each(arguments.variants, "ceiling"):
            count = arguments.episodes if name == FIRST else arguments.other_episodes
            for velocity in arguments.velocities if name == FIRST else arguments.other_velocities:
                variant = VARIANTS[name]
                about = {"variant": name, **asdict(variant), "velocity": velocity, "episodes": count, **shared}
                study.row(about, partial(row_of, variant, velocity, count, arguments, paper.get(velocity)))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
