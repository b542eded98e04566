"""What a training of a policy is given: a task of reaching goals, and how to go about it."""

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
"""What a policy reads."""
ALGORITHM_OWNS = ("iterations", "lr_actor", "lr_critic", "final_rate", "gamma", "tau")
"""Fields of a recipe that follow from how one learns; the others follow from the task."""


class GoalReplay(Protocol):
    """A replay buffer of whole episodes, as the training sees it."""

    @property
    def cursor(self) -> int:
        """Where the next episode goes."""
        ...

    def extend(self, data: Any, **settings: Any) -> Any:
        """Add whole episodes, batch ``(N, length)``."""
        ...

    def sample(self) -> Any:
        """A batch of transitions."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """What is stored, by flat names."""
        ...

    def restore(self, tensors: dict[str, Tensor], cursor: int) -> None:
        """Fill an empty buffer with what `tensors` gave."""
        ...


class GoalTask(ABC):
    """A task of reaching goals, as the training sees it."""

    policy_config: PolicyConfig
    """Sizes of the networks."""
    stored: tuple[Any, ...] = ()
    """Keys of a transition that `reward` reads, in addition to those that every learner needs."""
    length: int
    """Actions in an episode; all episodes have as many."""

    @abstractmethod
    def make_env(self, num_envs: int, *, seed: int) -> EnvBase:
        """A batch of environments whose episodes all end after ``length`` actions."""

    @abstractmethod
    def reward(self, transitions: TensorDictBase) -> Tensor:
        """Rewards ``(B, 1)`` of transitions for the ``desired_goal`` that they have."""

    @abstractmethod
    def score(self, actor: Actor) -> dict[str, float]:
        """How well ``actor`` does without exploration; ``success`` is one of the figures."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """What must be the same when a training is continued: JSON values."""

    def make_replay(self, recipe: DDPGRecipe, device: torch.device) -> GoalReplay:
        """What transitions are kept in and sampled from: hindsight experience replay, unless a task says otherwise."""
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
    """Episodes that run side by side: one round collects a whole episode of each."""
    updates: int = 100
    """Optimiser steps a round."""
    batch: int = 256
    """Transitions an update."""
    capacity: int = 500_000
    """Transitions in the replay buffer."""
    her_ratio: float = 0.8
    """Share of a batch whose goals are replaced by achieved ones."""
    warmup: int = 4
    """First rounds, of random actions, from which inputs are standardised."""
    lr_actor: float = 5e-4
    """Learning rate of the actor."""
    lr_critic: float = 1e-3
    """Learning rate of the critic."""
    final_rate: float = 0.1
    """Share of the learning rates that is left at the end; they fall along a cosine."""
    gamma: float = 0.97
    """Discount of an action."""
    tau: float = 0.01
    """Share of the networks that their targets take over at each update."""
    noise: float = 0.2
    """Deviation of the noise on actions."""
    random_share: float = 0.1
    """Share of actions drawn at random."""
    action_penalty: float = 0.03
    """Weight of the mean squared action in the actor's loss, times the greatest value."""
    clip_return: bool = False
    """Whether values stay within the returns that rewards of -1 and 0 can have; for tasks that have no others."""
    clip: float = 10.0
    """Greatest norm of a gradient."""
    seed: int = 0
    """Of initialisation, episodes and every draw."""

    algorithm: ClassVar[str] = "ddpg"
    """What learns by it: one of `torchdyn_plan.training.algorithms.ALGORITHMS`."""

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
        """What ``recipe`` asks for on behalf of its task, with this algorithm's own defaults for all else."""
        names = [one.name for one in fields(DDPGRecipe) if one.name not in ALGORITHM_OWNS]
        return cls(**{name: getattr(recipe, name) for name in names})

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest value that an action can have."""
        return (-1.0 / (1.0 - self.gamma), 0.0) if self.clip_return else (-math.inf, math.inf)

    @property
    def greatest_penalty(self) -> float:
        """What the actor's loss gains by a mean squared action of 1."""
        return self.action_penalty / (1.0 - self.gamma)

    def rate(self, iteration: int) -> float:
        """Factor of the learning rates in ``iteration`` (0 … iterations-1)."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * iteration / self.iterations))
        return self.final_rate + (1.0 - self.final_rate) * cosine

    def with_rate(self, lr: float) -> DDPGRecipe:
        """The recipe with ``lr`` as the critic's learning rate, and the actor's in the same proportion to it."""
        return replace(self, lr_critic=lr, lr_actor=lr * (self.lr_actor / self.lr_critic))
