"""A forecaster for inference: the same function in fewer operations, with scales and layouts put into the weights.

At one row a network costs what its operations cost to launch, hardly what they compute.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_finite, check_same_device, check_trailing_shape

if TYPE_CHECKING:
    from torchdyn_plan.nets.forecaster import Forecaster

DENSE = 2**14
"""A convolution of at most so many weights, written out as one matrix over all steps, is cheaper as that matrix."""


class Folded(nn.Module):
    """A network's weights at the moment it was folded, as buffers: neither trained, nor saved, nor kept up to date."""

    def _hold(self, dtype: torch.dtype, **constants: Tensor) -> None:
        for name, value in constants.items():
            self.register_buffer(name, value.detach().to(dtype).contiguous(), persistent=False)


class FoldedForecaster(Folded):
    """`Forecaster` for inference; forecasts differ by rounding alone.

    The one exception: with square symmetry, a target that stands still within a millimetre of a cushion is taken to
    be on its way to that cushion.
    """

    zero: Tensor
    turns: Tensor
    octants: Tensor
    embed_weight: Tensor
    embed_bias: Tensor
    join_weight: Tensor
    join_bias: Tensor
    hidden_weight: Tensor
    hidden_bias: Tensor
    mix_weight: Tensor
    mix_bias: Tensor
    head_weight: Tensor
    head_bias: Tensor

    def __init__(self, network: Forecaster) -> None:
        """Fold ``network`` as it is now."""
        super().__init__()
        self.config = config = network.config
        dtype, exact = network.head.weight.dtype, copy.deepcopy(network).double()
        self._hold(dtype, turns=_turns(exact), octants=_octants(exact))
        embed: Any = exact.embed
        weight = embed.weight.squeeze(-1) * exact._step_scale
        self._hold(dtype, embed_weight=weight.mT, embed_bias=embed.bias, zero=torch.zeros(1))
        length, self.dense = config.history - 1, []
        for number, layer in enumerate(exact.convolve):
            weight, bias, length, dense = _convolution(layer, length)
            self.dense.append(dense)
            self._hold(dtype, **{f"convolve_weight_{number}": weight, f"convolve_bias_{number}": bias})
        weight, bias = _join(exact)
        self._hold(dtype, join_weight=weight.mT, join_bias=bias)
        self._hold(dtype, hidden_weight=exact.hidden.weight.mT, hidden_bias=exact.hidden.bias)
        self._hold(dtype, mix_weight=exact.mix.weight.mT, mix_bias=exact.mix.bias)
        weight, bias = _head(exact)
        self._hold(dtype, head_weight=weight.mT, head_bias=bias)

    def forward(self, target_history: Tensor) -> Tensor:
        """Positions at the next F control steps, ``(*B, F, 3)`` [m, world], as `Forecaster.forward` describes."""
        return self._forecast(target_history)[0]

    def describe(self, target_history: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same forecast, and what a spread is told by, as `Forecaster.describe` describes."""
        forecast, hidden, turn = self._forecast(target_history)
        batch = target_history.shape[:-2]
        return forecast, hidden.view(*batch, self.config.hidden), (turn[:, 0, 0] == 0.0).view(batch)

    def _forecast(self, target_history: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (*B, F, 3), hidden features (R, hidden) and how each row was turned (R, 3, 7)."""
        config = self.config
        if not torch.compiler.is_compiling():
            check_trailing_shape("target_history", target_history, config.history, 3)
            check_same_device("target_history", target_history, self.head_weight.device, type(self).__name__)
            check_finite("target_history", target_history)
        history = target_history.reshape(-1, config.history, 3)
        turn = self._turn(history)
        history = torch.bmm(history, turn[..., :3])
        step, now = history[:, 1:] - history[:, :-1], history[:, -1]
        line, hidden = self._line(step, now, step[:, -1])
        if config.half_extent is not None:
            level = line[:, :2]
            level.sub_(level.round()).abs_()
        path = torch.bmm(turn[..., 3:6], line).add_(turn[..., 6:])
        return path.mT.view(*target_history.shape[:-2], config.horizon, 3), hidden, turn

    def _turn(self, history: Tensor) -> Tensor:
        """How each row of histories (R, H, 3) is turned, and its line turned back and shifted: ``(R, 3, 7)``."""
        if not self.config.square_symmetry:
            return self.turns[:1].expand(len(history), 3, 7)
        now = history[:, -1]
        direction = (now - history[:, -2]).add_(now, alpha=1e-6)
        return self.turns.index_select(0, direction.mm(self.octants).argmax(dim=-1))

    def _line(self, step: Tensor, now: Tensor, newest: Tensor) -> tuple[Tensor, Tensor]:
        """Unfolded line (R, 3, F) and hidden features; with cushions x and y are in periods, whole at the far one."""
        real = step.any(dim=-1, keepdim=True).to(step.dtype)
        change = torch.addcmul(self.zero, step - step[:, -1:], real, value=1.0 / self.config.change_scale).asinh_()
        features = torch.cat([step, change, real], dim=-1).view(-1, 7)
        features = torch.addmm(self.embed_bias, features, self.embed_weight).relu_()
        for number, dense in enumerate(self.dense):
            if dense:
                features = features.view(len(step), -1)
            else:
                steps = features.view(len(step), -1, self.config.channels)
                features = steps.unfold(1, 3, 2).mT.reshape(-1, 3 * self.config.channels)
            weight, bias = getattr(self, f"convolve_weight_{number}"), getattr(self, f"convolve_bias_{number}")
            features = torch.addmm(bias, features, weight).relu_()
        joined = torch.cat([features.view(len(step), -1), now, newest, *self._ahead(now, newest)], dim=-1)
        hidden = torch.addmm(self.join_bias, joined, self.join_weight).relu_()
        hidden = torch.addmm(self.hidden_bias, hidden, self.hidden_weight).relu_()
        mixed = torch.addmm(self.mix_bias, hidden, self.mix_weight)
        mixed = torch.cat([mixed, now, newest], dim=-1)
        line = torch.addmm(self.head_bias, mixed, self.head_weight).view(len(step), 3, self.config.horizon)
        return line, hidden

    def _ahead(self, now: Tensor, newest: Tensor) -> tuple[Tensor, ...]:
        """When and where the newest position and step, ``(R, 3)`` each, lead to a cushion, ``(R, 2)`` each."""
        extent, most = self.config.half_extent, 2.0 * self.config.horizon
        if extent is None:
            return ()
        place, speed = now[:, :2], newest[:, :2]
        if self.config.square_symmetry:
            wait = (extent - place).div_(speed.clamp_min(1e-6)).clamp_(0.0, most)
        else:
            direction = torch.where(speed < 0, -1.0, 1.0)
            wait = (extent - place * direction).div_((speed * direction).clamp_min(1e-6)).clamp_(0.0, most)
        period = torch.addcmul(place, speed, wait.flip(-1)).sub_(extent).mul_(0.25 / extent)
        return wait, wait.log1p(), period.sub_(period.round()).abs_()


def _turns(network: Forecaster) -> Tensor:
    """For each symmetry (8, 3, 7): the turn of the history, the turn back of the line's units, and their shift."""
    turn, extent = network.symmetries.double(), network.config.half_extent
    unit, shift = turn.new_ones(3), turn.new_zeros(3)
    if extent is not None:
        unit[:2], shift[:2] = -4.0 * extent, extent
    return torch.cat([turn, turn * unit, turn @ shift.view(3, 1)], dim=-1)


def _octants(network: Forecaster) -> Tensor:
    """Middles (3, 8) of the octants that the symmetries turn into the first: the nearest one of a direction is its."""
    middle = torch.tensor([0.9238795325112867, 0.3826834323650898, 0.0], dtype=torch.float64)
    return (network.symmetries.double() @ middle).mT


def _convolution(layer: Any, length: int) -> tuple[Tensor, Tensor, int, bool]:
    """Weight, bias and length of the output of a convolution of ``length`` steps, and whether it is written out."""
    from torchdyn_plan.nets.forecaster import convolve

    channels = layer.in_channels
    unit = torch.eye(length * channels, dtype=torch.float64).view(-1, length, channels)
    none = convolve(torch.zeros_like(unit[:1]), layer)
    written = (convolve(unit, layer) - none).flatten(1)
    after, padded = none.shape[1], length < 3 or (length - 3) % 2 != 0
    if padded or written.numel() <= DENSE:
        return written, none.flatten(), after, True
    return layer.weight.permute(2, 1, 0).flatten(0, 1), layer.bias, after, False


def _join(network: Forecaster) -> tuple[Tensor, Tensor]:
    """Weight and bias of the layer that joins convolved steps (features inmost), and the present's bare features."""
    config, weight, bias = network.config, network.join.weight.clone(), network.join.bias.clone()
    present = len(network._present_scale)
    weight[:, -present:] *= network._present_scale
    if config.half_extent is not None:
        bias += config.half_extent * weight[:, -2:].sum(1)
        weight[:, -2:] *= -4.0 * config.half_extent
    return weight, bias


def _head(network: Forecaster) -> tuple[Tensor, Tensor]:
    """Weight and bias that give the line, in the units of `FoldedForecaster`, for mixture, newest position and step."""
    extent, horizon = network.config.half_extent, network.config.horizon
    scale, unit = network._scale.reshape(-1), network._scale.new_ones(3, 1)
    weight, bias = network.head.weight * scale.unsqueeze(-1), (network.head.bias * scale).view(3, horizon)
    eye = torch.eye(3, dtype=torch.float64).unsqueeze(1)
    now = eye.expand(3, horizon, 3)
    newest = eye * network._time.unsqueeze(-1)
    whole = torch.cat([weight.view(3, horizon, -1), now, newest], dim=-1)
    if extent is not None:
        unit[:2] = 0.25 / extent
        bias[:2] -= extent
    return (whole * unit.unsqueeze(-1)).flatten(0, 1), (bias * unit).flatten()
