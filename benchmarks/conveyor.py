"""Parts picked off a belt: share of the solvable parts taken, at each belt speed and with several parts at once.

python benchmarks/conveyor.py --out benchmarks/results/conveyor.json
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import torch
import tyro
from study import Output, Row, Study, each, measuring, rate_entries

from torchdyn_plan.envs.conveyor.env import PARTS_TAKEN, draw_parts
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.conveyor.solvable import parts_solvable
from torchdyn_plan.tasks.conveyor.task import TASK, scene

SIDE_BY_SIDE = 100
"""Episodes that run at once."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Take parts off a belt."""

    planners: tuple[str, ...] = ("pursuit:gain", "pursuit", "meet", "learned")
    """Planners, each behind a colon with its static planner if that is not the task's first."""
    speeds: tuple[float, ...] = (0.2, 0.35, 0.6)
    """Speeds of the belt [m/s]."""
    parts: tuple[int, ...] = (1,)
    """Parts of an episode."""
    episodes: int = 500
    """Episodes for each row."""
    split: str = "test"
    """Family of episodes."""
    seed: int = 0
    """Series of episodes."""


def measured(planner: str, speed: float, parts: int, arguments: Arguments) -> Row:
    """Parts taken and solvable, steps until an episode's last part is taken, and wall time of a step."""
    settings: Any = TASK.default_settings(speed=speed, parts=parts)
    series: dict[str, Any] = {"seed": arguments.seed, "split": arguments.split}
    place, yaw = draw_parts(scene(), torch.arange(arguments.episodes), parts=parts, speed=speed, **series)
    solvable = parts_solvable(scene(), place, yaw, speed=speed)
    env = TASK.make_env(settings, num_envs=min(SIDE_BY_SIDE, arguments.episodes), num_threads=1, **series)
    name, _, static = planner.partition(":")
    acting, taken, steps, row_steps = TASK.planner(name, static or None), [], [], 0
    begun = time.perf_counter()
    with torch.no_grad():
        for first in range(0, arguments.episodes, env.num_envs):
            env.start_from(first)
            state, over = env.reset(), torch.zeros(env.num_envs, dtype=torch.bool)
            now = torch.zeros(env.num_envs, parts, dtype=torch.bool)
            length = torch.zeros(env.num_envs, dtype=torch.int64)
            while not over.all():
                stepped = env.step(acting(state))["next"]
                now, length = torch.where(over.unsqueeze(-1), now, stepped[PARTS_TAKEN]), length + ~over
                over = over | stepped["done"].squeeze(-1)
                state = stepped.set("plan", state["plan"]) if "plan" in state.keys() else stepped  # noqa: SIM118
                row_steps += len(over)
            taken.append(now)
            steps.append(length)
    seconds = time.perf_counter() - begun
    parts_taken = torch.cat(taken)[: arguments.episodes]
    cleared = parts_taken.all(-1)
    return {
        "solvable": int(solvable.sum()),
        "taken_but_not_solvable": int((parts_taken & ~solvable).sum()),
        **rate_entries("taken_of_solvable", int((parts_taken & solvable).sum()), int(solvable.sum())),
        **rate_entries("episodes_cleared", int(cleared.sum()), arguments.episodes),
        "seconds_to_clear": torch.cat(steps)[: arguments.episodes][cleared].double().mean().item() * TASK.control_step
        if bool(cleared.any())
        else None,
        "us_per_row_step": 1e6 * seconds / row_steps,
    }


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    study = Study(arguments, scene=load_task("conveyor").digest())
    with measuring():
        for parts in each(arguments.parts, "parts"):
            for speed in arguments.speeds:
                for planner in arguments.planners:
                    about = {"planner": planner, "speed": speed, "parts": parts}
                    about |= {"episodes": arguments.episodes, "split": arguments.split, "seed": arguments.seed}
                    study.row(about, lambda a=about: measured(a["planner"], a["speed"], a["parts"], arguments))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
