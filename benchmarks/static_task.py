"""The static task: how many of the balls that lie still, and that the arm can cover at all, the static planner traps.

python benchmarks/static_task.py --out benchmarks/results/static_task.json
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from study import Episodes, Row, Setting, Study, measuring, rate_entries

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.workspace import is_reachable


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Drop the box over balls that lie still."""

    static: str = "ik"
    """Static planner: ik or rl."""
    episodes: int = 1000
    split: str = "test"
    num_envs: int = 256


def row_of(setting: Setting) -> Row:
    """How many of the balls within reach are trapped, and where those lie that are not."""
    arguments = setting.arguments
    episodes = torch.arange(arguments.episodes)
    place, _ = draw_starts(TrapperScene(), episodes, velocity=0.0, split=arguments.split, seed=arguments.seed)
    reachable = is_reachable(TrapperScene(), place)
    trapped = setting.play(setting.planner("pursuit"), "pursuit").success
    share = rate_entries("success", int((trapped & reachable).sum()), int(reachable.sum()))
    missed = [[round(value, 3) for value in ball] for ball in place[reachable & ~trapped].tolist()]
    return {"reachable": int(reachable.sum()), **share, "not_trapped": missed}


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    setting = Setting(task, arguments, static=arguments.static, velocity=0.0)
    with measuring():
        study.row({"static": arguments.static, **setting.about}, lambda: row_of(setting))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
