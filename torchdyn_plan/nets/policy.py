"""A goal-conditioned policy and its critic."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import debug_unwrap

from torchdyn_plan.checks import check_count, check_finite, check_number, network_input
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.precision import Precise, autocast_is_on, without_autocast

GOAL_FEATURES = 11
"""Goal, offset from the tool, the same squashed near the goal, level and full distance."""


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Sizes of an `Actor` and its `Critic`; for a UR5 by default."""

    robot_state_size: int = 15
    """Size S of the robot state."""
    tool_slice: tuple[int, int] = (12, 15)
    """First and one-past-last entry of the robot state that hold the tool position."""
    action_size: int = 6
    """Size A of an action."""
    hidden: int = 256
    """Width of the hidden layers."""
    layers: int = 3
    """Number of hidden layers."""
    near: float = 0.05
    """Distance from the goal within which offsets are resolved finely [m]."""

    def __post_init__(self) -> None:
        for name in ("robot_state_size", "action_size", "hidden", "layers"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_count("layers", self.layers, maximum=64)
        check_number("near", self.near, minimum=1e-6)
        object.__setattr__(self, "tool_slice", tuple(self.tool_slice))
        first, last = self.tool_slice
        if not 0 <= first < last <= self.robot_state_size or last - first != 3:
            raise InputError(
                f"tool_slice must span 3 entries of a robot state of {self.robot_state_size}, got {self.tool_slice}"
            )


class GoalFeatures(Precise):
    """Input features of actor and critic from robot state and goal, standardised by buffers to about unit size."""

    shift: Tensor
    scale: Tensor

    def __init__(self, config: PolicyConfig) -> None:
        """Buffers that leave inputs unchanged until `set_statistics` fills them."""
        super().__init__()
        self.tool, self.size = slice(*config.tool_slice), config.robot_state_size + GOAL_FEATURES
        self.sharpness = 1.0 / config.near
        self.register_buffer("shift", torch.zeros(self.size))
        self.register_buffer("scale", torch.ones(self.size))

    def forward(self, robot_state: Tensor, goal: Tensor) -> Tensor:
        """Features ``(*B, S + 11)`` of robot states ``(*B, S)`` and goals ``(*B, 3)`` [m, world]."""
        return torch.addcmul(self.shift, self.raw(robot_state, goal), self.scale)

    def raw(self, robot_state: Tensor, goal: Tensor) -> Tensor:
        """The same, not yet standardised."""
        offset = goal - robot_state[..., self.tool]
        level = torch.linalg.vector_norm(offset[..., :2], dim=-1, keepdim=True)
        full = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        return torch.cat([robot_state, goal, offset, torch.tanh(offset * self.sharpness), level, full], dim=-1)

    @torch.no_grad()
    def set_statistics(self, robot_state: Tensor, goal: Tensor) -> None:
        """Standardise by mean and deviation of the samples ``robot_state`` (n, S) and ``goal`` (n, 3)."""
        features = self.raw(robot_state, goal)
        scale = 1.0 / features.std(dim=0).clamp(min=1e-2)
        self.scale.copy_(scale)
        self.shift.copy_(-features.mean(dim=0) * scale)


class Actor(Pretrained, nn.Module):
    """Deterministic policy π(s, g): fully connected with ReLU, squashed by tanh to actions within ±1."""

    kind = "policy"
    config_type = PolicyConfig

    def __init__(self, config: PolicyConfig | None = None, **settings: Any) -> None:
        """Build the network from ``config``, or from the fields of `PolicyConfig` given as keywords."""
        super().__init__()
        self.config = config = config or PolicyConfig(**settings)
        self.features = GoalFeatures(config)
        self.body = _perceptron(self.features.size, config, config.action_size, normalised=False)
        # Small initial actions: a saturated tanh hardly learns.
        final = self.body[-1]
        assert isinstance(final, nn.Linear)
        nn.init.uniform_(final.weight, -3e-3, 3e-3)
        nn.init.zeros_(final.bias)

    def forward(self, robot_state: Tensor, goal: Tensor) -> Tensor:
        """Action, of the goal's type.

        Args:
            robot_state: ``(*B, S)``.
            goal: ``(*B, 3)`` [m, world].

        Returns:
            ``(*B, A)`` within ±1.

        Raises:
            InputError: a trailing shape or a device is wrong, or an input holds a NaN.
        """
        if autocast_is_on():
            return without_autocast(self.forward, robot_state, goal)
        features, body = self.features, self.body
        about: Any = {"like": features.scale, "owner": type(self).__name__, "finite": False}
        seen = network_input("robot_state", robot_state, self.config.robot_state_size, **about)
        hidden = features(seen, network_input("goal", goal, 3, **about))
        # One check, after both are combined.
        if not torch.compiler.is_compiling() and not math.isfinite(debug_unwrap(hidden).sum().item()):
            check_finite("robot_state", robot_state)
            check_finite("goal", goal)
        hidden = _as_stored(hidden, body)
        for layer in body:
            hidden = layer(hidden)
        action = torch.tanh(hidden)
        return action if action.dtype == goal.dtype else action.to(goal.dtype)


class Critic(nn.Module):
    """Action value Q(s, g, a): fully connected with ReLU, layer-normalised so that it cannot diverge."""

    def __init__(self, config: PolicyConfig) -> None:
        """Build the network from ``config``."""
        super().__init__()
        self.config = config
        self.features = GoalFeatures(config)
        self.body = _perceptron(self.features.size + config.action_size, config, 1, normalised=True)

    def forward(self, robot_state: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Value ``(*B, 1)``, of the goal's type, of ``action`` (*B, A) for a robot state (*B, S) and a goal (*B, 3)."""
        if autocast_is_on():
            return without_autocast(self.forward, robot_state, goal, action)
        dtype = self.features.scale.dtype
        features = self.features(robot_state.to(dtype), goal.to(dtype))
        seen = torch.cat([features, action.to(dtype)], dim=-1)
        return self.body(_as_stored(seen, self.body)).to(goal.dtype)


def _as_stored(features: Tensor, body: nn.Sequential) -> Tensor:
    """``features`` in the type of the weights of ``body``."""
    first: Any = next(iter(body))
    dtype = first.weight.dtype
    return features if features.dtype == dtype else features.to(dtype)


def _perceptron(inputs: int, config: PolicyConfig, outputs: int, *, normalised: bool) -> nn.Sequential:
    layers: list[nn.Module] = []
    width = inputs
    for _ in range(config.layers):
        layers.append(nn.Linear(width, config.hidden))
        if normalised:
            layers.append(nn.LayerNorm(config.hidden))
        layers.append(nn.ReLU(inplace=True))
        width = config.hidden
    return nn.Sequential(*layers, nn.Linear(width, outputs))
