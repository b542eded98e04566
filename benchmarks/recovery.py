"""Recovery: of the episodes whose first drop misses, in how many does the arm lift and trap the ball with a later one?

The paper claims it for its policy and denies it to inverse kinematics.

python benchmarks/recovery.py --out benchmarks/results/recovery.json
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import tyro
from study import Episodes, Row, Setting, Study, each, measuring, rate_entries
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.tasks import load_task


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Count drops in episodes of each planner and static planner."""

    planners: tuple[str, ...] = ("pursuit", "corner", "wait_and_drop")
    """Planners for the moving target."""
    statics: tuple[str, ...] = ("ik", "rl")
    """Static planners."""
    velocities: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Of the ball [m/s]."""
    episodes: int = 500
    split: str = "test"
    num_envs: int = 128


def drops(planner: Any, env: TrapperEnv, episodes: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Episode numbers, number of drops and whether the ball was trapped, as episodes end."""
    radius = env.scene.ball_radius
    state: TensorDictBase = env.reset()
    count = torch.zeros(env.num_envs, dtype=torch.int64)
    down = torch.zeros(env.num_envs, dtype=torch.bool)
    ended = 0
    while ended < episodes:
        stepped, state = env.step_and_maybe_reset(planner(state))
        after: Any = stepped["next"]
        height = after[keys.TOOL_POS][:, 2]
        # A drop begins where a lifted box comes below the ball's middle, and ends where it is above the ball's top.
        falls = ~down & (height < radius)
        count, down = count + falls, falls | (down & (height <= 2 * radius))
        done = after["done"].squeeze(-1)
        if done.any():
            number = after[keys.EPISODE][done]
            ours = number < episodes
            ended += int(ours.sum())
            yield number[ours], count[done][ours], after["trapped"].squeeze(-1)[done][ours]
            count, down = count.masked_fill(done, 0), down & ~done


def row_of(setting: Setting, name: str) -> Row:
    """Episodes whose first drop missed, and how many of them were trapped by a later one."""
    arguments = setting.arguments
    env: Any = setting.task.make_env(
        setting.settings,
        num_envs=arguments.num_envs,
        seed=arguments.seed,
        split=arguments.split,
        num_threads=arguments.threads,
    )
    count = torch.zeros(arguments.episodes, dtype=torch.int64)
    trapped = torch.zeros(arguments.episodes, dtype=torch.bool)
    for number, drop, success in drops(setting.planner(name), env, arguments.episodes):
        count[number], trapped[number] = drop, success
    missed = (count > 1) | ((count == 1) & ~trapped)
    recovered = trapped & (count > 1)
    tried = {"missed_first": int(missed.sum()), "lifted_and_tried_again": int((count > 1).sum())}
    return (
        tried | {"recovered": int(recovered.sum())} | rate_entries("recovery", int(recovered.sum()), int(missed.sum()))
    )


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    with measuring():
        for velocity in arguments.velocities:
            for static in arguments.statics:
                setting = Setting(task, arguments, static=static, velocity=velocity)
                for name in each(arguments.planners, f"{static}, {velocity:g} m/s"):
                    about = {"planner": name, "static": static, **setting.about}
                    study.row(about, partial(row_of, setting, name))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
