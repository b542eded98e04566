"""DDPG with hindsight, ours beside Stable-Baselines3's: rates, and success against wall time on the same goals.

python benchmarks/policy_peers.py --minutes 20 --out benchmarks/results/policy_peers.json   # needs the extra `peer`
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
import tyro
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from study import Output, Row, Study, told
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.envs.gym_env import GoalGymEnv
from torchdyn_plan.nets.policy import GoalFeatures, PolicyConfig
from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask
from torchdyn_plan.training.ddpg import DDPG
from torchdyn_plan.training.goal_task import DDPGRecipe


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Train both for the same time, one after the other, each with one thread of torch."""

    minutes: float = 20.0
    """Wall time of each training, scoring left out."""
    target: float = 0.9
    """Success at which the clock is read."""
    num_envs: int = 8
    """Environments of Stable-Baselines3, which steps them one by one."""
    score_seconds: float = 60.0
    """Training time between two scores."""
    seed: int = 0
    """Of both."""


class Clock:
    """Wall time of the training alone."""

    def __init__(self, name: str, task: TrapperGoalTask, study: Study, arguments: Arguments) -> None:
        self.name, self.task, self.study, self.arguments = name, task, study, arguments
        self.rows: list[Row] = []
        self.paused, self.scored, self.started = 0.0, 0.0, time.perf_counter()

    @property
    def seconds(self) -> float:
        """Training time so far."""
        return time.perf_counter() - self.started - self.paused

    @property
    def is_over(self) -> bool:
        """Whether the time is used up."""
        return self.seconds > 60.0 * self.arguments.minutes

    def tick(self, actor: Any, transitions: int, updates: int) -> None:
        """Score ``actor``, a function of state and goal, if it is time to, the clock standing still meanwhile."""
        now = self.seconds
        if now - self.scored < self.arguments.score_seconds:
            return
        before = time.perf_counter()
        with torch.no_grad():
            score = self.task.score(actor)
        about = {"what": self.name, "seconds": now, "transitions": transitions, "updates": updates}
        self.rows.append(self.study.add(about | score))
        self.scored, self.paused = now, self.paused + time.perf_counter() - before

    def summary(self) -> Row:
        """Rates, and the time to the target."""
        last = self.rows[-1]
        reached = [row["seconds"] for row in self.rows if row["success"] >= self.arguments.target]
        return {
            "what": self.name,
            "steps_per_second": last["transitions"] / last["seconds"],
            "updates_per_second": last["updates"] / last["seconds"],
            "best_success": max(row["success"] for row in self.rows),
            "seconds_to_target": reached[0] if reached else None,
        }


class PeerFeatures(BaseFeaturesExtractor):
    """Our features of state and goal, for the peer's networks."""

    def __init__(self, space: Any, statistics: dict[str, Tensor]) -> None:
        features = GoalFeatures(PolicyConfig())
        features.load_state_dict(statistics)
        super().__init__(space, features.size)
        self.features = features

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Of the desired goal's pose only the place counts."""
        return self.features(observations[keys.OBSERVATION], observations[keys.DESIRED_GOAL][..., :3])


class PeerActor(nn.Module):
    """The peer's policy as ours is called."""

    def __init__(self, model: stable_baselines3.DDPG) -> None:
        super().__init__()
        self.actor = model.policy.actor

    def forward(self, state: Tensor, goal: Tensor) -> Tensor:
        """Actions (*B, 6)."""
        pose = nn.functional.pad(goal, (0, 9))
        return self.actor({keys.OBSERVATION: state, keys.DESIRED_GOAL: pose, keys.ACHIEVED_GOAL: pose})


class Scoring(BaseCallback):
    """Lets the clock tick after each step of the peer."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock

    def _on_step(self) -> bool:
        self.clock.tick(PeerActor(self.model), self.num_timesteps, self.model._n_updates)
        return not self.clock.is_over


def train_ours(task: TrapperGoalTask, study: Study, arguments: Arguments) -> Clock:
    """The loop of ``torchdyn-plan train policy`` with its own recipe."""
    clock = Clock("torchdyn_plan", task, study, arguments)
    recipe = DDPGRecipe(seed=arguments.seed)
    ddpg = DDPG(task, recipe)
    while not clock.is_over:
        ddpg.iterate()
        updates = recipe.updates * max(0, ddpg.iteration - recipe.warmup)
        clock.tick(ddpg.actor, ddpg.iteration * ddpg.frames, updates)
    return clock


def train_peer(task: TrapperGoalTask, study: Study, arguments: Arguments, statistics: dict[str, Tensor]) -> Clock:
    """Stable-Baselines3 with the same sizes, rates and ratio of updates to transitions."""
    clock = Clock("stable-baselines3", task, study, arguments)
    recipe, config = DDPGRecipe(seed=arguments.seed), task.policy_config
    envs = DummyVecEnv(
        [
            lambda number=number: GoalGymEnv(
                "torchdyn_plan.envs.trapper.gym_forms:STATIC",
                seed=1000 * arguments.seed + number,
                period=task.period,
                max_steps=task.length,
                num_threads=1,
            )
            for number in range(arguments.num_envs)
        ]
    )
    ratio = recipe.updates / (recipe.num_envs * task.length)
    model = stable_baselines3.DDPG(
        "MultiInputPolicy",
        envs,
        learning_rate=recipe.lr_critic,
        buffer_size=recipe.capacity,
        batch_size=recipe.batch,
        tau=recipe.tau,
        gamma=recipe.gamma,
        learning_starts=recipe.warmup * recipe.num_envs * task.length,
        train_freq=(task.length, "step"),
        gradient_steps=max(1, round(ratio * task.length * arguments.num_envs)),
        action_noise=NormalActionNoise(np.zeros(6), np.full(6, recipe.noise)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        policy_kwargs={
            "net_arch": [config.hidden] * config.layers,
            "features_extractor_class": PeerFeatures,
            "features_extractor_kwargs": {"statistics": statistics},
        },
        seed=arguments.seed,
        device="cpu",
    )
    model.learn(10**9, callback=Scoring(clock))
    return clock


def plot(rows: list[Row], target: float, file: Path) -> None:
    """Success against wall time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 3.6), layout="constrained")
    for what in dict.fromkeys(row["what"] for row in rows):
        points = [(row["seconds"] / 60.0, row["success"]) for row in rows if row["what"] == what]
        axes.plot(*zip(*points, strict=True), marker="o", markersize=3, label=what)
    axes.axhline(target, color="grey", linewidth=0.8, linestyle="--")
    axes.set(xlabel="training time [min]", ylabel="resting balls within reach trapped", ylim=(0.0, 1.02))
    axes.legend(loc="lower right")
    figure.savefig(file, dpi=150)


def main(arguments: Arguments) -> None:
    """Train, save and print; a plot is put beside the file."""
    torch.set_num_threads(1)
    task = TrapperGoalTask()
    study = Study(arguments, scene=task.scene.digest(), resume=False)
    sample = task.make_env(32, seed=arguments.seed + 100).rollout(task.length, break_when_any_done=False).reshape(-1)
    features = GoalFeatures(task.policy_config)
    features.set_statistics(sample[keys.OBSERVATION], sample[keys.DESIRED_GOAL])
    ours = train_ours(task, study, arguments)
    peer = train_peer(task, study, arguments, features.state_dict())
    summaries = [clock.summary() for clock in (ours, peer)]
    study.save(summaries=summaries)
    for summary in summaries:
        print(told(summary))
    if arguments.out is not None:
        plot(study.rows, arguments.target, arguments.out.with_suffix(".png"))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
