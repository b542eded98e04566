"""How the Trapper scene compares with the paper: solvable shares and target pursuit, which hardly depend on planning.

python benchmarks/calibration.py --out benchmarks/results/calibration.json
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from torch import Tensor

from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.intervals import rate
from torchdyn_plan.evaluation.paper import FRICTION_VELOCITY
from torchdyn_plan.evaluation.run import record_truth, run_points
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine

SOLVABLE = {0.0: 0.35, 1.0: 0.65, 2.0: 0.82, 3.0: 0.79, 4.0: 0.68, 5.0: 0.54}
"""Velocity [m/s] → share of solvable episodes: the paper's rate over all episodes by that over solvable ones."""
PURSUIT = {1.0: 0.40, 2.0: 0.42, 3.0: 0.34, 4.0: 0.22, 5.0: 0.12}
"""Velocity [m/s] → the paper's success of target pursuit with IK over all episodes."""
FRICTION = {0.0: 0.78, 2.5: 0.78, 5.0: 0.76, 7.5: 0.68, 9.5: 0.64}
"""Friction loss [N] → share of solvable episodes at `FRICTION_VELOCITY`."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Measure the calibration figures of the scene."""

    episodes: int = 2000
    """Episodes a point for solvable shares."""
    pursuit_episodes: int = 1000
    """Episodes a point for target pursuit."""
    split: str = "test"
    """Series of episodes: test, or dev while tuning."""
    seed: int = 0
    """Which series."""
    num_envs: int = 256
    """Episodes side by side; does not change the figures."""
    out: Path | None = None
    """JSON file for the figures."""


def measure(arguments: Arguments) -> list[dict[str, Any]]:
    """A row for each figure of the paper, ours beside it."""
    rows = []
    for velocity, paper in SOLVABLE.items():
        rows.append(_row("solvable", _solvable(arguments, velocity), paper, velocity=velocity))
    for friction, paper in FRICTION.items():
        solvable = _solvable(arguments, FRICTION_VELOCITY, friction)
        rows.append(_row("solvable", solvable, paper, velocity=FRICTION_VELOCITY, friction=friction))
    for velocity, paper in PURSUIT.items():
        setting = _setting(arguments, arguments.pursuit_episodes, velocity)
        rows.append(_row("pursuit", run_points(setting)["pursuit"].trapped, paper, velocity=velocity))
    return rows


def _setting(arguments: Arguments, episodes: int, velocity: float, friction: float = 0.0) -> EvaluateArguments:
    return EvaluateArguments(
        planners=("pursuit",), velocity=velocity, friction=friction, episodes=episodes,
        split=arguments.split, seed=arguments.seed, num_envs=arguments.num_envs,
    )  # fmt: skip


def _solvable(arguments: Arguments, velocity: float, friction: float = 0.0) -> Tensor:
    _, solvable = record_truth(_setting(arguments, arguments.episodes, velocity, friction))
    return solvable


def _row(what: str, successes: Tensor, paper: float, *, velocity: float, friction: float = 0.0) -> dict[str, Any]:
    share = rate(int(successes.sum()), len(successes))
    row = {"what": what, "velocity": velocity, "friction": friction, "episodes": len(successes)}
    row |= {"ours": share.value, "ci": [share.low, share.high], "paper": paper, "difference": share.value - paper}
    gap = share.value - paper
    print(f"{what:9} {velocity:g} m/s {friction:g} N: {share.value:.3f}, paper {paper:.2f} ({gap:+.3f})")
    return row


if __name__ == "__main__":
    arguments = tyro.cli(Arguments)
    rows = measure(arguments)
    if arguments.out is not None:
        about = {"machine": machine(), "versions": library_versions(), "scene": dataclasses.asdict(TrapperScene())}
        write_json(arguments.out, about | {"digest": TrapperScene().digest(), "rows": rows})
