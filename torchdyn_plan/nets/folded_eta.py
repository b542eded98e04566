"""An ETA network for inference: the same function in fewer operations, with scales and offsets put into the weights."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_choice, check_finite, check_same_device, check_trailing_shape
from torchdyn_plan.nets.eta import READINGS, Arrival, arrival_moments, decode_expectation
from torchdyn_plan.nets.folded import Folded

if TYPE_CHECKING:
    from torchdyn_plan.nets.eta import ETANetwork


class FoldedETA(Folded):
    """`ETANetwork` for inference; scores differ by rounding alone."""

    state_weight: Tensor
    state_bias: Tensor
    goal_weight: Tensor
    second_weight: Tensor
    second_bias: Tensor
    third_weight: Tensor
    third_bias: Tensor
    head_weight: Tensor
    head_bias: Tensor
    square_sums: Tensor
    moments: Tensor

    def __init__(self, network: ETANetwork) -> None:
        """Fold ``network`` as it is now."""
        super().__init__()
        self.config = config = network.config
        dtype, exact = network.head.weight.dtype, copy.deepcopy(network).double()
        goal, offset, lengths = (exact.goal_in.weight * exact.goal_scale).split([3, 3, 2], dim=1)
        bias = exact.state_in.bias + exact.state_in.weight @ exact.state_shift + exact.goal_in.weight @ exact.goal_shift
        state = (exact.state_in.weight * exact.state_scale).clone()
        state[:, slice(*config.tool_slice)] -= offset
        self._hold(dtype, state_weight=state.mT, state_bias=bias)
        self._hold(dtype, goal_weight=torch.cat([goal + offset, lengths], dim=1).mT)
        for name in ("second", "third", "head"):
            layer = getattr(exact, name)
            self._hold(dtype, **{f"{name}_weight": layer.weight.mT, f"{name}_bias": layer.bias})
        self._hold(dtype, square_sums=torch.tensor([[1.0, 1.0], [1.0, 1.0], [0.0, 1.0]]))
        self._hold(dtype, moments=arrival_moments(exact.head.weight.new_empty(config.bins + 1), config.bin_width))

    def forward(self, robot_state: Tensor, goal: Tensor) -> Tensor:
        """Scores of the bins, ``(*B, bins + 1)``, as `ETANetwork.forward` describes."""
        return self._from(robot_state).scores(goal)

    def arrival(self, robot_state: Tensor, goal: Tensor, *, reading: str = "mode") -> Arrival:
        """Arrival time at ``goal (*B, 3)`` from ``robot_state (*B, S)``, as `ETANetwork.arrival` describes."""
        return self._from(robot_state)(goal, reading=reading)

    def from_state(self, robot_state: Tensor) -> ArrivalsFromState:
        """Arrivals from ``robot_state`` (*B, S) at goals (*B, K, 3): the state's part of the work is done once."""
        return self._from(robot_state.unsqueeze(-2))

    def _from(self, robot_state: Tensor) -> ArrivalsFromState:
        if not torch.compiler.is_compiling():
            check_trailing_shape("robot_state", robot_state, self.config.robot_state_size)
            check_same_device("robot_state", robot_state, self.head_weight.device, type(self).__name__)
            check_finite("robot_state", robot_state)
        tool_pos = robot_state[..., slice(*self.config.tool_slice)]
        state = nn.functional.linear(robot_state, self.state_weight.mT, self.state_bias)
        return ArrivalsFromState(self, tool_pos, state)

    def scores(self, tool_pos: Tensor, state: Tensor, goal: Tensor) -> Tensor:
        """Scores ``(*B, bins + 1)`` for tools (*B, 3), the states' share of the first layer, and goals (*B, 3)."""
        offset = goal - tool_pos
        lengths = (offset.square() @ self.square_sums).sqrt_()
        hidden = (torch.cat([goal.expand(offset.shape), lengths], dim=-1) @ self.goal_weight).add_(state).relu_()
        rows = torch.addmm(self.second_bias, hidden.view(-1, self.config.hidden), self.second_weight).relu_()
        rows = torch.addmm(self.third_bias, rows, self.third_weight).relu_()
        rows = torch.addmm(self.head_bias, rows, self.head_weight)
        return rows.view(*hidden.shape[:-1], self.config.bins + 1)


class ArrivalsFromState:
    """What a goal search asks: arrivals from robot states that are known already."""

    def __init__(self, network: FoldedETA, tool_pos: Tensor, state: Tensor) -> None:
        """Take tool places (*B, 3) [m, world] and the states' share of the first layer (*B, hidden)."""
        self.network, self.tool_pos, self.state = network, tool_pos, state

    def __call__(self, goal: Tensor, *, reading: str = "mode") -> Arrival:
        """Arrival time at ``goal`` (*B, 3), whose batch broadcasts against the states'."""
        scores, width = self.scores(goal), self.network.config.bin_width
        if reading == "expectation":
            return decode_expectation(scores, bin_width=width, moments=self.network.moments)
        check_choice("reading", reading, READINGS)
        return READINGS[reading](scores, bin_width=width)

    def scores(self, goal: Tensor) -> Tensor:
        """Scores of the bins, ``(*B, bins + 1)``."""
        if not torch.compiler.is_compiling():
            check_trailing_shape("goal", goal, 3)
            check_same_device("goal", goal, self.state.device, type(self.network).__name__)
            check_finite("goal", goal)
        return self.network.scores(self.tool_pos, self.state, goal)

    def rows(self, index: Tensor) -> ArrivalsFromState:
        """The same for the states ``index`` (R,) of the first batch dimension alone."""
        return ArrivalsFromState(self.network, self.tool_pos[index], self.state[index])
