"""Trapper's static task, as the policy's training sees it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.goals import TrapperGoalEnv
from torchdyn_plan.envs.rewards import GoalReward, goal_reward
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.reachability import is_reachable
from torchdyn_plan.evaluation.run import run_episodes
from torchdyn_plan.nets.policy import Actor, PolicyConfig
from torchdyn_plan.planners.baselines import TargetPursuit
from torchdyn_plan.planners.policy import PolicyPlanner

SECONDS = 2.0
"""Length of an episode [s]."""


class TrapperTask:
    """Goals for the arm in `TrapperGoalEnv`; scored by how many resting balls within reach it traps."""

    stored = (("next", keys.TOOL_POS), ("next", keys.TOOL_ROTATION))

    def __init__(
        self,
        *,
        period: int = 5,
        weights: GoalReward | None = None,
        scene: TrapperScene | None = None,
        config: PolicyConfig | None = None,
        episodes: int = 400,
        num_threads: int = 0,
    ) -> None:
        """Define the task.

        Args:
            period: control steps for which an action holds.
            weights: of the reward's terms.
            scene: that the arm stands in.
            config: of the networks.
            episodes: balls of the split ``dev`` that the policy is scored on; those out of reach do not count.
            num_threads: of the simulation, 0 for all cores.
        """
        self.period, self.weights, self.scene = period, weights or GoalReward(), scene or TrapperScene()
        self.policy_config, self.episodes, self.num_threads = config or PolicyConfig(), episodes, num_threads
        self.length = round(SECONDS / (period * self.scene.control_step))
        self._reachable: Tensor | None = None

    def make_env(self, num_envs: int, *, seed: int) -> TrapperGoalEnv:
        """Arms with goals of the split ``train``."""
        return TrapperGoalEnv(
            num_envs, period=self.period, weights=self.weights, scene=self.scene, seed=seed, split="train",
            max_steps=self.length, num_threads=self.num_threads,
        )  # fmt: skip

    def reward(self, transitions: TensorDictBase) -> Tensor:
        """`goal_reward` of transitions, ``(B, 1)``."""
        tool = (transitions["next", keys.TOOL_POS], transitions["next", keys.TOOL_ROTATION])
        return goal_reward(self.scene, self.weights, *tool, transitions[keys.DESIRED_GOAL])

    def score(self, actor: Actor) -> dict[str, float]:
        """Share of the resting balls within reach that are trapped, and the mean steps to it."""
        arguments = EvaluateArguments(
            velocity=0.0, episodes=self.episodes, split="dev", num_envs=256, threads=self.num_threads
        )  # fmt: skip
        if self._reachable is None:
            place, _ = draw_starts(self.scene, torch.arange(self.episodes), velocity=0.0, split="dev", seed=0)
            self._reachable = is_reachable(self.scene, place)
        planner = TargetPursuit(PolicyPlanner(actor))
        no = torch.zeros(self.episodes, dtype=torch.bool)
        outcome = run_episodes(planner, arguments, torch.zeros(self.episodes, 1, 3), no, "score")
        trapped = outcome.trapped & self._reachable
        steps = outcome.steps[trapped].double()
        return {
            "success": float(trapped.sum() / self._reachable.sum()),
            "steps": float(steps.mean()) if len(steps) else 500.0,
        }

    def settings(self) -> dict[str, Any]:
        """What a continued training must share."""
        shared = {"task": "trapper", "scene": self.scene.digest(), "period": self.period}
        return shared | {"reward": asdict(self.weights), "network": asdict(self.policy_config)}
