"""How far joints exceed their speed limits when a ball is trapped, and what gentler drops would cost.

python benchmarks/braking.py --episodes 300 --out benchmarks/results/braking.json
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
import tyro
from study import Episodes, Row, Setting, Study, change_entries, each, measuring, success_of

from torchdyn_plan.evaluation.results import EpisodeOutcomes
from torchdyn_plan.tasks import load_task

DROPS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "follows from the first step": {"follow_after": 0},
    "follows late": {"follow_after": 6},
    "aims 10 steps ahead": {"aim_ahead_steps": 10},
    "aims 14 steps ahead": {"aim_ahead_steps": 14},
    "aims where the ball is": {"aim_ahead_steps": 0},
    "begins lower": {"begin_above": 0.7},
}
"""Changes of `WaitAndDrop`."""
STOPS: dict[str, dict[str, Any]] = {
    "stops 1.2 cm above the table": {"down_height": 0.012},
    "stops 2 cm above the table": {"down_height": 0.02},
    "stops 3 cm above the table": {"down_height": 0.03},
}
"""Changes of `BoxApproach`: a box that brakes before it is down, so that it never touches the table."""
GAINS: dict[str, dict[str, Any]] = {
    "brakes earlier": {"gain": 0.18},
    "brakes much earlier": {"gain": 0.12},
}
"""Changes of `IKPlanner`: the nearer to its goal, the slower."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Drop gently."""

    velocity: float = 3.0
    """[m/s]"""


def speeds(outcomes: EpisodeOutcomes) -> Row:
    """Peaks of joint speeds over their limits, of the episodes that are a success."""
    speed = outcomes.evidence["joint_speed"][outcomes.success].double()
    if not len(speed):
        return {"traps": 0}
    points = torch.quantile(speed, torch.tensor([0.5, 0.9], dtype=speed.dtype)).tolist()
    share = (speed > 1.02).double().mean().item()
    return {"traps": len(speed), "peak": speed.max().item(), "p50": points[0], "p90": points[1], "above": share}


def planner(setting: Setting, name: str) -> Any:
    """The planner that waits and drops, with one change."""
    made = setting.planner("wait_and_drop")
    if name in DROPS:
        return made.with_parts(maneuver=dataclasses.replace(made.maneuver, **DROPS[name]))
    own = made.static.part_settings() | GAINS.get(name, {})
    own["approach"] = dataclasses.replace(own["approach"], **STOPS.get(name, {}))
    return made.with_parts(static=type(made.static)(**own))


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study, setting = Study(arguments, scene=task.digest()), Setting(task, arguments, velocity=arguments.velocity)
    with measuring():
        for name in each([*DROPS, *STOPS, *GAINS], "drops"):

            def measure(name: str = name) -> Row:
                outcomes = setting.play(planner(setting, name), name)
                row = success_of(outcomes) | speeds(outcomes)
                return row | (change_entries(study.rows[0], row) if study.rows else {})

            study.row({"drop": name, **setting.about}, measure)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
