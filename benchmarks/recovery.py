"""Recovery: of the episodes whose first drop misses, in how many does the arm lift and trap the ball with a later one?

The paper claims it for its policy and denies it to inverse kinematics.

python benchmarks/recovery.py --out benchmarks/results/recovery.json
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.evaluation.intervals import rate
from torchdyn_plan.evaluation.planners import PLANNERS
from torchdyn_plan.evaluation.play import one_thread
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Count drops in episodes of each planner and static planner."""

    planners: tuple[str, ...] = ("pursuit", "corner", "meet")
    """Planners for the moving target."""
    statics: tuple[str, ...] = ("ik", "rl")
    """Static planners."""
    velocities: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Of the ball [m/s]."""
    episodes: int = 500
    """Of each."""
    split: str = "test"
    """Series of episodes: test, or dev."""
    seed: int = 0
    """Which series."""
    out: Path | None = None
    """JSON file for the figures."""


def drops(planner: Any, env: TrapperEnv, episodes: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Episode numbers, number of drops and whether the ball was trapped, as episodes end."""
    radius = env.scene.ball_radius
    state: TensorDictBase = env.reset()
    down, count = (torch.zeros(env.num_envs, dtype=torch.int64) for _ in range(2))
    ended = 0
    while ended < episodes:
        stepped, state = env.step_and_maybe_reset(planner(state))
        after = stepped["next"]
        height = after[keys.TOOL_POS][:, 2]
        # A drop begins where a lifted box comes below the ball's middle, and ends where it is above the ball's top.
        falls = (down == 0) & (height < radius)
        count, down = count + falls, torch.where(falls, 1, torch.where(height > 2 * radius, 0, down))
        done = after["done"].squeeze(-1)
        if done.any():
            number = after[keys.EPISODE][done]
            ours = number < episodes
            ended += int(ours.sum())
            yield number[ours], count[done][ours], after[keys.TRAPPED].squeeze(-1)[done][ours]
            count, down = count.masked_fill(done, 0), down.masked_fill(done, 0)


def measure(arguments: Arguments, planner: str, static: str, velocity: float) -> dict[str, Any]:
    """A row: episodes whose first drop missed, and how many of them were trapped by a later one."""
    env = TrapperEnv(128, velocity=velocity, split=arguments.split, seed=arguments.seed)
    count, trapped = (
        torch.zeros(arguments.episodes, dtype=torch.int64),
        torch.zeros(arguments.episodes, dtype=torch.bool),
    )
    with one_thread(), torch.no_grad():
        for number, drop, success in drops(PLANNERS[planner](static), env, arguments.episodes):
            count[number], trapped[number] = drop, success
    missed = (count > 1) | ((count == 1) & ~trapped)
    recovered = trapped & (count > 1)
    share = rate(int(recovered.sum()), int(missed.sum()))._asdict() if missed.any() else None
    return {
        "planner": planner, "static": static, "velocity": velocity, "episodes": arguments.episodes,
        "missed_first": int(missed.sum()), "lifted_and_tried_again": int((count > 1).sum()),
        "recovered": int(recovered.sum()), "recovery": share,
    }  # fmt: skip


def main(arguments: Arguments) -> None:
    """Run, print and write."""
    rows = []
    for velocity in arguments.velocities:
        for static in arguments.statics:
            for planner in arguments.planners:
                rows.append(measure(arguments, planner, static, velocity))
                print("  ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if arguments.out is not None:
        about = {"machine": machine(), "versions": library_versions(), "scene": TrapperScene().digest()}
        write_json(arguments.out, {"config": asdict(arguments) | {"out": str(arguments.out)}} | about | {"rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
