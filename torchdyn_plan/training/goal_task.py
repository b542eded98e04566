"""Inputs of a policy training: a goal-reaching task and a recipe."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.nets.policy import Actor, PolicyConfig
from torchdyn_plan.training.hindsight import HindsightReplayBuffer

SEEN: list[Any] = [keys.OBSERVATION, keys.DESIRED_GOAL]
"""Keys that a policy reads."""
ALGORITHM_OWNS = ("iterations", "lr_actor", "lr_critic", "final_rate", "gamma", "tau")
"""Fields of a recipe that depend on the algorithm; the others depend on the task."""


class GoalReplay(Protocol):
    """Interface of a replay buffer of whole episodes."""

    @property
    def cursor(self) -> int:
        """Position of the next episode."""
        ...

    def extend(self, data: Any, **settings: Any) -> Any:
        """Add whole episodes, batch ``(N, length)``."""
        ...

    def sample(self) -> Any:
        """A batch of transitions."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """The stored tensors, by flat names."""
        ...

    def restore(self, tensors: dict[str, Tensor], cursor: int) -> None:
        """Fill an empty buffer with the result of `tensors`."""
        ...


class GoalTask(ABC):
    """Interface of a goal-reaching task."""

    policy_config: PolicyConfig
    """Sizes of the networks."""
    stored: tuple[Any, ...] = ()
    """Keys of a transition that `reward` reads, in addition to those that every learner needs."""
    length: int
    """Actions in an episode, the same for all episodes."""

    @abstractmethod
    def make_env(self, num_envs: int, *, seed: int) -> EnvBase:
        """A batch of environments whose episodes all end after ``length`` actions."""

    @abstractmethod
    def reward(self, transitions: TensorDictBase) -> Tensor:
        """Rewards ``(B, 1)`` of transitions for their ``desired_goal``."""

    @abstractmethod
    def score(self, actor: Actor) -> dict[str, float]:
        """Score of ``actor`` without exploration; ``success`` is one of the figures."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """JSON values that must be equal when a training is continued."""

    def make_replay(self, recipe: DDPGRecipe, device: torch.device) -> GoalReplay:
        """The replay buffer: hindsight experience replay by default."""
        return HindsightReplayBuffer(
            self.reward,
            capacity=recipe.capacity,
            length=self.length,
            batch_size=recipe.batch,
            her_ratio=recipe.her_ratio,
            device=device,
        )


@dataclass(frozen=True, kw_only=True)
class DDPGRecipe:
    """How a policy is trained."""

    iterations: int = 400
    """Rounds of collection and updates."""
    num_envs: int = 32
    """Episodes that run in parallel: one round collects a whole episode of each."""
    updates: int = 100
    """Optimiser steps a round."""
    batch: int = 256
    """Transitions an update."""
    capacity: int = 500_000
    """Transitions in the replay buffer."""
    her_ratio: float = 0.8
    """Share of a batch whose goals are replaced by achieved ones."""
    warmup: int = 4
    """First rounds, with random actions, from which input statistics are taken."""
    lr_actor: float = 5e-4
    """Learning rate of the actor."""
    lr_critic: float = 1e-3
    """Learning rate of the critic."""
    final_rate: float = 0.1
    """Final share of the learning rates, which fall along a cosine."""
    gamma: float = 0.97
    """Discount per action."""
    tau: float = 0.01
    """Soft-update rate of the target networks."""
    noise: float = 0.2
    """Standard deviation of the noise on actions."""
    random_share: float = 0.1
    """Share of actions drawn at random."""
    action_penalty: float = 0.03
    """Weight of the mean squared action in the actor's loss, times the largest value."""
    clip_return: bool = False
    """Whether to clip values to the possible returns of rewards -1 and 0; for tasks with only these rewards."""
    clip: float = 10.0
    """Largest gradient norm."""
    seed: int = 0
    """Seed of initialisation, episodes and all draws."""

    algorithm: ClassVar[str] = "ddpg"
    """Its algorithm: one of `torchdyn_plan.training.algorithms.ALGORITHMS`."""

    def __post_init__(self) -> None:
        for name in ("iterations", "num_envs", "updates", "batch", "capacity"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        for name in ("seed", "warmup"):
            check_number(name, getattr(self, name), minimum=0, integer=True)
        for name in ("lr_actor", "lr_critic", "clip"):
            check_number(name, getattr(self, name), minimum=1e-12)
        for name in ("her_ratio", "gamma", "tau", "random_share", "final_rate"):
            check_number(name, getattr(self, name), minimum=0.0, maximum=1.0)
        for name in ("noise", "action_penalty"):
            check_number(name, getattr(self, name), minimum=0.0)

    @classmethod
    def like(cls, recipe: DDPGRecipe) -> Self:
        """The task-dependent fields of ``recipe``, with this algorithm's defaults for all others."""
        names = [one.name for one in fields(DDPGRecipe) if one.name not in ALGORITHM_OWNS]
        return cls(**{name: getattr(recipe, name) for name in names})

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible value of an action."""
        return (-1.0 / (1.0 - self.gamma), 0.0) if self.clip_return else (-math.inf, math.inf)

    @property
    def greatest_penalty(self) -> float:
        """Penalty in the actor's loss for a mean squared action of 1."""
        return self.action_penalty / (1.0 - self.gamma)

    def rate(self, iteration: int) -> float:
        """Factor of the learning rates in ``iteration`` (0 … iterations-1)."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * iteration / self.iterations))
        return self.final_rate + (1.0 - self.final_rate) * cosine

    def with_rate(self, lr: float) -> DDPGRecipe:
        """The recipe with ``lr`` as the critic's learning rate, and the actor's in the same proportion."""
        return replace(self, lr_critic=lr, lr_actor=lr * (self.lr_actor / self.lr_critic))
