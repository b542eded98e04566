"""Dynamic FetchReach as a policy's training sees it: resting goals with hindsight, or moving ones with DHER."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.fetch_reach.env import MAX_STEPS, STATE_SIZE, DynamicReachEnv, reach_reward
from torchdyn_plan.envs.fetch_reach.simulation import fetch_digest
from torchdyn_plan.evaluation.episodes import run_episodes
from torchdyn_plan.nets.policy import Actor, PolicyConfig
from torchdyn_plan.planners import PolicyPlanner, TargetPursuit
from torchdyn_plan.tasks.fetch_reach.dher import DynamicHindsightReplayBuffer
from torchdyn_plan.tasks.fetch_reach.task import NAME, TASK, FetchReachSettings
from torchdyn_plan.tasks.task import Truth
from torchdyn_plan.training.goal_task import DDPGRecipe, GoalReplay, GoalTask

DHER = DDPGRecipe(
    iterations=250,
    num_envs=20,
    updates=400,
    batch=256,
    capacity=1_000_000,
    warmup=2,
    lr_actor=1e-3,
    lr_critic=1e-3,
    final_rate=1.0,
    gamma=0.98,
    tau=0.05,
    noise=0.2,
    random_share=0.3,
    action_penalty=0.02,
    clip_return=True,
)
"""As its authors train: 250,000 steps, 100,000 updates; a penalty of 1 on the squared action, of a return up to 50."""


ROOM = 0.25
"""Resting goals are drawn within this of the gripper along each axis while a policy learns [m]."""


class FetchGoalTask(GoalTask):
    """A Fetch arm and its goals: at rest, reached with hindsight, or moving at one velocity, with DHER."""

    length = MAX_STEPS

    def __init__(
        self,
        *,
        velocity: float | None = None,
        motion: str = "straight",
        config: PolicyConfig | None = None,
        episodes: int = 200,
        num_threads: int = 0,
    ) -> None:
        """Define the task.

        Args:
            velocity: of moving goals [m per control step]; None for FetchReach's resting ones, in a larger room.
            motion: how moving goals go.
            config: of the networks.
            episodes: of the split ``dev`` that a policy is scored on.
            num_threads: of the simulation, 0 for all cores.
        """
        self.velocity, self.motion, self.episodes, self.num_threads = velocity, motion, episodes, num_threads
        sizes = PolicyConfig(robot_state_size=STATE_SIZE, tool_slice=(0, 3), action_size=4, near=0.05)
        self.policy_config = config or sizes

    @property
    def _goals(self) -> dict[str, Any]:
        if self.velocity is None:
            return {"static_target": True, "goal_range": ROOM}
        return {"velocity": self.velocity, "motion": self.motion}

    def make_env(self, num_envs: int, *, seed: int) -> DynamicReachEnv:
        """Arms with goals of the split ``train``."""
        return DynamicReachEnv(num_envs, seed=seed, split="train", num_threads=self.num_threads, **self._goals)

    def make_replay(self, recipe: DDPGRecipe, device: torch.device) -> GoalReplay:
        """DHER's replay where goals move."""
        if self.velocity is None:
            return super().make_replay(recipe, device)
        return DynamicHindsightReplayBuffer(
            self.reward,
            capacity=recipe.capacity,
            length=self.length,
            batch_size=recipe.batch,
            ratio=recipe.her_ratio,
            device=device,
        )

    def reward(self, transitions: TensorDictBase) -> Tensor:
        """`reach_reward` of transitions for the goal after their step, ``(B, 1)``."""
        key = keys.DESIRED_GOAL if self.velocity is None else ("next", keys.DESIRED_GOAL)
        return reach_reward(transitions["next", keys.ACHIEVED_GOAL], transitions[key])

    def score(self, actor: Actor) -> dict[str, float]:
        """Share of episodes whose goal is reached by running after it, and the mean steps to it."""
        nothing_known = Truth(torch.zeros(self.episodes, 1, 3), torch.zeros(self.episodes, dtype=torch.bool))
        outcome = run_episodes(
            TargetPursuit(PolicyPlanner(actor)),
            TASK,
            FetchReachSettings(velocity=self.velocity or 0.0, motion=self.motion),
            nothing_known,
            episodes=self.episodes,
            split="dev",
            num_envs=self.episodes,
            num_threads=self.num_threads,
            name="score",
        )
        steps = outcome.steps[outcome.success].double()
        return {
            "success": float(outcome.success.double().mean()),
            "steps": float(steps.mean()) if len(steps) else float(MAX_STEPS),
        }

    def settings(self) -> dict[str, Any]:
        """What a continued training must share."""
        shared = {"task": NAME, "scene": fetch_digest(), "velocity": self.velocity, "motion": self.motion}
        return shared | {"network": asdict(self.policy_config)}
