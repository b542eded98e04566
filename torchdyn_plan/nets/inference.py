"""Networks for inference: the same functions in fewer operations, with scales and layouts folded into the weights.

For one row, a network's cost is the launch of its operations, not their arithmetic. Positions and times are part of the
same products as everything else, so these networks are in float32 or float64, even for networks in half precision.
"""

from __future__ import annotations

import copy
import operator
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Self, TypeVar

import torch
from torch import Tensor, nn
from torch.func import debug_unwrap

from torchdyn_plan.checks import check_choice, network_input
from torchdyn_plan.kinematics.quaternions import outer_axes
from torchdyn_plan.nets.arrival import ArrivalModel, ArrivalQuery
from torchdyn_plan.nets.capture import CaptureModel
from torchdyn_plan.nets.distributions import ESTIMATORS, Arrival, Spread, arrival_moments, without_never
from torchdyn_plan.nets.forecast import DescribedForecast, Forecast, in_plane
from torchdyn_plan.nets.forecaster import check_covariance, convolve, how_well_known
from torchdyn_plan.nets.spread import LOG_SCALE, LOG_SHAPE
from torchdyn_plan.precision import Precise, autocast_is_on, in_type_of, without_autocast

if TYPE_CHECKING:
    from torchdyn_plan.nets.capture import CaptureNetwork
    from torchdyn_plan.nets.eta import ETANetwork
    from torchdyn_plan.nets.forecaster import Forecaster
    from torchdyn_plan.nets.spread import SpreadNetwork

DENSE = 2**14
"""A convolution is written out as one matrix over all steps if that matrix has at most this many weights."""


Network = TypeVar("Network", bound=nn.Module)


def in_double(network: Network) -> Network:
    """A copy of ``network`` to compute constants with: float64 and on the CPU, as some devices have no float64."""
    return copy.deepcopy(network).to("cpu", torch.float64)


def hold_constants(module: nn.Module, like: Tensor, **constants: Tensor) -> None:
    """Register ``constants`` as buffers of ``module``, where ``like`` is: neither trained, nor saved.

    Numbers get its type, and float32 at least.
    """
    dtype = torch.promote_types(like.dtype, torch.float32)
    for name, value in constants.items():
        kept = value.detach().to(like.device, dtype if value.is_floating_point() else value.dtype, copy=True)
        module.register_buffer(name, kept.contiguous(), persistent=False)


class Prepared:
    """Copies of models for inference, and the weights they were made from."""

    def __init__(self, models: Sequence[nn.Module | None], copies: Sequence[Any]) -> None:
        """Hold ``copies`` of ``models``, made just now; None for one that there is not."""
        self.copies = tuple(copies)
        self._weights = [(table, name, value, value._version) for table, name, value in _weights_of(models)]

    @classmethod
    def of(cls, *models: Any) -> Self | None:
        """Copies of ``models``; None if nothing is gained, or if their weights may change unnoticed."""
        weights = [value for _, _, value in _weights_of(models)]
        if any(value.requires_grad or value.is_inference() or _is_shared(value) for value in weights):
            return None
        copies = [None if model is None else model.for_inference() for model in models]
        return None if all(map(operator.is_, copies, models)) else cls(models, copies)

    def stands_for(self, *inputs: Tensor) -> bool:
        """Whether the copies may be used for ``inputs`` instead of the models.

        They may not if weights have changed or a gradient may be needed, while compiling (the graph holds the weights
        themselves), or under ``torch.func`` (which may replace them).
        """
        if torch.compiler.is_compiling() or any(debug_unwrap(value) is not value for value in inputs):
            return False
        if torch.is_grad_enabled() and any(value.requires_grad for value in inputs):
            return False
        return all(
            table[name] is value and value._version == version and not value.requires_grad
            for table, name, value, version in self._weights
        )


def _weights_of(models: Iterable[nn.Module | None]) -> list[tuple[dict[str, Any], str, Tensor]]:
    """Every parameter and buffer of ``models``: the dictionary that holds it, and its name there."""
    parts = [part for model in models if model is not None for part in model.modules()]
    tables = [table for part in parts for table in (part._parameters, part._buffers)]
    return [(table, name, value) for table in tables for name, value in table.items() if value is not None]


def _is_shared(value: Tensor) -> bool:
    """Whether other processes may change ``value``; tensors on other devices always report themselves as shared."""
    return value.device.type == "cpu" and value.is_shared()


class InferenceForecaster(Precise, DescribedForecast):
    """`Forecaster` for inference; forecasts differ by rounding only.

    One exception: with square symmetry, a target at rest within a millimetre of a cushion is treated as moving towards
    that cushion.
    """

    zero: Tensor
    fallen: Tensor
    turns: Tensor
    octants: Tensor
    swaps: Tensor
    per_variance: Tensor
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
    least: Tensor
    most: Tensor
    spread_hidden_weight: Tensor
    spread_hidden_bias: Tensor
    spread_mix_weight: Tensor
    spread_mix_bias: Tensor
    spread_head_weight: Tensor
    spread_head_bias: Tensor

    def __init__(self, network: Forecaster, spread: SpreadNetwork | None = None) -> None:
        """Copy the current weights of ``network``, and of its ``spread``."""
        super().__init__()
        self.config = config = network.config
        self.history, self.in_keys, self.samples = config.history, network.in_keys, network.samples
        self.judged = spread is not None
        self.law = network.law
        like, exact = network.head.weight, in_double(network)
        swaps = exact.symmetries[:, :1, :1, None] == 0.0
        hold_constants(self, like, turns=_turns(exact), octants=_octants(exact), swaps=swaps)
        if config.tracked:
            hold_constants(self, like, per_variance=exact.per_variance)
        if self.law is not None:
            hold_constants(self, like, fallen=exact.fallen)
        embed: Any = exact.embed
        weight = embed.weight.squeeze(-1) * exact.step_feature_scale
        hold_constants(self, like, embed_weight=weight.mT, embed_bias=embed.bias, zero=torch.zeros(1))
        length = config.history // config.stride - 1
        self.dense, self.lengths = [], [length]
        for number, layer in enumerate(exact.convolve):
            weight, bias, length, dense = _convolution(layer, length)
            self.dense.append(dense)
            self.lengths.append(length)
            hold_constants(self, like, **{f"convolve_weight_{number}": weight, f"convolve_bias_{number}": bias})
        weight, bias = _join(exact)
        hold_constants(self, like, join_weight=weight.mT, join_bias=bias)
        hold_constants(self, like, hidden_weight=exact.hidden.weight.mT, hidden_bias=exact.hidden.bias)
        hold_constants(self, like, mix_weight=exact.mix.weight.mT, mix_bias=exact.mix.bias)
        weight, bias = _head(exact)
        hold_constants(self, like, head_weight=weight.mT, head_bias=bias)
        if spread is not None:
            least, most = torch.tensor([LOG_SCALE, LOG_SHAPE]).view(2, 2, 1, 1).unbind(1)
            hold_constants(self, like, least=least, most=most)
            for name in ("hidden", "mix", "head"):
                layer = getattr(spread, name)
                constants = {f"spread_{name}_weight": layer.weight.mT, f"spread_{name}_bias": layer.bias}
                hold_constants(self, like, **constants)

    def forward(self, target_history: Tensor, target_covariance: Tensor | None = None) -> Tensor:
        """Positions at the next F control steps, ``(*B, F, 3)`` [m, world], see `Forecaster.forward`."""
        self._check(target_history, target_covariance)
        return self._forecast(target_history, target_covariance)[0]

    def describe(
        self, target_history: Tensor, target_covariance: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same forecast, and the features for a spread, see `Forecaster.describe`."""
        self._check(target_history, target_covariance)
        forecast, hidden, symmetry = self._forecast(target_history, target_covariance)
        batch = target_history.shape[:-2]
        hidden = in_type_of(forecast, hidden).view(*batch, self.config.hidden)
        if symmetry is None:
            return forecast, hidden, hidden.new_zeros(batch, dtype=torch.bool)
        return forecast, hidden, self.swaps.index_select(0, symmetry).view(batch)

    def _check(self, target_history: Tensor, target_covariance: Tensor | None) -> None:
        """Raise `InputError` for an input that is none."""
        size = 2 if target_history.shape[-1:] == (2,) else 3
        network_input("target_history", target_history, self.config.history, size, like=self.head_weight)
        if self.config.tracked:
            check_covariance(target_covariance, target_history, like=self.head_weight)

    def _forecast(
        self, target_history: Tensor, target_covariance: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Positions (*B, F, 3), hidden features (R, hidden) and which symmetry each row has (R,), if it has one."""
        config, like = self.config, self.head_weight
        if autocast_is_on():
            return without_autocast(self._forecast, target_history, target_covariance)
        if target_history.shape[-1] == 2:
            return in_plane(self._forecast, target_history, target_covariance)
        seen = target_history
        if seen.shape[-2:] != (config.history, 3) or seen.dtype != like.dtype or seen.device != like.device:
            seen = network_input("target_history", seen, config.history, 3, like=like, finite=False)
        history = seen.reshape(-1, config.history, 3)
        if config.square_symmetry:
            # The nearest of the eight octants' middles selects a row's symmetry, its inverse, and the line's shift.
            now = history[:, -1]
            direction = (now - history[:, -2]).add_(now, alpha=1e-6)
            symmetry = direction.mm(self.octants).argmax(dim=-1)
            turn = self.turns.index_select(0, symmetry)
        else:
            symmetry, turn = None, self.turns[:1].expand(len(history), 3, 7)
        there, back, shift = turn.split((3, 3, 1), dim=-1)
        history = torch.bmm(history[:, config.stride - 1 :: config.stride], there)
        step, now = history[:, 1:] - history[:, :-1], history[:, -1]
        if config.stride > 1:
            step.mul_(1.0 / config.stride)
        known: tuple[Tensor, ...] = ()
        if config.tracked and target_covariance is not None:
            known = how_well_known(target_covariance.to(like), self.per_variance)
        line, hidden = self._line(step, now, step[:, -1], *known)
        if config.half_extent is not None:
            level = line[:, :2]
            level.sub_(level.round()).abs_()
        path = torch.bmm(back, line).add_(shift)
        path = path.mT.view(*target_history.shape[:-2], config.horizon, 3)
        return path if seen is target_history else path.to(target_history.dtype), hidden, symmetry

    def predict(self, *seen: Tensor) -> Forecast:
        """The path, and its spread if there is a spread network.

        The caller, such as a planner, must have checked for NaN.
        """
        path, hidden, symmetry = self._forecast(*seen)
        if not self.judged:
            return Forecast(path)
        spread = self._spread(hidden, symmetry, path.shape[:-2])
        return Forecast(path, spread if path.dtype == hidden.dtype else Spread(*in_type_of(path, *spread)))

    def _spread(self, hidden: Tensor, symmetry: Tensor | None, batch: torch.Size) -> Spread:
        """`SpreadNetwork.forward` of features (R, hidden) of rows with this ``symmetry`` (R,)."""
        if autocast_is_on():
            return without_autocast(self._spread, hidden, symmetry, batch)
        features = torch.addmm(self.spread_hidden_bias, hidden, self.spread_hidden_weight).relu_()
        features = torch.addmm(self.spread_mix_bias, features, self.spread_mix_weight)
        out = torch.addmm(self.spread_head_bias, features, self.spread_head_weight)
        horizon = self.config.horizon
        out = out.view(*batch, 5, horizon)
        # Entries 0 and 1 are the scales, 2 and 3 the shapes, along x and y or, in rows whose axes are swapped, y and x.
        level = out[..., :4, :].view(*batch, 2, 2, horizon)
        if symmetry is not None:
            swapped = self.swaps.index_select(0, symmetry).view(*batch, 1, 1, 1)
            level = torch.where(swapped, level.flip(-2), level)
        scale, shape = level.mT.clamp(self.least, self.most).exp_().unbind(-3)
        return Spread(scale, shape, out[..., 4, :].sigmoid())

    def _line(self, step: Tensor, now: Tensor, newest: Tensor, *known: Tensor) -> tuple[Tensor, Tensor]:
        """Unreflected line (R, 3, F) and hidden features; with cushions x and y count in periods of the reflection."""
        real = step.any(dim=-1, keepdim=True).to(step.dtype)
        if self.law is not None:
            step = torch.addcmul(step, real, self.fallen)
        change = torch.addcmul(self.zero, step - step[:, -1:], real, value=1.0 / self.config.change_scale).asinh()
        features = torch.cat([step, change, real], dim=-1).view(-1, 7)
        features = torch.addmm(self.embed_bias, features, self.embed_weight).relu_()
        for number, dense in enumerate(self.dense):
            if dense:
                features = features.view(len(step), self.lengths[number] * self.config.channels)
            else:
                steps = features.view(len(step), self.lengths[number], self.config.channels)
                features = steps.unfold(1, 3, 2).mT.reshape(-1, 3 * self.config.channels)
            weight, bias = getattr(self, f"convolve_weight_{number}"), getattr(self, f"convolve_bias_{number}")
            features = torch.addmm(bias, features, weight).relu_()
        features = features.view(len(step), self.lengths[-1] * self.config.channels)
        joined = torch.cat([features, now, newest, *self._ahead(now, newest), *known], dim=-1)
        hidden = torch.addmm(self.join_bias, joined, self.join_weight).relu_()
        hidden = torch.addmm(self.hidden_bias, hidden, self.hidden_weight).relu_()
        mixed = torch.addmm(self.mix_bias, hidden, self.mix_weight)
        mixed = torch.cat([mixed, now, newest], dim=-1)
        line = torch.addmm(self.head_bias, mixed, self.head_weight).view(len(step), 3, self.config.horizon)
        if self.law is not None:
            line = line + self.law.continued(now, newest).mT
        return line, hidden

    def _ahead(self, now: Tensor, newest: Tensor) -> tuple[Tensor, ...]:
        """When and where the newest position and step, ``(R, 3)`` each, reach a cushion, ``(R, 2)`` each."""
        extent, most = self.config.half_extent, 2.0 * self.config.horizon
        if extent is None:
            return ()
        place, speed = now[:, :2], newest[:, :2]
        if self.config.square_symmetry:
            wait = (extent - place).div_(speed.clamp_min(1e-6)).clamp(0.0, most)
        else:
            direction = torch.where(speed < 0, -1.0, 1.0)
            wait = (extent - place * direction).div_((speed * direction).clamp_min(1e-6)).clamp(0.0, most)
        period = torch.addcmul(place, speed, wait.flip(-1)).sub_(extent).mul_(0.25 / extent)
        return wait, wait.log1p(), period.sub_(period.round()).abs_()


class InferenceETA(Precise, ArrivalModel):
    """`ETANetwork` for inference; scores differ by rounding only."""

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
        """Copy the current weights of ``network``."""
        super().__init__()
        self.config = config = network.config
        like, exact, size = network.head.weight, in_double(network), config.coordinates
        parts = [size, size, 2, 6 * config.turned]
        goal, offset, lengths, axes = (exact.goal_in.weight * exact.goal_scale).split(parts, dim=1)
        bias = exact.state_in.bias + exact.state_in.weight @ exact.state_shift + exact.goal_in.weight @ exact.goal_shift
        state = (exact.state_in.weight * exact.state_scale).clone()
        state[:, slice(*config.tool_slice)] -= offset
        hold_constants(self, like, state_weight=state.mT, state_bias=bias)
        hold_constants(self, like, goal_weight=torch.cat([goal + offset, lengths, axes], dim=1).mT)
        for name in ("second", "third", "head"):
            layer = getattr(exact, name)
            hold_constants(self, like, **{f"{name}_weight": layer.weight.mT, f"{name}_bias": layer.bias})
        hold_constants(self, like, square_sums=torch.tensor([[1.0, 1.0], [1.0, 1.0], [0.0, 1.0]])[:size])
        hold_constants(
            self, like, moments=arrival_moments(exact.head.weight.new_empty(config.bins + 1), config.bin_width)
        )

    def forward(self, robot_state: Tensor, goal: Tensor) -> Tensor:
        """Scores of the bins, ``(*B, bins + 1)``, see `ETANetwork.forward`."""
        if autocast_is_on():
            return without_autocast(self.forward, robot_state, goal)
        self._check(robot_state, goal)
        return self.scores(*self._share(robot_state), goal).to(goal.dtype)

    def arrival(self, robot_state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Arrival time at ``goal (*B, 3)`` from ``robot_state (*B, S)``, see `ETANetwork.arrival`."""
        self._check(robot_state, goal)
        return self.read(*self._share(robot_state), goal, estimator=estimator)

    def from_state(self, robot_state: Tensor) -> ArrivalQuery:
        """Arrivals from ``robot_state`` (*B, S) at goals (*B, K, 3); work that depends on the state is done once.

        The caller, such as a planner, must have checked for NaN; the goals come from its search.
        """
        return partial(self.read, *self._share(robot_state.unsqueeze(-2)))

    def _check(self, robot_state: Tensor, goal: Tensor) -> None:
        """Raise `InputError` for an input that is none."""
        network_input("goal", goal, self.config.goal_size, like=self.head_weight)
        network_input("robot_state", robot_state, self.config.robot_state_size, like=self.head_weight)

    def _share(self, robot_state: Tensor) -> tuple[Tensor, Tensor]:
        """The tool position in states (*B, S), and their share of the first layer, ``(*B, hidden)``."""
        weight, size, seen = self.state_weight, self.config.robot_state_size, robot_state
        if autocast_is_on():
            return without_autocast(self._share, robot_state)
        if seen.shape[-1:] != (size,) or seen.dtype != weight.dtype or seen.device != weight.device:
            seen = network_input("robot_state", seen, size, like=weight, finite=False)
        tool_pos = seen[..., slice(*self.config.tool_slice)]
        # As `linear`, which would transpose the weight and back.
        shared = torch.addmm(self.state_bias, seen.reshape(-1, size), weight)
        return tool_pos, shared.view(*seen.shape[:-1], weight.shape[-1])

    def read(self, tool_pos: Tensor, state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Arrival time at ``goal`` (*B, 3) for tools (*B, 3) and the states' share of the first layer (*B, hidden)."""
        if autocast_is_on():
            return without_autocast(self.read, tool_pos, state, goal, estimator=estimator)
        scores, width = self.scores(tool_pos, state, goal), self.config.bin_width
        if goal.dtype != state.dtype:
            scores = in_type_of(goal, scores)
        if estimator in ("expectation", "distribution") and scores.dtype == state.dtype:
            return ESTIMATORS[estimator](scores, bin_width=width, moments=self.moments)
        check_choice("estimator", estimator, ESTIMATORS)
        return ESTIMATORS[estimator](scores, bin_width=width)

    def scores(self, tool_pos: Tensor, state: Tensor, goal: Tensor) -> Tensor:
        """Scores ``(*B, bins + 1)`` for tools (*B, 3), the states' share of the first layer, and goals (*B, 3 or 7)."""
        goal = goal if goal.dtype == state.dtype else goal.to(state.dtype)
        place = goal[..., :3] if self.config.turned else goal
        offset = place - tool_pos
        lengths = (offset.square() @ self.square_sums).sqrt_()
        seen = [place.expand(offset.shape), lengths]
        if self.config.turned:
            seen.append(outer_axes(goal[..., 3:]).expand(*offset.shape[:-1], 6))
        hidden = (torch.cat(seen, dim=-1) @ self.goal_weight).add_(state).relu_()
        rows = torch.addmm(self.second_bias, hidden.view(-1, self.config.hidden), self.second_weight).relu_()
        rows = torch.addmm(self.third_bias, rows, self.third_weight).relu_()
        rows = torch.addmm(self.head_bias, rows, self.head_weight)
        rows = rows.view(*hidden.shape[:-1], self.config.bins + self.config.never)
        return rows if self.config.never else without_never(rows)


class InferenceCapture(Precise, CaptureModel):
    """`CaptureNetwork` for inference; probabilities differ by rounding only.

    The caller, such as a planner, must have checked for NaN.
    """

    about: Tensor
    one: Tensor
    first_weight: Tensor
    first_bias: Tensor
    second_weight: Tensor
    second_bias: Tensor
    head_weight: Tensor
    head_bias: Tensor

    def __init__(self, network: CaptureNetwork) -> None:
        """Copy the current weights of ``network``."""
        super().__init__()
        self.config = config = network.config
        like, exact = network.head.weight, in_double(network)
        steps = torch.arange(-config.window, config.window + 1, config.stride)
        hold_constants(self, like, about=steps, one=torch.ones(1))
        first, bias = exact.first.weight, exact.first.bias + exact.first.weight @ exact.shift
        hold_constants(self, like, first_weight=(first * exact.scale).mT, first_bias=bias)
        for name in ("second", "head"):
            layer = getattr(exact, name)
            hold_constants(self, like, **{f"{name}_weight": layer.weight.mT, f"{name}_bias": layer.bias})

    def probability(self, path: Tensor, goal: Tensor, steps: Tensor) -> Tensor:
        """As of `CaptureModel`."""
        if autocast_is_on():
            return without_autocast(self.probability, path, goal, steps)
        if path.dtype != self.one.dtype or goal.dtype != self.one.dtype:
            about: Any = {"like": self.one, "owner": type(self).__name__, "finite": False}
            seen = network_input("path", path, *path.shape[-2:], **about)
            place = network_input("goal", goal, goal.shape[-1], **about)
            return self.probability(seen, place, steps).to(in_type_of(goal, goal))
        batch, reach = goal.shape[:-1], self.config.reach
        # As `read_about`, whose call would take as long as an operation.
        index = (steps.expand(batch).unsqueeze(-1) + self.about).clamp_(0, path.shape[-2] - 1).flatten(-2)
        read, place = path.gather(-2, index.unsqueeze(-1).expand(*index.shape, 2)), goal[..., :2].reshape(-1, 2)
        away = read.view(len(place), len(self.about), 2) - place.unsqueeze(-2)
        if self.config.mirrored:
            left, ahead = place.split(1, dim=-1)
            away[..., 0].mul_(torch.copysign(self.one, left))
            near = [away.clamp_(-reach, reach).flatten(1), left.abs(), ahead]
        else:
            near = [away.clamp_(-reach, reach).flatten(1), place]
        hidden = torch.addmm(self.first_bias, torch.cat(near, dim=-1), self.first_weight).relu_()
        hidden = torch.addmm(self.second_bias, hidden, self.second_weight).relu_()
        return torch.addmm(self.head_bias, hidden, self.head_weight).sigmoid_().view(batch)


def _turns(network: Forecaster) -> Tensor:
    """For each symmetry (8, 3, 7): its matrix for the history, the inverse in the line's units, and their shift."""
    turn, extent = network.symmetries.double(), network.config.half_extent
    unit, shift = turn.new_ones(3), turn.new_zeros(3)
    if extent is not None:
        unit[:2], shift[:2] = -4.0 * extent, extent
    return torch.cat([turn, turn * unit, turn @ shift.view(3, 1)], dim=-1)


def _octants(network: Forecaster) -> Tensor:
    """Middles (3, 8) of the octants that the symmetries map to the first; a direction belongs to the nearest one."""
    middle = torch.tensor([0.9238795325112867, 0.3826834323650898, 0.0], dtype=torch.float64)
    return (network.symmetries.double() @ middle).mT


def _convolution(layer: Any, length: int) -> tuple[Tensor, Tensor, int, bool]:
    """Weight, bias and length of the output of a convolution of ``length`` steps, and whether it is written out."""
    channels, after = layer.in_channels, max(length // 2, 1)
    padded = length < 3 or (length - 3) % 2 != 0
    if not padded and length * after * channels**2 > DENSE:
        return layer.weight.permute(2, 1, 0).flatten(0, 1), layer.bias, after, False
    unit = torch.eye(length * channels, dtype=torch.float64).view(-1, length, channels)
    none = convolve(torch.zeros_like(unit[:1]), layer)
    return (convolve(unit, layer) - none).flatten(1), none.flatten(), after, True


def _join(network: Forecaster) -> tuple[Tensor, Tensor]:
    """Weight and bias of the layer that joins convolved steps (features inmost), and the present's bare features."""
    config, weight, bias = network.config, network.join.weight.clone(), network.join.bias.clone()
    present = len(network.present_feature_scale)
    weight[:, -present:] *= network.present_feature_scale
    if config.half_extent is not None:
        end = weight.shape[1] - (3 if config.tracked else 0)
        bias += config.half_extent * weight[:, end - 2 : end].sum(1)
        weight[:, end - 2 : end] *= -4.0 * config.half_extent
    return weight, bias


def _head(network: Forecaster) -> tuple[Tensor, Tensor]:
    """Weight and bias that give the line, in `InferenceForecaster`'s units, for mixture, newest position and step."""
    extent, horizon = network.config.half_extent, network.config.horizon
    scale, unit = network.departure_scale.reshape(-1), network.departure_scale.new_ones(3, 1)
    weight, bias = network.head.weight * scale.unsqueeze(-1), (network.head.bias * scale).view(3, horizon)
    eye = torch.eye(3, dtype=torch.float64).unsqueeze(1)
    now = eye.expand(3, horizon, 3)
    newest = eye * network.step_factor.unsqueeze(-1)
    whole = torch.cat([weight.view(3, horizon, -1), now, newest], dim=-1)
    if network.law is not None:
        # The law says where the target is expected.
        whole[..., -6:] = 0.0
    if extent is not None:
        unit[:2] = 0.25 / extent
        bias[:2] -= extent
    return (whole * unit.unsqueeze(-1)).flatten(0, 1), (bias * unit).flatten()
