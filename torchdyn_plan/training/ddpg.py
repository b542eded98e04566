"""DDPG with hindsight experience replay in TorchRL, for any goal-reaching task."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.modules import AdditiveGaussianModule, ValueOperator
from torchrl.objectives import SoftUpdate

from torchdyn_plan import keys
from torchdyn_plan.checks import check_device
from torchdyn_plan.errors import TrainingError
from torchdyn_plan.nets.policy import Actor, Critic
from torchdyn_plan.training.checkpoint import group
from torchdyn_plan.training.exploration import BoundedTD0, PenalisedDDPGLoss, RandomActionModule
from torchdyn_plan.training.goal_task import SEEN, DDPGRecipe, GoalReplay, GoalTask


class DDPG:
    """The learner, with everything that its next step depends on."""

    def __init__(self, task: GoalTask, recipe: DDPGRecipe, *, device: str = "cpu") -> None:
        """New networks, losses, replay and collection of ``recipe``; they learn on ``device``."""
        check_device(device)
        torch.manual_seed(recipe.seed)
        self.device = torch.device(device)
        self.task, self.recipe, self.iteration = task, recipe, 0
        self.actor = Actor(task.policy_config).to(self.device)
        self.critic = Critic(task.policy_config).to(self.device)
        policy = TensorDictModule(self.actor, in_keys=SEEN, out_keys=[keys.ACTION])
        self.prepare(policy)
        self.replay: GoalReplay = task.make_replay(recipe, self.device)
        self.env: Any = task.make_env(recipe.num_envs, seed=recipe.seed)
        spec = self.env.action_spec_unbatched
        self.random = RandomActionModule(spec, recipe.random_share)
        noise = AdditiveGaussianModule(spec, sigma_init=recipe.noise, sigma_end=recipe.noise, action_key=keys.ACTION)
        steps: list[Any] = [policy, noise, self.random]
        self.collector: Any = self.make_collector(TensorDictSequential(*steps))
        self._rollouts: Iterator[TensorDictBase] = iter(self.collector)

    def prepare(self, policy: TensorDictModule) -> None:
        """Make losses, targets and optimiser; ``policy`` is the actor as a tensordict module."""
        value = ValueOperator(self.critic, in_keys=[*SEEN, keys.ACTION])
        self.loss = PenalisedDDPGLoss(policy, value, delay_actor=True, delay_value=True)
        self.loss.make_value_estimator(self.make_targets())
        self.loss.action_penalty = self.recipe.greatest_penalty
        self.networks: nn.Module = self.loss
        self.targets = SoftUpdate(self.loss, tau=self.recipe.tau)
        self.optimiser = self.make_optimiser(
            self.loss.actor_network_params.values(True, True), self.loss.value_network_params.values(True, True)
        )

    def make_optimiser(self, actor: Iterable[Any], critic: Iterable[Any]) -> torch.optim.Optimizer:
        """Adam with one parameter group for each network, at its own rate."""
        groups = [
            {"params": [entry for entry in entries if isinstance(entry, nn.Parameter)], "lr": rate}
            for entries, rate in ((actor, self.recipe.lr_actor), (critic, self.recipe.lr_critic))
        ]
        return torch.optim.Adam(groups, fused=True)

    @property
    def learned(self) -> Actor:
        """The policy that is scored and saved."""
        return self.actor

    def make_targets(self) -> Any:
        """The estimator of the critic's targets."""
        lowest, highest = self.recipe.bounds
        targets = BoundedTD0(
            lowest=lowest, highest=highest, gamma=self.recipe.gamma, value_network=self.loss.actor_critic
        )
        targets.set_keys(value=self.loss.tensor_keys.state_action_value)
        return targets

    def make_collector(self, policy: TensorDictModuleBase) -> BaseCollector:
        """The collector, which runs a whole episode of every environment in each round."""
        devices = {} if self.device.type == "cpu" else {"policy_device": self.device, "env_device": "cpu"}
        return Collector(
            self.env, policy, frames_per_batch=self.frames, total_frames=-1, storing_device="cpu", **devices
        )

    @property
    def frames(self) -> int:
        """Transitions collected in a round."""
        return self.recipe.num_envs * self.task.length

    def iterate(self) -> dict[str, float]:
        """One round: an episode of every environment, then the updates; returns the round's mean figures."""
        warm = self.iteration < self.recipe.warmup
        self.random.share = 1.0 if warm else self.recipe.random_share
        figures = self.collect()
        if not warm:
            if self.iteration == self.recipe.warmup:
                self.standardise()
            figures |= self.improve()
        self.iteration += 1
        return figures

    def collect(self) -> dict[str, float]:
        """Run a whole episode of every environment into the replay buffer."""
        episodes = next(self._rollouts)
        if not episodes["next", "done"][..., -1, :].all():
            raise TrainingError(f"episodes must end after {self.task.length} actions, and some did not")
        read = [*SEEN, keys.ACTION, *(("next", key) for key in (*SEEN, keys.ACHIEVED_GOAL, "reward", "done"))]
        self.replay.extend(episodes.select(*read, ("next", "terminated"), *self.task.stored))
        return {"reward": float(episodes["next", "reward"].mean())}

    def standardise(self) -> None:
        """Set the input statistics of all networks from the replay buffer."""
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
        """One step of both networks and of their targets; raises `TrainingError` if a loss is NaN or infinite."""
        self.optimiser.zero_grad(set_to_none=True)
        figures = self.differentiate(batch, number)
        norms = [nn.utils.clip_grad_norm_(entry["params"], self.recipe.clip) for entry in self.optimiser.param_groups]
        self.check_update(number, figures["loss_actor"], figures["loss_critic"], *norms)
        self.optimiser.step()
        self.follow()
        return figures

    def differentiate(self, batch: TensorDictBase, number: int) -> dict[str, Tensor]:
        """Fill in the gradients of update ``number`` of a round; returns its losses and mean value."""
        losses = self.loss(batch)
        actor, critic = losses["loss_actor"], losses["loss_value"]
        (actor + critic).backward()
        value = losses["pred_value"].mean()
        return {"loss_actor": actor.detach(), "loss_critic": critic.detach(), "value": value.detach()}

    def follow(self) -> None:
        """Soft update of the target networks."""
        self.targets.step()

    def check_update(self, number: int, *values: Tensor) -> None:
        """Raise `TrainingError` unless the losses and gradient norms of actor and critic are finite."""
        figures = [float(value) for value in values]
        if not all(map(math.isfinite, figures)):
            raise TrainingError(
                f"round {self.iteration + 1}, update {number + 1}: loss of the actor {figures[0]:g}, of the critic "
                f"{figures[1]:g}, gradient norms {figures[2]:g} and {figures[3]:g}: the last checkpoint is kept; try "
                f"lower learning rates than {self.recipe.lr_actor:g} and {self.recipe.lr_critic:g}"
            )

    def tensors(self) -> dict[str, Tensor]:
        """Everything that the next round depends on, by name."""
        parts: dict[str, dict[str, Tensor]] = {
            "loss": dict(self.networks.state_dict()),
            "replay": self.replay.tensors(),
        }
        for index, state in self.optimiser.state_dict()["state"].items():
            parts[f"optimiser.{index}"] = state
        found = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        return {name: value for name, value in found.items() if isinstance(value, Tensor)} | {
            "generator": torch.get_rng_state()
        }

    def progress(self) -> dict[str, Any]:
        """JSON values that complete `tensors`."""
        return {"iteration": self.iteration, "cursor": self.replay.cursor, "episode": self.env.next_episode}

    def restore(self, tensors: dict[str, Tensor], progress: dict[str, Any]) -> None:
        """Restore the state of `tensors` and `progress`."""
        self.networks.load_state_dict(group(tensors, "loss"), strict=False)
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
        """Restart the environments, so that the next reset after this one takes number ``episode``."""
        # All episodes end at the same time, so the simulators are at a reset, determined by the episodes' numbers.
        self.env.start_from(episode - self.recipe.num_envs)
        self.collector.reset()

    def close(self) -> None:
        """Stop the collection."""
        self.collector.shutdown()
