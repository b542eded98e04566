"""Trapper as a task of reaching goals, for learning: the same arm and table, goals that change, the ball put away."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Unbounded

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.episodes import episode_random
from torchdyn_plan.envs.look import Marks
from torchdyn_plan.envs.trapper.env import TrapperEnv
from torchdyn_plan.envs.trapper.keys import REACHED, TOOL_ROTATION
from torchdyn_plan.envs.trapper.reward import GoalReward, goal_reward, is_goal_reached
from torchdyn_plan.envs.trapper.scene import TrapperScene

WITHIN_REACH = (0.22, 0.93)
"""Goals are drawn within these distances of the arm's vertical axis [m]."""
WAITING_SHARE = 0.4
"""Share of goals above the table."""
WAITING_HEIGHT = (0.095, 0.2)
"""Heights of goals above the table [m]."""
KEPT = (0.25, 1.0)
"""A goal is kept for so many seconds before the next one."""


class TrapperGoalEnv(TrapperEnv):
    """N arms with a goal each, on the table or above it, that changes at times: the goal is the target.

    An action holds for ``period`` control steps. The reward is `goal_reward` at their end for the goal that was in
    force, the one that the action was chosen for; what is seen then, ``next`` among it, shows the goal of the step to
    come. Episodes are never `terminated`. Goals and the moments when they change are a pure function of (split, seed,
    episode).
    """

    flags = (REACHED,)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        period: int = 5,
        weights: GoalReward | None = None,
        max_steps: int = 100,
        redirected: bool = True,
        **kw: Any,
    ) -> None:
        """Build the batch.

        Args:
            num_envs: number of episodes that run side by side.
            period: control steps for which an action holds.
            weights: of the reward's terms.
            max_steps: actions after which an episode is truncated.
            redirected: goals change in mid-episode; else each episode has one.
            **kw: as for `TrapperEnv`: split, seed, scene, history, num_threads and how entries are shown.
        """
        check_number("period", period, minimum=1, integer=True)
        super().__init__(num_envs, static_target=True, max_steps=max_steps, weights=weights, **kw)
        self.period = period
        self._kept = (max_steps + 1, max_steps + 1)
        if redirected:
            shortest, longest = (max(1, round(seconds / (period * self.scene.control_step))) for seconds in KEPT)
            self._kept = (shortest, longest)
        self._goals = torch.zeros(num_envs, max_steps + 1, 3)
        self._sought = torch.zeros(num_envs, 3)
        rotation = Unbounded(torch.Size((num_envs, 3, 3)), dtype=torch.float32)
        self.observation_spec[TOOL_ROTATION] = rotation.to(self.device)

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        super()._start(rows, episodes)
        far = torch.tensor([0.0, self.scene.half_side - 2 * self.scene.ball_radius], dtype=torch.float64)
        self.simulation.ball_pos[rows, :2] = far
        self._goals[rows] = draw_goal_sequences(
            self.scene, episodes, steps=self._goals.shape[1], kept=self._kept, split=self.split, seed=self.seed
        )
        self._sought[rows] = self._goals[rows, 0]
        return self._goals[rows, 0]

    def _advance(self, action: Tensor) -> Tensor:
        for _ in range(self.period):
            self.simulation.step(action)
        self._tool_pos, self._tool_rotation = self._tool(self.simulation.joint_pos)
        self._sought = self._goal_at(self._steps)
        return self._goal_at(self._steps + 1)

    def _goal_at(self, steps: Tensor) -> Tensor:
        return self._goals[torch.arange(self.num_envs), steps.clamp(max=self._goals.shape[1] - 1)]

    def _observe(self) -> dict[str, Tensor]:
        return super()._observe() | {TOOL_ROTATION: self._tool_rotation.clone()}

    def _reward(self, observed: Mapping[str, Tensor]) -> Tensor:
        return goal_reward(self.scene, self.weights, self._tool_pos, self._tool_rotation, self._sought)

    def _terminated(self, observed: Mapping[str, Tensor]) -> Tensor:
        return torch.zeros(self.num_envs, 1, dtype=torch.bool)

    def _flags(self) -> dict[str, Tensor]:
        tool = self._tool_pos, self._tool_rotation
        return {REACHED: is_goal_reached(self.scene, self.weights, *tool, self._sought)}

    def _marks(self, row: int) -> list[Marks]:
        return [Marks.ball(tuple(self.target_pos[row].tolist()), self.scene.ball_radius, (0.9, 0.1, 0.1, 0.5))]


def draw_goal_sequences(
    scene: TrapperScene, episodes: Tensor, *, steps: int, kept: tuple[int, int], split: str, seed: int
) -> Tensor:
    """Goals at every step of ``episodes`` (M,): ``(M, steps, 3)`` [m, world], kept for so many steps each.

    Args:
        scene: the arm and the table.
        episodes: their numbers.
        steps: length of a sequence.
        kept: fewest and most steps for which a goal is kept.
        split: of the episodes.
        seed: of the episodes.
    """
    shortest, longest = kept
    count = steps // shortest + 1
    sequences = []
    for episode in episodes.tolist():
        draw = episode_random(split, seed, episode, 1)
        goals = _draw_goals(scene, count, draw)
        lengths = draw.integers(shortest, longest + 1, count)
        sequences.append(np.repeat(goals, lengths, axis=0)[:steps])
    return torch.from_numpy(np.stack(sequences)).float()


def _draw_goals(scene: TrapperScene, count: int, draw: np.random.Generator) -> np.ndarray[Any, Any]:
    """Goals ``(count, 3)`` [m, world] within the arm's reach, uniform over the table."""
    goals = np.empty((0, 2))
    while len(goals) < count:
        place = draw.uniform(-1.0, 1.0, (4 * count, 2)) * (scene.half_side - scene.ball_radius)
        away = np.hypot(*(place - np.array(scene.base_pos[:2])).T)
        goals = np.concatenate([goals, place[(away > WITHIN_REACH[0]) & (away < WITHIN_REACH[1])]])
    waits = draw.uniform(size=count) < WAITING_SHARE
    height = np.where(waits, draw.uniform(*WAITING_HEIGHT, count), scene.ball_radius)
    return np.concatenate([goals[:count], height[:, None]], axis=-1)
