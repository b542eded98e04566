"""DDPG with hindsight, made to learn in less time: what came after it where that pays, and a lean update."""

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
    """How a policy is trained by `AveragedDDPG`; other fields are as in `DDPGRecipe`."""

    iterations: int = 100
    """Rounds of collection and updates."""
    gamma: float = 0.95
    """Discount of an action; values are learned the sooner the smaller it is."""
    tau: float = 0.05
    """Share of the networks that their targets take over at each update."""
    delay: int = 2
    """Updates of the critic for one of the actor."""
    average: float = 0.005
    """Share of the actor that its average takes over at each update."""

    algorithm: ClassVar[str] = "averaged"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("delay", self.delay, minimum=1, integer=True)
        check_number("average", self.average, minimum=1e-6, maximum=1.0)


class AveragedDDPG(DDPG):
    """DDPG whose actor learns at every second update, as TD3's, and whose policy is a running average of its actors.

    The actor itself swings from update to update while the critic is far from settled, between policies that trap
    nearly all balls and policies that sweep them aside; its average does not. The critic is `DDPG`'s, one alone: with
    its layers normalised, the lesser of two learned slower, and quantiles did, too.
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
        """Set the inputs' statistics of all networks by what is in the replay buffer."""
        seen = self.replay.tensors()
        self.actor.features.set_statistics(seen[keys.OBSERVATION], seen[keys.DESIRED_GOAL])
        for network in (self.critic, self.target_actor, self.target_critic, self.average):
            network.features.load_state_dict(self.actor.features.state_dict())

    def improve(self) -> dict[str, float]:
        """As `DDPG`'s."""
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
        """What the critic should say of ``batch`` (B,), ``(B, 1)``: one step's reward and the targets' view after."""
        after: TensorDictBase = batch.get("next")
        state, goal = (after.get(key) for key in SEEN)
        value = self.target_critic(state, goal, self.target_actor(state, goal))
        goes_on = (~after.get("terminated")).to(value.dtype)
        return (after.get("reward") + self.recipe.gamma * goes_on * value).clamp(*self.recipe.bounds)

    @torch.no_grad()
    def follow(self) -> None:
        """Let targets and average take over their shares of the networks."""
        lerp: Any = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
        for follower, leader, share in (
            (self.target_actor, self.actor, self.recipe.tau),
            (self.target_critic, self.critic, self.recipe.tau),
            (self.average, self.actor, self.recipe.average),
        ):
            lerp(list(follower.parameters()), list(leader.parameters()), share)
