"""The static task: share of the resting balls within the arm's reach that the static planner traps.

python benchmarks/static_task.py --out benchmarks/results/static_task.json
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from study import Episodes, Row, Setting, Study, measuring, rate_entries

from torchdyn_plan.envs.trapper.scene import trapper_scene
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.workspace import is_coverable, is_reachable


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Drop the box over balls that lie still."""

    static: str = "ik"
    """Static planner: ik or rl."""
    scene: str = "ur5"
    """Scene: ur5 or paper."""
    episodes: int = 1000
    split: str = "test"
    num_envs: int = 256


def row_of(setting: Setting) -> Row:
    """How many of the balls that can be covered are trapped, and where those lie that are not."""
    arguments, scene = setting.arguments, trapper_scene(setting.task.scene)
    episodes = torch.arange(arguments.episodes)
    place, _ = draw_starts(scene, episodes, velocity=0.0, split=arguments.split, seed=arguments.seed)
    groups = {"coverable": is_coverable(scene, place), "reachable": is_reachable(scene, place)}
    trapped = setting.play(setting.planner("pursuit"), "pursuit").success
    row: Row = {"trapped_of_all": int(trapped.sum()), "solvable": int(setting.solvable.sum())}
    for name, group in groups.items():
        row |= {name: int(group.sum())}
        row |= rate_entries(f"success_{name}", int((trapped & group).sum()), int(group.sum()))
    missed = place[groups["coverable"] & ~trapped]
    beyond = place[trapped & ~groups["coverable"]]
    for name, balls in (("not_trapped", missed), ("trapped_beyond", beyond)):
        row[name] = [[round(value, 3) for value in ball] for ball in balls.tolist()]
    return row


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper", arguments.scene)
    study = Study(arguments, scene=task.digest())
    setting = Setting(task, arguments, static=arguments.static, velocity=0.0)
    with measuring():
        study.row({"static": arguments.static, **setting.about}, lambda: row_of(setting))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
