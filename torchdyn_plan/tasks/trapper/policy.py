"""Trapper's ball at rest, as a policy's training sees it."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.trapper.env import TrapperEnv
from torchdyn_plan.envs.trapper.goal_env import TrapperGoalEnv
from torchdyn_plan.envs.trapper.keys import TOOL_ROTATION
from torchdyn_plan.envs.trapper.reward import GoalReward, goal_reward
from torchdyn_plan.envs.trapper.scene import TrapperScene, trapper_scene
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.evaluation.episodes import EpisodeLog, play_all
from torchdyn_plan.nets.policy import Actor, PolicyConfig
from torchdyn_plan.planners import PolicyPlanner, TargetPursuit
from torchdyn_plan.tasks.trapper.task import NAME, TASK
from torchdyn_plan.tasks.trapper.workspace import is_reachable
from torchdyn_plan.training.goal_task import GoalTask

SECONDS = 2.0
"""Length of an episode [s]."""
SIDE_BY_SIDE = 96
"""Balls that a policy is scored on at a time: an arm that is done takes the next one."""


class ChosenBallsEnv(TrapperEnv):
    """Resting balls of the split ``dev``: episode i has the i-th of those that were chosen, over again after the last.

    Most of the time of a score would go into balls that nobody can trap, as those episodes end last.
    """

    def __init__(self, numbers: Tensor, **settings: Any) -> None:
        """Play episodes ``numbers`` (E,); ``settings`` are `TrapperEnv`'s."""
        super().__init__(min(len(numbers), SIDE_BY_SIDE), velocity=0.0, seed=0, split="dev", **settings)
        self.numbers = numbers

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        return super()._start(rows, self.numbers[episodes % len(self.numbers)])


class TrapperGoalTask(GoalTask):
    """Goals for the arm in `TrapperGoalEnv`; scored by how many resting balls within reach it traps."""

    stored = (("next", keys.TOOL_POS), ("next", TOOL_ROTATION))

    def __init__(
        self,
        *,
        period: int = 5,
        redirected: bool = True,
        weights: GoalReward | None = None,
        scene: TrapperScene | str | None = None,
        config: PolicyConfig | None = None,
        episodes: int = 400,
        num_threads: int = 0,
    ) -> None:
        """Define the task.

        Args:
            period: control steps for which an action holds.
            redirected: goals change in mid-episode; else each episode has one.
            weights: of the reward's terms.
            scene: that the arm stands in, or its name.
            config: of the networks.
            episodes: balls of the split ``dev`` that the policy is scored on; those out of reach do not count.
            num_threads: of the simulation, 0 for all cores.
        """
        self.period, self.redirected = period, redirected
        self.weights, self.scene = weights or GoalReward(), trapper_scene(scene)
        self.policy_config, self.episodes, self.num_threads = config or PolicyConfig(), episodes, num_threads
        self.length = round(SECONDS / (period * self.scene.control_step))
        self._reachable: Tensor | None = None

    def make_env(self, num_envs: int, *, seed: int) -> TrapperGoalEnv:
        """Arms with goals of the split ``train``."""
        return TrapperGoalEnv(
            num_envs,
            period=self.period,
            redirected=self.redirected,
            weights=self.weights,
            scene=self.scene,
            seed=seed,
            split="train",
            max_steps=self.length,
            num_threads=self.num_threads,
        )

    def reward(self, transitions: TensorDictBase) -> Tensor:
        """`goal_reward` of transitions, ``(B, 1)``."""
        tool = (transitions["next", keys.TOOL_POS], transitions["next", TOOL_ROTATION])
        return goal_reward(self.scene, self.weights, *tool, transitions[keys.DESIRED_GOAL])

    def score(self, actor: Actor) -> dict[str, float]:
        """Share of the resting balls within reach that are trapped, and the mean steps to it."""
        numbers = self._balls_within_reach().nonzero().squeeze(-1)
        env = ChosenBallsEnv(numbers, scene=self.scene, num_threads=self.num_threads)
        # Nobody judges why a ball was not trapped.
        log = EpisodeLog.empty(len(numbers), replace(TASK, judge=None), env)
        play_all(TargetPursuit(PolicyPlanner(actor)), env, log, None, name="score")
        steps = log.steps[log.success].double()
        return {
            "success": float(log.success.double().mean()),
            "steps": float(steps.mean()) if len(steps) else float(TASK.max_steps),
        }

    def _balls_within_reach(self) -> Tensor:
        """Which of the balls that the policy is scored on the arm can be at, ``(episodes,)``; computed once."""
        if self._reachable is None:
            place, _ = draw_starts(self.scene, torch.arange(self.episodes), velocity=0.0, split="dev", seed=0)
            self._reachable = is_reachable(self.scene, place)
        return self._reachable

    def settings(self) -> dict[str, Any]:
        """What a continued training must share."""
        shared = {"task": NAME, "scene": self.scene.digest(), "period": self.period, "redirected": self.redirected}
        return shared | {"reward": asdict(self.weights), "network": asdict(self.policy_config)}
