"""Episodes of Reach with a planner in the loop: 50 steps each, a success if any of them brings the gripper there."""

from __future__ import annotations

import time
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.fetch import compile_fetch, settle
from torchdyn_plan.envs.goal_motion import GoalStarts, draw_goals, goal_places
from torchdyn_plan.envs.reach import MAX_STEPS, DynamicReachEnv
from torchdyn_plan.evaluation.planners import Planner
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
        starts, motion=arguments.motion, velocity=arguments.velocity, num_threads=arguments.threads
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
    from tqdm import tqdm

    count = arguments.episodes
    env = DynamicReachEnv(
        min(arguments.num_envs, count), velocity=arguments.velocity, motion=arguments.motion,
        goal_range=arguments.goal_range, seed=arguments.seed, split=arguments.split, num_threads=arguments.threads,
    )  # fmt: skip
    steps, replans = torch.full((count,), -1), torch.zeros(count, dtype=torch.int64)
    started = time.perf_counter()
    with torch.no_grad(), tqdm(total=count, desc=name, unit="episode", leave=False) as bar:
        for first in range(0, count, env.num_envs):
            rows = torch.arange(first, min(first + env.num_envs, count))
            reached, replanned = _play(planner, env, future[rows])
            steps[rows], replans[rows] = reached[: len(rows)], replanned[: len(rows)]
            bar.update(len(rows))
    no = torch.zeros(count, dtype=torch.bool)
    return EpisodeOutcomes(
        trapped=steps >= 0, steps=steps, replans=replans, touched=no, pocketed=no, solvable=solvable,
        seconds=time.perf_counter() - started,
    )  # fmt: skip


def _play(planner: Planner, env: DynamicReachEnv, future: Tensor) -> tuple[Tensor, Tensor]:
    """One episode of every environment: first step at the goal (-1: none) and re-plans, ``(N,)`` int64 each."""
    tensordict: TensorDictBase = env.reset()
    stepped: TensorDictBase = tensordict
    reached = torch.full((env.num_envs,), -1)
    shown = torch.cat([future, future[-1:].expand(env.num_envs - len(future), -1, -1)])
    for step in range(1, env.max_steps + 1):
        if keys.TARGET_FUTURE in getattr(planner, "in_keys", ()):
            tensordict[keys.TARGET_FUTURE] = shown
        stepped = env.step(planner(tensordict))
        at = stepped["next", keys.REACHED].squeeze(-1)
        reached = torch.where((reached < 0) & at, step, reached)
        if bool((reached > 0).all()):
            break
        after: TensorDictBase = stepped.get("next")
        tensordict = after.exclude("reward")
        plan = stepped.get(keys.PLAN, None)
        if plan is not None:
            tensordict[keys.PLAN] = plan
    replans = stepped.get((keys.PLAN, "replans"), None)
    return reached, torch.zeros_like(reached) if replans is None else replans
