"""Dynamic FetchReach as Gymnasium shows it."""

from __future__ import annotations

from functools import partial

from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.fetch_reach.env import DynamicReachEnv, reach_reward
from torchdyn_plan.envs.gym_env import GymForm

FPS = 25
"""Actions a second."""


def show_goals(seen: TensorDictBase) -> dict[str, Tensor]:
    """The robot, its gripper's place and the goal's, as gymnasium-robotics names them."""
    return {name: seen[name] for name in (keys.OBSERVATION, keys.ACHIEVED_GOAL, keys.DESIRED_GOAL)}


def place_reward(world: DynamicReachEnv, achieved: Tensor, desired: Tensor) -> Tensor:
    """`reach_reward` (*B,) of places (*B, 3) for goals (*B, 3)."""
    return reach_reward(achieved, desired, threshold=world.threshold).squeeze(-1)


MOVING = GymForm(make=DynamicReachEnv, show=show_goals, reward=place_reward, fps=FPS)
"""The goal moves."""
STATIC = GymForm(make=partial(DynamicReachEnv, static_target=True), show=show_goals, reward=place_reward, fps=FPS)
"""The goal rests: FetchReach, by default within 1 cm as in DHER."""
