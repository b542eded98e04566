"""Deep deterministic policy gradients with hindsight, in TorchRL's terms, for any task of reaching goals."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.modules import AdditiveGaussianModule, ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import TrainingError
from torchdyn_plan.nets.policy import Actor, Critic, PolicyConfig
from torchdyn_plan.training.checkpoint import group
from torchdyn_plan.training.hindsight import HindsightReplayBuffer
from torchdyn_plan.training.optimise import check_device

SEEN: list[Any] = [keys.OBSERVATION, keys.DESIRED_GOAL]
"""What a policy reads."""


class GoalReplay(Protocol):
    """A replay buffer of whole episodes, as the training sees it."""

    @property
    def cursor(self) -> int:
        """Where the next episode goes."""
        ...

    def extend_episodes(self, episodes: TensorDictBase) -> None:
        """Add whole ``episodes``, batch ``(N, length)``."""
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


def hindsight_replay(task: GoalTask, recipe: DDPGRecipe, device: torch.device) -> HindsightReplayBuffer:
    """The buffer of hindsight experience replay."""
    return HindsightReplayBuffer(
        task.reward, capacity=recipe.capacity, length=task.length, batch_size=recipe.batch, her_ratio=recipe.her_ratio,
        device=device,
    )  # fmt: skip


class GoalTask(Protocol):
    """A task of reaching goals, as the training sees it.

    One whose goals need another replay than `hindsight_replay` also has ``make_replay(recipe, device) -> GoalReplay``.
    """

    policy_config: PolicyConfig
    stored: tuple[Any, ...]
    """Keys of a transition that `reward` reads, beside those that every learner needs."""
    length: int
    """Actions in an episode; all episodes have as many."""

    def make_env(self, num_envs: int, *, seed: int) -> EnvBase:
        """A batch of environments whose episodes all end after ``length`` actions."""
        ...

    def reward(self, transitions: TensorDictBase) -> Tensor:
        """Rewards ``(B, 1)`` of transitions for the ``desired_goal`` that they have."""
        ...

    def score(self, actor: Actor) -> dict[str, float]:
        """How well ``actor`` does without exploration; ``success`` is one of the figures."""
        ...

    def settings(self) -> dict[str, Any]:
        """What must be the same when a training is continued: JSON values."""
        ...


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
    clip: float = 10.0
    """Greatest norm of a gradient."""
    seed: int = 0
    """Of initialisation, episodes and every draw."""

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

    def rate(self, iteration: int) -> float:
        """Factor of the learning rates in ``iteration`` (0 … iterations-1)."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * iteration / self.iterations))
        return self.final_rate + (1.0 - self.final_rate) * cosine


class RandomActionModule(TensorDictModuleBase):
    """Replaces a share of the actions by random ones, as hindsight replay's authors do (Andrychowicz et al., 2017)."""

    def __init__(self, spec: Any, share: float) -> None:
        """Draw from ``spec``, of one environment, with probability ``share`` a row."""
        super().__init__()
        self.spec, self.share = spec, share
        self.in_keys = self.out_keys = [keys.ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Change ``action`` in some rows."""
        action = tensordict.get(keys.ACTION)
        chosen = torch.rand(action.shape[:-1]).to(action.device) < self.share
        drawn = self.spec.rand(action.shape[:-1]).to(action.device)
        tensordict.set(keys.ACTION, torch.where(chosen.unsqueeze(-1), drawn, action))
        return tensordict


class PenalisedDDPGLoss(DDPGLoss):
    """TorchRL's loss, plus a weight times the mean squared action of the actor."""

    action_penalty: float = 0.0

    def loss_actor(self, tensordict: TensorDictBase) -> Any:
        """TorchRL's, but for the penalty."""
        seen = tensordict.select(*self.actor_in_keys, *self.value_exclusive_keys, strict=False).detach()
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            acted = self.actor_network(seen)
        effort = acted.get(keys.ACTION).square().mean()
        with self._cached_detached_value_params.to_module(self.value_network, preserve_module_state=False):
            acted = self.value_network(acted)
        value = acted.get(self.tensor_keys.state_action_value).mean()
        return self.action_penalty * effort - value, {}


class DDPG:
    """Everything that learns, and everything that its next step depends on."""

    def __init__(self, task: GoalTask, recipe: DDPGRecipe, *, device: str = "cpu") -> None:
        """Networks, losses, replay and collection of ``recipe``, at their beginning; they learn on ``device``."""
        check_device(device)
        torch.manual_seed(recipe.seed)
        self.device = torch.device(device)
        self.task, self.recipe, self.iteration = task, recipe, 0
        self.actor = Actor(task.policy_config).to(self.device)
        self.critic = Critic(task.policy_config).to(self.device)
        policy = TensorDictModule(self.actor, in_keys=SEEN, out_keys=[keys.ACTION])
        value = ValueOperator(self.critic, in_keys=[*SEEN, keys.ACTION])
        self.loss = PenalisedDDPGLoss(policy, value, delay_actor=True, delay_value=True)
        self.loss.make_value_estimator(gamma=recipe.gamma)
        self.targets = SoftUpdate(self.loss, tau=recipe.tau)
        groups = [
            {"params": list(self.loss.actor_network_params.values(True, True)), "lr": recipe.lr_actor},
            {"params": list(self.loss.value_network_params.values(True, True)), "lr": recipe.lr_critic},
        ]
        for parameters in groups:
            parameters["params"] = [entry for entry in parameters["params"] if isinstance(entry, nn.Parameter)]
        self.optimiser = torch.optim.Adam(groups, fused=True)
        self.replay: GoalReplay = getattr(task, "make_replay", partial(hindsight_replay, task))(recipe, self.device)
        self.env: Any = task.make_env(recipe.num_envs, seed=recipe.seed)
        spec = self.env.action_spec_unbatched
        self.random = RandomActionModule(spec, recipe.random_share)
        noise = AdditiveGaussianModule(spec, sigma_init=recipe.noise, sigma_end=recipe.noise, action_key=keys.ACTION)
        steps: list[Any] = [policy, noise, self.random]
        self.collector: Any = self.make_collector(TensorDictSequential(*steps))
        self._rollouts: Iterator[TensorDictBase] = iter(self.collector)

    def make_collector(self, policy: TensorDictModuleBase) -> BaseCollector:
        """What runs a whole episode of every environment in each round."""
        devices = {} if self.device.type == "cpu" else {"policy_device": self.device, "env_device": "cpu"}
        return Collector(
            self.env, policy, frames_per_batch=self.frames, total_frames=-1, storing_device="cpu", **devices
        )

    @property
    def frames(self) -> int:
        """Transitions that a round collects."""
        return self.recipe.num_envs * self.task.length

    def iterate(self) -> dict[str, float]:
        """One round: an episode of every environment, then the updates; returns the round's mean figures."""
        warm = self.iteration < self.recipe.warmup
        self.random.share = 1.0 if warm else self.recipe.random_share
        figures = self.collect()
        if not warm:
            if self.iteration == self.recipe.warmup:
                self.standardise()
            self.loss.action_penalty = self.recipe.action_penalty / (1.0 - self.recipe.gamma)
            figures |= self.improve()
        self.iteration += 1
        return figures

    def collect(self) -> dict[str, float]:
        """Run a whole episode of every environment into the replay buffer."""
        episodes = next(self._rollouts)
        if not episodes["next", "done"][..., -1, :].all():
            raise TrainingError(f"episodes must end after {self.task.length} actions, and some did not")
        read = [*SEEN, keys.ACTION, *(("next", key) for key in (*SEEN, keys.ACHIEVED_GOAL, "reward", "done"))]
        self.replay.extend_episodes(episodes.select(*read, ("next", "terminated"), *self.task.stored))
        return {"reward": float(episodes["next", "reward"].mean())}

    def standardise(self) -> None:
        """Set the inputs' statistics of all networks by what is in the replay buffer."""
        seen = self.replay.tensors()
        self.actor.features.set_statistics(seen[keys.OBSERVATION], seen[keys.DESIRED_GOAL])
        for name in ("shift", "scale"):
            value = getattr(self.actor.features, name)
            getattr(self.critic.features, name).copy_(value)
            for parameters in (self.loss.target_actor_network_params, self.loss.target_value_network_params):
                parameters["module", "features", name].data.copy_(value)

    def improve(self) -> dict[str, float]:
        """The round's updates; returns mean losses and value."""
        factor = self.recipe.rate(self.iteration)
        for parameters, rate in zip(
            self.optimiser.param_groups, (self.recipe.lr_actor, self.recipe.lr_critic), strict=True
        ):
            parameters["lr"] = rate * factor
        totals: dict[str, Tensor] = {}
        for update in range(self.recipe.updates):
            losses = self.update(self.replay.sample(), update)
            totals = {name: value + totals.get(name, 0.0) for name, value in losses.items()}
        return {name: float(value) / self.recipe.updates for name, value in totals.items()}

    def update(self, batch: TensorDictBase, number: int = 0) -> dict[str, Tensor]:
        """One step of both networks and of their targets; raises `TrainingError` where a loss is no number."""
        losses = self.loss(batch)
        actor, critic = losses["loss_actor"], losses["loss_value"]
        self.optimiser.zero_grad(set_to_none=True)
        (actor + critic).backward()
        norms = [nn.utils.clip_grad_norm_(entry["params"], self.recipe.clip) for entry in self.optimiser.param_groups]
        figures = [float(value.detach()) for value in (actor, critic, *norms)]
        if not all(map(math.isfinite, figures)):
            raise TrainingError(
                f"round {self.iteration + 1}, update {number + 1}: loss of the actor {figures[0]:g}, of the critic "
                f"{figures[1]:g}, gradient norms {figures[2]:g} and {figures[3]:g}: the last checkpoint is kept; try "
                f"lower learning rates than {self.recipe.lr_actor:g} and {self.recipe.lr_critic:g}"
            )
        self.optimiser.step()
        self.targets.step()
        value = losses["pred_value"].mean()
        return {"loss_actor": actor.detach(), "loss_critic": critic.detach(), "value": value.detach()}

    def tensors(self) -> dict[str, Tensor]:
        """Everything that the next round depends on, by name."""
        parts: dict[str, dict[str, Tensor]] = {"loss": dict(self.loss.state_dict()), "replay": self.replay.tensors()}
        for index, state in self.optimiser.state_dict()["state"].items():
            parts[f"optimiser.{index}"] = state
        found = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        return {name: value for name, value in found.items() if isinstance(value, Tensor)} | {
            "generator": torch.get_rng_state()
        }

    def progress(self) -> dict[str, Any]:
        """What `tensors` cannot hold: JSON values."""
        return {"iteration": self.iteration, "cursor": self.replay.cursor, "episode": self.env.next_episode}

    def restore(self, tensors: dict[str, Tensor], progress: dict[str, Any]) -> None:
        """Go back to where `tensors` and `progress` were taken."""
        self.loss.load_state_dict(group(tensors, "loss"), strict=False)
        states: dict[int, dict[str, Tensor]] = {}
        for name, value in group(tensors, "optimiser").items():
            index, _, entry = name.partition(".")
            states.setdefault(int(index), {})[entry] = value
        self.optimiser.load_state_dict({"state": states, "param_groups": self.optimiser.state_dict()["param_groups"]})
        self.replay.restore(group(tensors, "replay"), progress["cursor"])
        self.iteration = progress["iteration"]
        self.restart_collection(progress["episode"])
        torch.set_rng_state(tensors["generator"])

    def restart_collection(self, episode: int) -> None:
        """Let the environments begin anew, so that the next reset after this one takes number ``episode``."""
        # Episodes end all at once: the simulators are at a reset, which their episodes' numbers decide.
        self.env.start_from(episode - self.recipe.num_envs)
        self.collector.reset()

    def close(self) -> None:
        """Stop the collection."""
        self.collector.shutdown()
