"""Estimated time of arrival: a classifier of the time a static planner needs to a goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import POINT_SIZES, POSE_SIZE, check_choice, check_number, network_input
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.quaternions import outer_axes
from torchdyn_plan.nets.arrival import ArrivalModel
from torchdyn_plan.nets.distributions import ESTIMATORS, Arrival, without_never
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.precision import EXACT, Precise, autocast_is_on, without_autocast

if TYPE_CHECKING:
    from torchdyn_plan.nets.inference import InferenceETA


@dataclass(frozen=True, kw_only=True)
class ETAConfig:
    """Sizes of an `ETANetwork`; for a UR5 by default, with the bins of the paper."""

    robot_state_size: int = 15
    """Size S of the robot state."""
    tool_slice: tuple[int, int] = (12, 15)
    """First and one-past-last entry of the robot state that hold the tool position."""
    bins: int = 100
    """Bins of arrival time."""
    never: bool = True
    """Whether there is a further class *never arrives*. Without it, as in the paper, the time to a goal out of reach is
    the time until the robot is as near as it can get."""
    bin_width: int = 5
    """Control steps in a bin."""
    hidden: int = 192
    """Width of the three hidden layers."""
    turned: bool = False
    """Whether goals are poses: a position and the tool's quaternion wxyz, as in ``goal_pose``."""

    def __post_init__(self) -> None:
        for name in ("robot_state_size", "bins", "bin_width", "hidden"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        for name in ("never", "turned"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"{name} must be True or False, got {getattr(self, name)!r}")
        object.__setattr__(self, "tool_slice", tuple(self.tool_slice))
        first, last = self.tool_slice
        if not 0 <= first < last <= self.robot_state_size or last - first not in POINT_SIZES:
            spans = f"2 or 3 entries of a robot state of {self.robot_state_size}"
            raise InputError(f"tool_slice must span {spans}, got {self.tool_slice}")
        if self.turned and self.coordinates != 3:
            raise InputError(f"turned goals need a tool position of 3 coordinates, got tool_slice = {self.tool_slice}")

    @property
    def coordinates(self) -> int:
        """Coordinates D of goals, equal to those of the tool position."""
        return self.tool_slice[1] - self.tool_slice[0]

    @property
    def goal_size(self) -> int:
        """Entries of a goal: its coordinates, or 7 for poses."""
        return POSE_SIZE if self.turned else self.coordinates


class ETANetwork(Pretrained, Precise, ArrivalModel):
    """Estimated time of arrival P_ETA^R (paper, Section III-B.3): robot state and goal to a distribution over time.

    Three hidden linear + ReLU layers and a linear one. Features of the state enter the first layer separately from
    those of the goal (its position, its offset and distance from the tool, and two axes of a pose), so many goals share
    one state's work. Inputs are standardised by buffers that `set_input_statistics` fills from training data.
    """

    kind = "eta"
    config_type = ETAConfig
    state_shift: Tensor
    state_scale: Tensor
    goal_shift: Tensor
    goal_scale: Tensor

    def __init__(self, config: ETAConfig | None = None, **settings: Any) -> None:
        """Build the network from ``config``, or from the fields of `ETAConfig` given as keywords."""
        super().__init__()
        self.config = config = config or ETAConfig(**settings)
        size, hidden, wide = config.robot_state_size, config.hidden, 2 * config.coordinates + 2
        wide += 6 * config.turned
        self.state_in = nn.Linear(size, hidden)
        self.goal_in = nn.Linear(wide, hidden, bias=False)
        self.second = nn.Linear(hidden, hidden)
        self.third = nn.Linear(hidden, hidden)
        self.head = nn.Linear(hidden, config.bins + config.never)
        for name, width in (("state", size), ("goal", wide)):
            self.register_buffer(f"{name}_shift", torch.zeros(width))
            self.register_buffer(f"{name}_scale", torch.ones(width))

    @torch.no_grad()
    def set_input_statistics(self, robot_state: Tensor, goal: Tensor) -> None:
        """Standardise inputs by mean and deviation of the samples ``robot_state (n, S)`` and ``goal (n, D)``."""
        features = self._goal_features(robot_state, goal)
        for name, values in (("state", robot_state), ("goal", features)):
            scale = 1.0 / values.std(dim=0).clamp(min=1e-3)
            getattr(self, f"{name}_scale").copy_(scale)
            getattr(self, f"{name}_shift").copy_(-values.mean(dim=0) * scale)

    def forward(self, robot_state: Tensor, goal: Tensor) -> Tensor:
        """Scores of the bins; the last one stands for *never arrives*, and is -∞ if the network has no such class.

        Args:
            robot_state: ``(*B, S)``; its batch broadcasts against the goal's, ``(*B, 1, S)`` with ``(*B, K, D)``
                serves K goals from one state.
            goal: ``(*B, D)`` goals [m, world]; ``(*B, 7)`` if they are ``turned``.

        Returns:
            ``(*B, bins + 1)`` logits, of the goals' type.

        Raises:
            InputError: a trailing shape or a device is wrong, or an input holds a NaN.
        """
        if autocast_is_on():
            return without_autocast(self.forward, robot_state, goal)
        about: Any = {"like": self.state_scale, "owner": type(self).__name__}
        seen = network_input("robot_state", robot_state, self.config.robot_state_size, **about)
        place, stored = network_input("goal", goal, self.config.goal_size, **about), self.head.weight.dtype
        state = torch.addcmul(self.state_shift, seen, self.state_scale)
        target = torch.addcmul(self.goal_shift, self._goal_features(seen, place), self.goal_scale)
        if state.dtype != stored:
            state, target = state.to(stored), target.to(stored)
        hidden = (self.state_in(state) + self.goal_in(target)).relu_()
        rows = self.third(self.second(hidden.view(-1, self.config.hidden)).relu_()).relu_()
        scores = self.head(rows).view(*hidden.shape[:-1], self.config.bins + self.config.never)
        scores = scores if self.config.never else without_never(scores)
        return scores if scores.dtype == goal.dtype else scores.to(goal.dtype)

    def arrival(self, robot_state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Arrival time at ``goal (*B, D)`` from ``robot_state (*B, S)``, batches broadcasting as in `forward`.

        Args:
            robot_state: as in `forward`.
            goal: as in `forward`.
            estimator: ``mode``, the paper's; ``expectation``, which is finer than a bin; ``distribution``, the same
                with the probability of every bin; or ``soft``, for gradients.
        """
        if estimator not in ESTIMATORS:
            check_choice("estimator", estimator, ESTIMATORS)
        if goal.dtype not in EXACT:
            goal = goal.float()
        return ESTIMATORS[estimator](self(robot_state, goal), bin_width=self.config.bin_width)

    def for_inference(self) -> InferenceETA:
        """A copy for inference with the current weights, in fewer operations; it does not follow later training."""
        from torchdyn_plan.nets.inference import InferenceETA

        return InferenceETA(self)

    def _goal_features(self, robot_state: Tensor, goal: Tensor) -> Tensor:
        """Goal, its offset from the tool, level and full distance, and the axes of a pose: ``(*B, 2D + 2 or 14)``."""
        first, last = self.config.tool_slice
        place = goal[..., : last - first]
        offset = place - robot_state[..., first:last]
        level = torch.linalg.vector_norm(offset[..., :2], dim=-1, keepdim=True)
        full = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        features = [place.expand(offset.shape), offset, level, full]
        if self.config.turned:
            features.append(outer_axes(goal[..., 3:]).expand(*offset.shape[:-1], 6))
        return torch.cat(features, dim=-1)


def arrival_classes(arrival: Tensor, *, bins: int = 100, bin_width: int = 5) -> tuple[Tensor, Tensor]:
    """Target distribution for cross-entropy: an arrival time between the centres of two bins is shared by the two.

    This makes the expectation unbiased below a bin's width, and the likeliest bin is still the one with the time.

    Args:
        arrival: ``(n,)`` int64 control steps, negative or beyond the bins for *never*.
        bins: number of bins.
        bin_width: control steps in a bin.

    Returns:
        Probabilities ``(n, bins + 1)`` float32, and the class ``(n,)`` int64 that holds the time.
    """
    never = (arrival < 0) | (arrival >= bins * bin_width)
    holding = torch.where(never, bins, arrival.div(bin_width, rounding_mode="floor"))
    place = ((arrival.to(torch.float32) - (bin_width - 1) / 2) / bin_width).clamp(0.0, bins - 1.0)
    lower = place.long().clamp(max=max(bins - 2, 0))
    share = place - lower
    classes = torch.zeros(*arrival.shape, bins + 1, device=arrival.device)
    classes.scatter_(-1, lower.unsqueeze(-1), (1.0 - share).unsqueeze(-1))
    if bins > 1:
        classes.scatter_(-1, lower.unsqueeze(-1) + 1, share.unsqueeze(-1))
    sure = torch.nn.functional.one_hot(torch.full_like(holding, bins), bins + 1).to(classes.dtype)
    return torch.where(never.unsqueeze(-1), sure, classes), holding
