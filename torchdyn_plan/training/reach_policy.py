"""Reach as a policy's training sees it: resting goals with hindsight, or moving ones with DHER."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments, TrainArguments
from torchdyn_plan.envs.fetch import fetch_digest
from torchdyn_plan.envs.reach import MAX_STEPS, STATE_SIZE, DynamicReachEnv, reach_reward
from torchdyn_plan.evaluation.reach import run_episodes
from torchdyn_plan.nets.policy import Actor, PolicyConfig
from torchdyn_plan.planners.baselines import TargetPursuit
from torchdyn_plan.planners.policy import PolicyPlanner
from torchdyn_plan.training.dher import DynamicHindsightReplayBuffer
from torchdyn_plan.training.goal_task import DDPGRecipe, GoalReplay, hindsight_replay
from torchdyn_plan.training.policy import fit_policy

DHER = DDPGRecipe(
    iterations=250, num_envs=20, updates=400, batch=256, capacity=1_000_000, warmup=2, lr_actor=1e-3, lr_critic=1e-3,
    final_rate=1.0, gamma=0.98, tau=0.05, noise=0.2, random_share=0.3, action_penalty=0.02, clip_return=True,
)  # fmt: skip
"""As its authors train: 250,000 steps, 100,000 updates; a penalty of 1 on the squared action, of a return up to 50."""


class ReachTask:
    """A Fetch arm and its goals: at rest, reached with hindsight, or moving at one velocity, with DHER."""

    stored: tuple[Any, ...] = ()
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
        """Set the task.

        Args:
            velocity: of moving goals [m per control step]; None for FetchReach's resting ones, in a larger room.
            motion: how moving goals go.
            config: of the networks.
            episodes: of the split ``dev`` that a policy is scored on.
            num_threads: of the simulation, 0 for all cores.
        """
        self.velocity, self.motion, self.episodes, self.num_threads = velocity, motion, episodes, num_threads
        self.policy_config = config or PolicyConfig(
            robot_state_size=STATE_SIZE, tool_slice=(0, 3), action_size=4, near=0.05
        )  # fmt: skip

    @property
    def _goals(self) -> dict[str, Any]:
        moving = {"velocity": self.velocity, "motion": self.motion}
        return {"static": True, "goal_range": 0.25} if self.velocity is None else moving

    def make_env(self, num_envs: int, *, seed: int) -> DynamicReachEnv:
        """Arms with goals of the split ``train``."""
        return DynamicReachEnv(num_envs, seed=seed, split="train", num_threads=self.num_threads, **self._goals)

    def make_replay(self, recipe: DDPGRecipe, device: torch.device) -> GoalReplay:
        """DHER's replay where goals move."""
        if self.velocity is None:
            return hindsight_replay(self, recipe, device)
        return DynamicHindsightReplayBuffer(
            self.reward, capacity=recipe.capacity, length=self.length, batch_size=recipe.batch, ratio=recipe.her_ratio,
            device=device,
        )  # fmt: skip

    def reward(self, transitions: TensorDictBase) -> Tensor:
        """`reach_reward` of transitions for the goal after their step, ``(B, 1)``."""
        key = keys.DESIRED_GOAL if self.velocity is None else ("next", keys.DESIRED_GOAL)
        return reach_reward(transitions["next", keys.ACHIEVED_GOAL], transitions[key])

    def score(self, actor: Actor) -> dict[str, float]:
        """Share of episodes whose goal is reached by running after it, and the mean steps to it."""
        arguments = EvaluateArguments(
            task="reach", velocity=self.velocity or 0.0, motion=self.motion, episodes=self.episodes, split="dev",
            num_envs=self.episodes, threads=self.num_threads,
        )  # fmt: skip
        planner = TargetPursuit(PolicyPlanner(actor))
        no = torch.zeros(self.episodes, dtype=torch.bool)
        outcome = run_episodes(planner, arguments, torch.zeros(self.episodes, 1, 3), no, "score")
        steps = outcome.steps[outcome.trapped].double()
        return {
            "success": float(outcome.trapped.double().mean()),
            "steps": float(steps.mean()) if len(steps) else float(MAX_STEPS),
        }

    def settings(self) -> dict[str, Any]:
        """What a continued training must share."""
        shared = {"task": "reach", "scene": fetch_digest(), "velocity": self.velocity, "motion": self.motion}
        return shared | {"network": asdict(self.policy_config)}


def train_reach(arguments: TrainArguments) -> Path:
    """Train Reach's policy, or DHER's, as the command line says; returns the weights' file."""
    moving = arguments.what == "dher"
    given: dict[str, Any] = {"iterations": arguments.steps, "batch": arguments.batch, "num_envs": arguments.num_envs}
    if arguments.lr is not None:
        given |= {"lr_critic": arguments.lr, "lr_actor": arguments.lr if moving else arguments.lr / 2}
    given = {name: value for name, value in given.items() if value is not None}
    settings: dict[str, Any] = (asdict(DHER) if moving else {}) | given | {"seed": arguments.seed}
    recipe = DDPGRecipe(**settings)
    task = ReachTask(velocity=arguments.velocity if moving else None, num_threads=arguments.threads)
    return fit_policy(
        task, arguments.out, name=arguments.what, recipe=recipe, resume=arguments.resume, score_every=10,
        workers=arguments.workers, device=arguments.device,
    )  # fmt: skip
