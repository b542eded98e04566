"""Additions of `DDPG` to TorchRL's exploration, loss and value targets."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import DDPGLoss
from torchrl.objectives.value import TD0Estimator

from torchdyn_plan import keys


class RandomActionModule(TensorDictModuleBase):
    """Replaces a share of the actions by random ones, as in hindsight replay (Andrychowicz et al., 2017).

    Like TorchRL's `EGreedyModule`, but it always draws on the CPU: checkpoints hold only that generator, and a resumed
    training must draw the same.
    """

    def __init__(self, spec: Any, share: float) -> None:
        """Draw from ``spec``, of one environment, with probability ``share`` in each row."""
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
        """TorchRL's, plus the penalty."""
        seen = tensordict.select(*self.actor_in_keys, *self.value_exclusive_keys, strict=False).detach()
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            acted = self.actor_network(seen)
        effort = acted.get(keys.ACTION).square().mean()
        with self._cached_detached_value_params.to_module(self.value_network, preserve_module_state=False):
            acted = self.value_network(acted)
        value = acted.get(self.tensor_keys.state_action_value).mean()
        return self.action_penalty * effort - value, {}


class BoundedTD0(TD0Estimator):
    """TorchRL's one-step value targets, clipped to the possible returns (Andrychowicz et al., 2017, appendix)."""

    def __init__(self, *, lowest: float, highest: float, **settings: Any) -> None:
        """Bound by ``lowest`` and ``highest``; ``settings`` are TorchRL's."""
        super().__init__(**settings)
        self.lowest, self.highest = lowest, highest

    def value_estimate(self, *args: Any, **kwargs: Any) -> Tensor:
        """TorchRL's, bounded."""
        return super().value_estimate(*args, **kwargs).clamp(self.lowest, self.highest)
