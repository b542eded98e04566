"""Joint speeds while a planner drives the arm, as a share of their limit, without contacts.

python benchmarks/joint_speeds.py --out benchmarks/results/joint_speeds.json
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import tyro
from study import Episodes, Row, Setting, Study, measuring
from torch import Tensor
from tqdm import tqdm

from torchdyn_plan.envs import TrapperScene, TrapperSimulation
from torchdyn_plan.kinematics import UR5_LINKS, UR5_SPEED_LIMIT
from torchdyn_plan.tasks import load_task

AFTERMATH = 50
"""Control steps after a contact that still count as contact: the arm swings out."""
TOO_FAST = 1.02
"""Steps in which a joint is faster than this share of its limit are counted."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Watch joint speeds."""

    planner: str = "pursuit"
    """Planner for the moving target."""
    velocity: float = 3.0
    """[m/s]"""
    episodes: int = 1000
    split: str = "test"
    num_envs: int = 200


class TouchedSimulation(TrapperSimulation):
    """A simulation that tells which arms a contact has pushed in any physics step of the last control step."""

    def __init__(self, num_envs: int, scene: TrapperScene, *, num_threads: int) -> None:
        """Build the simulation as `TrapperSimulation` does."""
        super().__init__(num_envs, scene, num_threads=num_threads)
        self._first = int(self.model.joint(UR5_LINKS[0].joint).dofadr[0])
        self.touched = torch.zeros(num_envs, dtype=torch.bool)

    def step(self, action: Tensor | None = None, rows: Tensor | None = None) -> None:
        """One control step, a physics step at a time."""
        if action is not None:
            self._drive(action)
        self.touched = torch.zeros_like(self.touched)
        for _ in range(self.substeps):
            self.batch.step(None if rows is None else rows.numpy(), nstep=1)
            force = torch.from_numpy(self.batch.bind("qfrc_constraint"))
            self.touched |= (force[:, self._first : self._first + len(UR5_LINKS)] != 0).any(-1)


def row_of(setting: Setting, name: str) -> Row:
    """Greatest speed of each joint over its limit, and how many steps were too fast."""
    arguments = setting.arguments
    env: Any = setting.task.make_env(
        setting.settings,
        num_envs=arguments.num_envs,
        seed=arguments.seed,
        split=arguments.split,
        num_threads=arguments.threads,
    )
    planner = setting.planner(name)
    env.simulation = simulation = TouchedSimulation(arguments.num_envs, env.scene, num_threads=arguments.threads)
    fastest = torch.zeros(len(UR5_LINKS), dtype=torch.float64)
    steps, above = 0, 0
    since = torch.full((arguments.num_envs,), AFTERMATH)
    state = env.reset()
    with tqdm(total=arguments.episodes, unit="episode", leave=False, disable=None) as bar:
        while bar.n < arguments.episodes:
            stepped, state = env.step_and_maybe_reset(planner(state))
            since = torch.where(simulation.touched, 0, since + 1)
            free = since > AFTERMATH
            share = stepped["next", "joint_vel"][free].double().abs() / UR5_SPEED_LIMIT
            if len(share):
                fastest = torch.maximum(fastest, share.amax(0))
                above += int(share.gt(TOO_FAST).any(dim=-1).sum())
            steps += len(share)
            bar.n += int(stepped["next", "done"].sum())
            bar.refresh()
    return {"fastest": fastest.tolist(), "free_steps": steps, f"above_{TOO_FAST}": above}


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    setting = Setting(task, arguments, velocity=arguments.velocity)
    with measuring():
        study.row({"planner": arguments.planner, **setting.about}, lambda: row_of(setting, arguments.planner))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
