"""Faster DDPG with hindsight replay: delayed actor updates, an averaged actor, and a lean update step."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.nets.policy import Actor
from torchdyn_plan.threads import quick_products
from torchdyn_plan.training.ddpg import DDPG
from torchdyn_plan.training.goal_task import SEEN, DDPGRecipe


@dataclass(frozen=True, kw_only=True)
class AveragedRecipe(DDPGRecipe):
    """Recipe of `AveragedDDPG`; for the other fields see `DDPGRecipe`."""

    iterations: int = 100
    """Rounds of collection and updates."""
    gamma: float = 0.95
    """Discount per action; smaller values are learned sooner."""
    tau: float = 0.05
    """Soft-update rate of the target networks."""
    delay: int = 2
    """Critic updates per actor update."""
    average: float = 0.005
    """Soft-update rate of the averaged actor."""

    algorithm: ClassVar[str] = "averaged"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("delay", self.delay, minimum=1, integer=True)
        check_number("average", self.average, minimum=1e-6, maximum=1.0)


class AveragedDDPG(DDPG):
    """DDPG with an actor update at every second step, as in TD3, and a running average of the actors as its policy.

    Before the critic has converged, the actor itself alternates between policies that trap nearly all balls and
    policies that sweep them aside; its average does not. There is one critic, as in `DDPG`: with normalised layers, the
    minimum of two critics learned more slowly, and so did quantiles.
    """

    recipe: AveragedRecipe

    def prepare(self, policy: TensorDictModule) -> None:
        """Make targets, average and optimiser."""
        self.target_actor, self.target_critic = copy.deepcopy(self.actor), copy.deepcopy(self.critic)
        self.average = copy.deepcopy(self.actor)
        names = ("actor", "critic", "target_actor", "target_critic", "average")
        self.networks = nn.ModuleDict({name: getattr(self, name) for name in names})
        for follower in (self.target_actor, self.target_critic, self.average):
            follower.requires_grad_(False)
        self.optimiser = self.make_optimiser(self.actor.parameters(), self.critic.parameters())
        self.loss_actor = torch.zeros((), device=self.device)

    @property
    def learned(self) -> Actor:
        """The average of the actors."""
        return self.average

    def standardise(self) -> None:
        """Set the input statistics of all networks from the replay buffer."""
        seen = self.replay.tensors()
        self.actor.features.set_statistics(seen[keys.OBSERVATION], seen[keys.DESIRED_GOAL])
        for network in (self.critic, self.target_actor, self.target_critic, self.average):
            network.features.load_state_dict(self.actor.features.state_dict())

    def improve(self) -> dict[str, float]:
        """See `DDPG`."""
        with quick_products():
            return super().improve()

    def differentiate(self, batch: TensorDictBase, number: int) -> dict[str, Tensor]:
        """Fill in the critic's gradients, and the actor's in every ``delay``-th update of a round."""
        state, goal = (batch.get(key) for key in SEEN)
        value = self.critic(state, goal, batch.get(keys.ACTION))
        loss_critic = nn.functional.smooth_l1_loss(value, self.value_targets(batch))
        loss_critic.backward(inputs=list(self.critic.parameters()))
        if number % self.recipe.delay == 0:
            action = self.actor(state, goal)
            effort = self.recipe.greatest_penalty * action.square().mean()
            loss_actor = effort - self.critic(state, goal, action).mean()
            loss_actor.backward(inputs=list(self.actor.parameters()))
            self.loss_actor = loss_actor.detach()
        return {
            "loss_actor": self.loss_actor,
            "loss_critic": loss_critic.detach(),
            "value": value.detach().mean(),
        }

    @torch.no_grad()
    def value_targets(self, batch: TensorDictBase) -> Tensor:
        """Critic targets of ``batch`` (B,), ``(B, 1)``: one step's reward plus the target networks' value."""
        after: TensorDictBase = batch.get("next")
        state, goal = (after.get(key) for key in SEEN)
        value = self.target_critic(state, goal, self.target_actor(state, goal))
        goes_on = (~after.get("terminated")).to(value.dtype)
        return (after.get("reward") + self.recipe.gamma * goes_on * value).clamp(*self.recipe.bounds)

    @torch.no_grad()
    def follow(self) -> None:
        """Soft updates of the target networks and of the averaged actor."""
        lerp: Any = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
        for follower, leader, share in (
            (self.target_actor, self.actor, self.recipe.tau),
            (self.target_critic, self.critic, self.recipe.tau),
            (self.average, self.actor, self.recipe.average),
        ):
            lerp(list(follower.parameters()), list(leader.parameters()), share)
