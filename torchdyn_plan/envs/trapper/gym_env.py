"""The goal task as a Gymnasium environment, for libraries that speak no tensordict."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from tensordict import TensorDict
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.trapper.goal_env import TrapperGoalEnv
from torchdyn_plan.envs.trapper.keys import TOOL_ROTATION
from torchdyn_plan.envs.trapper.reward import goal_reward

POSE_SIZE = 12
"""A tool's place (3) [m, world] and its rotation row by row (9); of a desired goal only the place counts."""

Observation = dict[str, np.ndarray[Any, Any]]


class TrapperGymEnv(gymnasium.Env[Observation, np.ndarray[Any, Any]]):
    """One arm of `TrapperGoalEnv` with one goal an episode, by Gymnasium's conventions for goals.

    ``achieved_goal`` is the tool's pose (12,), as the reward depends on its rotation too; ``desired_goal`` has zeros
    there. `compute_reward` is vectorised over leading dimensions, and the same function as `TrapperGoalEnv`'s.
    """

    def __init__(self, *, seed: int | None = None, **settings: Any) -> None:
        """Build an environment with the arguments of `TrapperGoalEnv`."""
        super().__init__()
        self.env = TrapperGoalEnv(1, seed=seed, redirected=False, **settings)
        spaces = {keys.OBSERVATION: 15, keys.ACHIEVED_GOAL: POSE_SIZE, keys.DESIRED_GOAL: POSE_SIZE}
        space: Any = Dict({key: Box(-np.inf, np.inf, (size,)) for key, size in spaces.items()})
        self.observation_space = space
        self.action_space = Box(-1.0, 1.0, (6,))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the next episode, or the first one of the series ``seed``."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        return self._observation(self.env.reset()), {}

    def step(self, action: np.ndarray[Any, Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Let ``action`` (6,) hold for the period."""
        entries = {keys.ACTION: torch.as_tensor(action, dtype=torch.float32).unsqueeze(0)}
        after = self.env.step(TensorDict(entries, batch_size=[1]))["next"]
        return self._observation(after), float(after["reward"]), False, bool(after["truncated"]), {}

    def compute_reward(
        self, achieved_goal: np.ndarray[Any, Any], desired_goal: np.ndarray[Any, Any], info: Any
    ) -> np.ndarray[Any, Any]:
        """Rewards (*B,) of poses ``achieved_goal`` (*B, 12) for goals ``desired_goal`` (*B, 12)."""
        achieved, desired = (torch.as_tensor(value, dtype=torch.float32) for value in (achieved_goal, desired_goal))
        rotation = achieved[..., 3:].unflatten(-1, (3, 3))
        reward = goal_reward(self.env.scene, self.env.weights, achieved[..., :3], rotation, desired[..., :3])
        return reward.squeeze(-1).numpy()

    def _observation(self, state: Any) -> Observation:
        pose = torch.cat([state[keys.TOOL_POS], state[TOOL_ROTATION].flatten(-2)], dim=-1)
        desired = torch.nn.functional.pad(state[keys.DESIRED_GOAL], (0, POSE_SIZE - 3))
        values: dict[str, Tensor] = {
            keys.OBSERVATION: state[keys.OBSERVATION],
            keys.ACHIEVED_GOAL: pose,
            keys.DESIRED_GOAL: desired,
        }
        return {key: value[0].numpy().copy() for key, value in values.items()}
