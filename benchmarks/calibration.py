"""How the Trapper scene compares with the paper: solvable shares and target pursuit, which hardly depend on planning.

python benchmarks/calibration.py --out benchmarks/results/calibration.json
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import tyro
from study import Episodes, Row, Setting, Study, each, measuring, rate_entries
from torch import Tensor

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.paper import FRICTION_VELOCITY

SOLVABLE = {0.0: 0.35, 1.0: 0.65, 2.0: 0.82, 3.0: 0.79, 4.0: 0.68, 5.0: 0.54}
"""Velocity [m/s] → share of solvable episodes: the paper's rate over all episodes by that over solvable ones."""
PURSUIT = {1.0: 0.40, 2.0: 0.42, 3.0: 0.34, 4.0: 0.22, 5.0: 0.12}
"""Velocity [m/s] → the paper's success of target pursuit with IK over all episodes."""
FRICTION = {0.0: 0.78, 2.5: 0.78, 5.0: 0.76, 7.5: 0.68, 9.5: 0.64}
"""Friction loss [N] → share of solvable episodes at `FRICTION_VELOCITY`."""

Case = tuple[str, float, float, float]
"""What is measured, velocity [m/s], friction loss [N], and the paper's figure."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Measure the calibration figures of the scene."""

    episodes: int = 2000
    pursuit_episodes: int = 1000
    """Episodes for each row of target pursuit."""
    split: str = "test"
    num_envs: int = 256


def cases() -> list[Case]:
    """Every figure of the paper that the scene is compared with."""
    solvable = [("solvable", velocity, 0.0, paper) for velocity, paper in SOLVABLE.items()]
    friction = [("solvable", FRICTION_VELOCITY, friction, paper) for friction, paper in FRICTION.items()]
    pursuit = [("pursuit", velocity, 0.0, paper) for velocity, paper in PURSUIT.items()]
    return solvable + friction + pursuit


def row_of(what: str, setting: Setting, paper: float) -> Row:
    """Our figure, and how far it is from the paper's."""
    measured: dict[str, Callable[[], Tensor]] = {
        "solvable": lambda: setting.solvable,
        "pursuit": lambda: setting.play(setting.planner("pursuit"), "pursuit").success,
    }
    found = measured[what]()
    share = rate_entries("ours", int(found.sum()), len(found))
    return share | {"difference": share["ours"] - paper}


def main(arguments: Arguments) -> None:
    """Measure, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    pursued = dataclasses.replace(arguments, episodes=arguments.pursuit_episodes)
    with measuring():
        for what, velocity, friction, paper in each(cases(), "calibration"):
            count = pursued if what == "pursuit" else arguments
            setting = Setting(task, count, velocity=velocity, friction=friction)
            # One setting stands in both of the paper's sweeps, with two figures.
            about = {"what": what, "paper": paper, **setting.about}
            study.row(about, partial(row_of, what, setting, paper))
    study.save(sizes=dataclasses.asdict(TrapperScene()))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
