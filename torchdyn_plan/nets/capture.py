"""Chance of capture: how likely a robot that waits at a place is to capture the target that comes by."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_number, check_trailing_shape, network_input
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.precision import Precise, autocast_is_on, in_type_of, without_autocast

if TYPE_CHECKING:
    from torchdyn_plan.nets.inference import InferenceCapture


class CaptureModel(nn.Module, ABC):
    """Predicts whether waiting somewhere ends in a capture, such as `CaptureNetwork`."""

    @abstractmethod
    def probability(self, path: Tensor, goal: Tensor, steps: Tensor) -> Tensor:
        """Probability ``(*B, K)`` that a robot captures the target that is at K goals before the target comes.

        Args:
            path: ``(*B, F + 1, D)`` positions of the target now and at the next F control steps [m, world].
            goal: ``(*B, K, D)`` places at which the robot waits [m, world].
            steps: ``(*B, K)`` or ``(K,)`` int64 control steps from now until the target comes there.
        """

    def for_inference(self) -> CaptureModel:
        """The same function in as few operations as possible; by default the model itself."""
        return self


class FunctionCapture(CaptureModel):
    """A function as a model of captures."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """Wrap ``function``, from path, goals and steps to probabilities, as of `CaptureModel.probability`."""
        super().__init__()
        self.function = function

    @classmethod
    def wrap(cls, model: Any) -> CaptureModel:
        """``model`` if it is a model of captures, else the function that it must be; raises `InputError`."""
        if isinstance(model, CaptureModel):
            return model
        if not callable(model):
            raise InputError(f"capture must be a CaptureModel or a function of path, goals and steps, got {model!r}")
        return cls(model)

    def probability(self, path: Tensor, goal: Tensor, steps: Tensor) -> Tensor:
        """The function's result."""
        return self.function(path, goal, steps)


@dataclass(frozen=True, kw_only=True)
class CaptureConfig:
    """Sizes of a `CaptureNetwork`."""

    window: int = 16
    """Control steps of the path that it reads before and after the target comes."""
    stride: int = 2
    """Control steps from one position that it reads to the next."""
    reach: float = 0.3
    """Positions further than this from the robot, along x or y, are cut to it [m]."""
    mirrored: bool = False
    """Whether robot and scene are symmetric about the plane x = 0: then the network is, too."""
    hidden: int = 96
    """Width of the two hidden layers."""

    def __post_init__(self) -> None:
        for name in ("window", "stride", "hidden"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_number("reach", self.reach, minimum=1e-6)
        if not isinstance(self.mirrored, bool):
            raise InputError(f"mirrored must be True or False, got {self.mirrored!r}")

    @property
    def positions(self) -> int:
        """Positions of the path that are read."""
        return len(range(-self.window, self.window + 1, self.stride))


class CaptureNetwork(Pretrained, Precise, CaptureModel):
    """Learned from what came of a planner's attempts: a stretch of the target's path about a place to whether it traps.

    Two hidden layers on the path relative to the goal, in x and y, and on the goal itself. It needs to know neither the
    shape of a tool nor how a robot brings it down; it holds for the robot, the static planner, the maneuver and the
    scene whose attempts it was fitted to. Heights are not read. Inputs are standardised by buffers that
    `set_input_statistics` fills from training data.
    """

    kind = "capture"
    config_type = CaptureConfig
    shift: Tensor
    scale: Tensor

    def __init__(self, config: CaptureConfig | None = None, **settings: Any) -> None:
        """Build the network from ``config``, or from the fields of `CaptureConfig` given as keywords."""
        super().__init__()
        self.config = config = config or CaptureConfig(**settings)
        size = 2 * config.positions + 2
        self.first = nn.Linear(size, config.hidden)
        self.second = nn.Linear(config.hidden, config.hidden)
        self.head = nn.Linear(config.hidden, 1)
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    @torch.no_grad()
    def set_input_statistics(self, window: Tensor, goal: Tensor) -> None:
        """Standardise inputs by mean and deviation of the samples ``window`` (n, positions, 2) and ``goal`` (n, 2)."""
        features = self._features(window, goal)
        scale = 1.0 / features.std(dim=0).clamp(min=1e-3)
        self.scale.copy_(scale)
        self.shift.copy_(-features.mean(dim=0) * scale)

    def forward(self, window: Tensor, goal: Tensor) -> Tensor:
        """Logit of the probability of a capture, ``(*B,)``, of the window's type.

        Args:
            window: ``(*B, positions, 2)`` where the target is, at the steps of `windows` [m, world].
            goal: ``(*B, 2)`` or ``(*B, 3)`` where the robot waits [m, world].

        Raises:
            InputError: a shape or a device is wrong, or an input holds a NaN.
        """
        if autocast_is_on():
            return without_autocast(self.forward, window, goal)
        about: Any = {"like": self.scale, "owner": type(self).__name__}
        seen = network_input("window", window, self.config.positions, 2, **about)
        place = network_input("goal", goal[..., :2], 2, **about)
        features = torch.addcmul(self.shift, self._features(seen, place), self.scale).to(self.head.weight.dtype)
        hidden = self.second(self.first(features).relu_()).relu_()
        return in_type_of(window, self.head(hidden).squeeze(-1))

    def _features(self, window: Tensor, place: Tensor) -> Tensor:
        """The path (*B, positions, 2) from the place (*B, 2), and the place: ``(*B, 2 positions + 2)``."""
        away = window - place.unsqueeze(-2)
        if self.config.mirrored:
            side = torch.stack([torch.where(place[..., 0] < 0.0, -1.0, 1.0), torch.ones_like(place[..., 0])], dim=-1)
            away, place = away * side.unsqueeze(-2), place * side
        near = away.clamp(-self.config.reach, self.config.reach)
        return torch.cat([near.flatten(-2), place], dim=-1)

    def probability(self, path: Tensor, goal: Tensor, steps: Tensor) -> Tensor:
        """As of `CaptureModel`; raises `InputError` for a wrong shape."""
        return self(self.windows(path, steps.expand(goal.shape[:-1])), goal).sigmoid()

    def for_inference(self) -> InferenceCapture:
        """A copy for inference with the current weights, in fewer operations; it does not follow later training."""
        from torchdyn_plan.nets.inference import InferenceCapture

        return InferenceCapture(self)

    def windows(self, path: Tensor, steps: Tensor) -> Tensor:
        """What is read of a path, ``(*B, K, positions, 2)`` [m, world].

        Args:
            path: ``(*B, F + 1, D)`` from now on; before it and after it the target is taken to stand still.
            steps: ``(*B, K)`` int64 control steps from now until the target comes to each of K places.
        """
        check_trailing_shape("steps", steps, *path.shape[:-2], steps.shape[-1])
        window = self.config.window
        about = torch.arange(-window, window + 1, self.config.stride, device=path.device)
        return read_about(path, steps, about)


def read_about(path: Tensor, steps: Tensor, about: Tensor) -> Tensor:
    """Positions ``(*B, K, P, 2)`` of ``path`` (*B, F + 1, D) at ``steps`` (*B, K) + ``about`` (P,), within its ends."""
    index = (steps.unsqueeze(-1) + about).clamp_(0, path.shape[-2] - 1).flatten(-2)
    read = path[..., :2].gather(-2, index.unsqueeze(-1).expand(*index.shape, 2))
    return read.view(*steps.shape, len(about), 2)
