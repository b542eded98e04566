"""Trapper as Gymnasium shows it."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.gym_env import GymForm
from torchdyn_plan.envs.trapper.env import TrapperEnv
from torchdyn_plan.envs.trapper.goal_env import TrapperGoalEnv
from torchdyn_plan.envs.trapper.keys import TOOL_ROTATION
from torchdyn_plan.envs.trapper.reward import goal_reward

POSE_SIZE = 12
"""A tool's place (3) [m, world] and its rotation row by row (9); of a desired goal only the place counts."""
FPS = 50
"""Actions of the goal task a second, at its period of 5 control steps."""


def one_goal(num_envs: int, **settings: Any) -> TrapperGoalEnv:
    """Arms with one goal an episode; ``settings`` are those of `TrapperGoalEnv`."""
    return TrapperGoalEnv(num_envs, redirected=False, **settings)


def show_poses(seen: TensorDictBase) -> dict[str, Tensor]:
    """The robot, the pose of its tool, as the reward depends on that, and the goal with zeros for a rotation."""
    pose = torch.cat([seen[keys.TOOL_POS], seen[TOOL_ROTATION].flatten(-2)], dim=-1)
    desired = torch.nn.functional.pad(seen[keys.DESIRED_GOAL], (0, POSE_SIZE - 3))
    return {keys.OBSERVATION: seen[keys.OBSERVATION], keys.ACHIEVED_GOAL: pose, keys.DESIRED_GOAL: desired}


def pose_reward(world: TrapperGoalEnv, achieved: Tensor, desired: Tensor) -> Tensor:
    """`goal_reward` (*B,) of poses (*B, 12) for goals (*B, 12)."""
    rotation = achieved[..., 3:].unflatten(-1, (3, 3))
    return goal_reward(world.scene, world.weights, achieved[..., :3], rotation, desired[..., :3]).squeeze(-1)


def show_observation(seen: TensorDictBase) -> Tensor:
    """The observation alone."""
    return seen[keys.OBSERVATION]


STATIC = GymForm(make=one_goal, show=show_poses, reward=pose_reward, fps=FPS)
"""One goal an episode, as Gymnasium has goals: for hindsight."""
STATIC_FLAT = GymForm(make=partial(one_goal, goal_in_observation=True), show=show_observation, fps=FPS)
"""The same, the goal at the end of one flat observation: for scripts that know no goals."""
DYNAMIC = GymForm(make=partial(TrapperEnv, goal_in_observation=True), show=show_observation, fps=250)
"""The rolling ball; the observation ends with its place and its last step."""
