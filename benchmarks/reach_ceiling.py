"""Which moving goals of Reach can be reached at all, and under which reading of the task the paper's curve is possible.

With the goal's whole path known, the gripper is pulled from the first step on to where the goal will be at some step,
for every step that is not out of the question; the ceiling is the share of episodes in which it is met so, verified by
simulation. The bound counts episodes whose goal is at some step no farther than the gripper could move along each axis.

python benchmarks/reach_ceiling.py --out benchmarks/results/reach_ceiling.json
"""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from torchdyn_plan.envs.fetch import compile_fetch, fetch_digest, settle
from torchdyn_plan.envs.goal_motion import draw_goals, goal_places
from torchdyn_plan.envs.reach import MAX_STEPS, THRESHOLD
from torchdyn_plan.evaluation.intervals import rate
from torchdyn_plan.evaluation.paper import paper_reach
from torchdyn_plan.evaluation.reach_ceiling import earliest_meeting, is_in_range
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One reading of the task: DHER's code, but for what is named."""

    motion: str = "straight"
    threshold: float = THRESHOLD
    goal_range: float = 0.1
    level: bool = True
    goal_first: bool = True
    unit: float = 1.0
    """Metres a step for a velocity of one; 0.04 if the paper's velocities are metres per second."""


READINGS = {
    "DHER's code": Reading(),
    "goal moves after the physics": Reading(goal_first=False),
    "threshold 0.02 m": Reading(threshold=0.02),
    "threshold 0.05 m, FetchReach's": Reading(threshold=0.05),
    "start within 0.15 m, FetchReach's": Reading(goal_range=0.15),
    "start within 0.15 m, threshold 0.02 m": Reading(goal_range=0.15, threshold=0.02),
    "start within 0.15 m, any direction": Reading(goal_range=0.15, motion="random"),
    "start at any height": Reading(level=False),
    "any direction": Reading(motion="random"),
    "any direction, threshold 0.02 m": Reading(motion="random", threshold=0.02),
    "metres per second": Reading(unit=0.04),
    "circle": Reading(motion="circle"),
}


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Measure the ceilings."""

    velocities: tuple[float, ...] = (0.001, 0.006, 0.011, 0.016, 0.021, 0.026, 0.031, 0.036, 0.041, 0.046, 0.051)
    """The paper's, for DHER's code [m per control step]."""
    episodes: int = 1000
    """Episodes a velocity, for DHER's code."""
    other_velocities: tuple[float, ...] = (0.011, 0.021, 0.031, 0.041, 0.051)
    """For the other readings."""
    other_episodes: int = 1000
    """Episodes a velocity, for the other readings."""
    readings: tuple[str, ...] = field(default_factory=lambda: tuple(READINGS))
    """Which readings."""
    split: str = "test"
    """Series of episodes."""
    seed: int = 0
    """Seed of the series."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores."""
    bounds_alone: bool = False
    """Leave out the simulation: no ceilings, and the bounds in seconds."""
    out: Path | None = None
    """JSON file for the figures."""


def measure(reading: Reading, velocity: float, count: int, arguments: Arguments) -> dict[str, Any]:
    """Ceiling and bound of one reading at one velocity."""
    tool_pos = settle(compile_fetch()).tool_pos
    starts = draw_goals(
        torch.arange(count), tool_pos, motion=reading.motion, goal_range=reading.goal_range, split=arguments.split,
        seed=arguments.seed, level=reading.level,
    )  # fmt: skip
    setting = {"motion": reading.motion, "velocity": velocity * reading.unit}
    found = (
        torch.zeros(0)
        if arguments.bounds_alone
        else earliest_meeting(
            starts, threshold=reading.threshold, goal_first=reading.goal_first, num_threads=arguments.threads, **setting
        )
    )
    possible = torch.zeros(count, dtype=torch.bool)
    for step in range(1, MAX_STEPS + 1):
        moves = torch.full((count,), step - (not reading.goal_first))
        possible |= is_in_range(goal_places(starts, moves, **setting), tool_pos, step, reading.threshold)
    tried = not arguments.bounds_alone
    ceiling = rate(int((found > 0).sum()), len(found))
    return {
        "velocity": velocity, "episodes": count, "ceiling": ceiling.value if tried else None,
        "ceiling_ci": [ceiling.low, ceiling.high] if tried else None, "bound": float(possible.double().mean()),
        "steps": _mean(found[found > 0].double()),
    }  # fmt: skip


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if len(values) else None


def main(arguments: Arguments) -> None:
    """Measure, print and write."""
    torch.set_num_threads(1)
    paper = dict(zip(*paper_reach("dynamic"), strict=True))
    rows = []
    for name in tqdm(arguments.readings, desc="ceiling", unit="reading", leave=False):
        first = name == next(iter(READINGS))
        for velocity in arguments.velocities if first else arguments.other_velocities:
            count = arguments.episodes if first else arguments.other_episodes
            row = measure(READINGS[name], velocity, count, arguments)
            rows.append({"reading": name} | asdict(READINGS[name]) | row | {"paper": paper.get(velocity)})
            low, high = row["ceiling_ci"] or (0.0, 1.0)
            told = "" if arguments.bounds_alone else f"{row['ceiling']:.3f} [{low:.3f}–{high:.3f}]"
            print(f"{name:36s} {velocity:.3f}  {told}  at most {row['bound']:.3f}  paper {paper.get(velocity)}")
    if arguments.out is not None:
        config = asdict(arguments) | {"out": str(arguments.out), "scene": fetch_digest()}
        write_json(
            arguments.out, {"config": config, "machine": machine(), "versions": library_versions(), "rows": rows}
        )


if __name__ == "__main__":
    main(tyro.cli(Arguments))
