"""FetchReach with goals at rest, by RL Baselines3 Zoo's own measure: the mean return of 50 steps, threshold 5 cm.

python benchmarks/reach_at_rest.py --out benchmarks/results/reach/at_rest.json

The Zoo publishes -1.66 ± 0.87 over 3,000 episodes of its TQC (benchmark.md, FetchReach-v1). Our policy was trained for
1 cm, not for 5: staying closer to the goal gains nothing here.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from study import Output, Row, Study, each, measuring

from torchdyn_plan.envs import DynamicReachEnv
from torchdyn_plan.envs.fetch_reach.simulation import fetch_digest
from torchdyn_plan.tasks import load_task

ZOO = {"static": "Zoo's TQC, as published", "episodes": 3000, "threshold": 0.05, "mean": -1.659, "deviation": 0.873}


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Reach for goals at rest."""

    statics: tuple[str, ...] = ("rl", "proportional")
    """Static planners."""
    thresholds: tuple[float, ...] = (0.05, 0.01)
    """Distances that count as being there: the Zoo's, and the one that our policy was trained for [m]."""
    episodes: int = 3000
    """Episodes of the split test for each row, all side by side."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores; does not change the figures."""


def measured(static: str, threshold: float, arguments: Arguments) -> Row:
    """Mean and deviation of returns over episodes, and how many of them end at the goal."""
    env = DynamicReachEnv(
        arguments.episodes,
        static_target=True,
        threshold=threshold,
        seed=0,
        split="test",
        num_threads=arguments.threads,
    )
    planner = load_task("fetch_reach").static_planner(static)
    rewards = env.rollout(env.max_steps, planner, break_when_any_done=False)["next", "reward"].squeeze(-1)
    returns = rewards.sum(-1)
    return {
        "mean": returns.mean().item(),
        "deviation": returns.std().item(),
        "at_the_goal_at_the_end": (rewards[:, -1] == 0).float().mean().item(),
    }


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    study = Study(arguments, scene=fetch_digest())
    study.row(ZOO, dict)
    with measuring():
        for static in each(arguments.statics, "at rest"):
            for threshold in arguments.thresholds:
                about = {"static": static, "episodes": arguments.episodes, "threshold": threshold}
                study.row(about, lambda about=about: measured(about["static"], about["threshold"], arguments))


if __name__ == "__main__":
    torch.manual_seed(0)
    main(tyro.cli(Arguments))
