"""Which moving goals can be reached at all: meetings tried by simulation, the goal's whole path known."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.fetch_reach.env import MAX_STEPS, THRESHOLD, is_at
from torchdyn_plan.envs.fetch_reach.goal_motion import GoalStarts, draw_goals, goal_places
from torchdyn_plan.envs.fetch_reach.simulation import FetchSimulation, compile_fetch, settle
from torchdyn_plan.planners.static.proportional import ProportionalController
from torchdyn_plan.tasks.fetch_reach.task import TASK, FetchReachSettings
from torchdyn_plan.tasks.task import Truth

FIRST_STRIDE, STRIDE = 0.0312, 0.0338
"""No first action, and no later one, moves the gripper farther than this along an axis [m]."""
SHOULDER, LONGEST_REACH = (0.724, 0.744), 0.97
"""The arm's vertical axis, and more than the farthest that the gripper gets from it at the height of goals [m]."""
GAINS = (31.0, 45.0, 90.0)
"""The gripper is pulled to a meeting place by each of these gains [1/m]: gently, or at full force up to the end."""
ROWS = 512
"""Meetings simulated side by side."""

HORIZON = 50
"""Control steps for which the truth is recorded beyond the end of an episode."""


def find_truth(
    settings: FetchReachSettings, *, episodes: int, seed: int, split: str, static: str, num_threads: int = 0
) -> Truth:
    """Where the goals of episodes 0 … E-1 go, and which of them a search that knows this meets.

    Args:
        settings: how goals start and move, and when a gripper is at one.
        episodes: number E of episodes.
        seed: which series of episodes.
        split: which family of series.
        static: name of a static planner; any will do, as what can be reached depends on none.
        num_threads: of the simulation, 0 for all cores.
    """
    starts = draw_goals(
        torch.arange(episodes),
        settle(compile_fetch()).tool_pos,
        motion=settings.motion,
        goal_range=settings.goal_range,
        split=split,
        seed=seed,
    )
    found = earliest_meeting(
        starts,
        motion=settings.motion,
        velocity=settings.velocity,
        threshold=settings.threshold,
        num_threads=num_threads,
    )
    steps = TASK.max_steps + HORIZON
    return Truth(goal_path(starts, steps, motion=settings.motion, velocity=settings.velocity), found > 0)


def goal_path(starts: GoalStarts, steps: int, *, motion: str, velocity: float) -> Tensor:
    """Where the goals are at steps 0 … ``steps`` with no gripper near, ``(E, steps + 1, 3)`` [m, world]."""
    count = len(starts.angle)
    moves = (torch.full((count,), step) for step in range(steps + 1))
    places = [goal_places(starts, moved, motion=motion, velocity=velocity) for moved in moves]
    return torch.stack(places, dim=1).float()


def earliest_meeting(
    starts: GoalStarts,
    *,
    motion: str,
    velocity: float,
    threshold: float = THRESHOLD,
    steps: int = MAX_STEPS,
    goal_first: bool = True,
    gains: Sequence[float] = GAINS,
    num_threads: int = 0,
) -> Tensor:
    """Step at which a gripper that knows the goal's path is first found to meet it, ``(E,)`` int64; -1 for never.

    A meeting at step t is tried by pulling to where the goal will be then, from the first step on, with each gain in
    turn; it counts if the gripper is there after step t. Steps at which the goal is farther than the gripper can move
    along some axis are left out. What is found can be reached; what is not found could hardly be.

    Args:
        starts: of E episodes.
        motion: how goals move.
        velocity: how far a goal moves in a step [m].
        threshold: distance that counts as there [m].
        steps: of an episode.
        goal_first: DHER's order; else the goal moves after the physics, and a meeting at step t is where it was before.
        gains: of the pulls.
        num_threads: of the simulation, 0 for all cores.
    """
    count, late = len(starts.angle), 0 if goal_first else 1
    found = torch.full((count,), -1)
    simulation = FetchSimulation(ROWS, num_threads=num_threads)
    for step in range(1, steps + 1):
        moves = torch.full((count,), step - late)
        place = goal_places(starts, moves, motion=motion, velocity=velocity)
        tried = (found < 0) & is_in_range(place, simulation.start.tool_pos, step, threshold)
        for gain in gains:
            rows = (tried & (found < 0)).nonzero().squeeze(-1)
            for block in rows.split(ROWS):
                met = is_at(_pull(simulation, place[block], gain, step), place[block], threshold=threshold)
                found[block[met]] = step
    return found


def is_in_range(place: Tensor, tool_pos: Tensor, step: int, threshold: float) -> Tensor:
    """Whether a goal at ``place`` (E, 3) is not out of the question after ``step`` steps from ``tool_pos`` (3,) [m]."""
    near = (place - tool_pos).abs().amax(-1) <= furthest(step) + threshold
    return near & ((place[:, :2] - place.new_tensor(SHOULDER)).norm(dim=-1) <= LONGEST_REACH)


def furthest(step: int) -> float:
    """No gripper is farther than this from its start along an axis after ``step`` steps [m]."""
    return FIRST_STRIDE + (step - 1) * STRIDE


def _pull(simulation: FetchSimulation, place: Tensor, gain: float, steps: int) -> Tensor:
    """Where grippers are that are pulled to ``place`` (R, 3) for some steps: ``(R, 3)`` [m]."""
    planner = ProportionalController(gain=gain, action_size=4)
    count = len(place)
    rows = torch.arange(count)
    simulation.reset(rows)
    goal = torch.nn.functional.pad(place, (0, 0, 0, simulation.num_envs - count))
    for _ in range(steps):
        entries = {keys.TOOL_POS: simulation.tool_pos, keys.GOAL: goal}
        action = planner(TensorDict(entries, batch_size=[simulation.num_envs]))[keys.ACTION]
        simulation.step(action, rows)
    return simulation.tool_pos[:count]
