"""Episodes of Reach with a planner in the loop: 50 steps each, a success if any of them brings the gripper there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.fetch import compile_fetch, settle
from torchdyn_plan.envs.goal_motion import GoalStarts, draw_goals, goal_places
from torchdyn_plan.envs.reach import MAX_STEPS, DynamicReachEnv
from torchdyn_plan.evaluation.planners import Planner
from torchdyn_plan.evaluation.play import play_all
from torchdyn_plan.evaluation.reach_ceiling import earliest_meeting
from torchdyn_plan.evaluation.results import EpisodeOutcomes

HORIZON = 50
"""Control steps that the recorded truth goes on after the end of an episode."""


def run_reach(planners: Mapping[str, Planner], arguments: EvaluateArguments) -> dict[str, EpisodeOutcomes]:
    """Outcomes of the same episodes for each planner; *solvable* are those that a clairvoyant search solves."""
    starts = draw_goals(
        torch.arange(arguments.episodes), settle(compile_fetch()).tool_pos, motion=arguments.motion,
        goal_range=arguments.goal_range, split=arguments.split, seed=arguments.seed,
    )  # fmt: skip
    found = earliest_meeting(
        starts, motion=arguments.motion, velocity=arguments.velocity, threshold=arguments.threshold,
        num_threads=arguments.threads,
    )  # fmt: skip
    future = goal_path(starts, arguments, MAX_STEPS + HORIZON)
    return {name: run_episodes(planner, arguments, future, found > 0, name) for name, planner in planners.items()}


def goal_path(starts: GoalStarts, arguments: EvaluateArguments, steps: int) -> Tensor:
    """Where the goals are at steps 0 … ``steps`` with no gripper near, ``(E, steps + 1, 3)`` [m, world]."""
    count = len(starts.angle)
    setting = {"motion": arguments.motion, "velocity": arguments.velocity}
    places = [goal_places(starts, torch.full((count,), step), **setting) for step in range(steps + 1)]
    return torch.stack(places, dim=1).float()


def run_episodes(
    planner: Planner, arguments: EvaluateArguments, future: Tensor, solvable: Tensor, name: str
) -> EpisodeOutcomes:
    """Outcomes of episodes 0 … E-1 under ``planner``, batch after batch.

    Args:
        planner: any planner for a moving target.
        arguments: velocity, motion, seed and how many side by side.
        future: ``(E, T, 3)`` recorded truth, shown to planners that read ``target_future``.
        solvable: ``(E,)`` bool, passed on.
        name: shown beside the progress bar.
    """
    env = DynamicReachEnv(
        min(arguments.num_envs, arguments.episodes), velocity=arguments.velocity, motion=arguments.motion,
        goal_range=arguments.goal_range, threshold=arguments.threshold, seed=arguments.seed, split=arguments.split,
        num_threads=arguments.threads,
    )  # fmt: skip
    log = ReachLog.empty(arguments.episodes)
    seconds = play_all(planner, env, log, future, name=name)
    no = torch.zeros(arguments.episodes, dtype=torch.bool)
    return EpisodeOutcomes(
        trapped=log.steps >= 0, steps=log.steps, replans=log.replans, touched=no, pocketed=no, solvable=solvable,
        seconds=seconds,
    )  # fmt: skip


@dataclass
class ReachLog:
    """What has happened in each episode so far; every tensor is ``(E,)``."""

    done: Tensor
    steps: Tensor
    """First step at the goal, int64, -1 for none."""
    replans: Tensor

    @classmethod
    def empty(cls, count: int) -> ReachLog:
        """The log of ``count`` episodes to come."""
        none = torch.zeros(count, dtype=torch.int64)
        return cls(torch.zeros(count, dtype=torch.bool), none - 1, none)

    def add(self, stepped: TensorDictBase) -> int:
        """Take in one step of all environments; returns how many episodes it ended. What comes later does not count."""
        after: TensorDictBase = stepped.get("next")
        episode = after[keys.EPISODE]
        rows = (episode < len(self.done)).nonzero().squeeze(-1)
        rows = rows[~self.done[episode[rows]]]
        ours = episode[rows]
        first = after[keys.REACHED].squeeze(-1)[rows] & (self.steps[ours] < 0)
        self.steps[ours[first]] = after[keys.STEP_COUNT][rows][first]
        replans = stepped.get((keys.PLAN, "replans"), None)
        if replans is not None:
            self.replans[ours] = replans[rows]
        ended = ours[after["done"].squeeze(-1)[rows]]
        self.done[ended] = True
        return len(ended)
