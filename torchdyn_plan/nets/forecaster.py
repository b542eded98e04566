"""Where the target will be: a convolutional network that emits the whole horizon at once, without recurrence."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_finite, check_number, check_same_device, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.cushions import fold
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.nets.symmetry import octant, square_symmetries


@dataclass(frozen=True, kw_only=True)
class ForecasterConfig:
    """Sizes of a `Forecaster` and what it knows about the space that the target moves in."""

    history: int = 24
    """Positions H that it sees, the newest included."""
    horizon: int = 300
    """Positions F that it emits."""
    channels: int = 32
    """Features of a step after embedding and after each convolution."""
    convolutions: int = 3
    """Convolutions over the history, each of stride 2."""
    hidden: int = 384
    """Width of the two layers between convolutions and head."""
    rank: int = 64
    """Rank of the head: forecasts are mixtures of that many shapes of path, which are learned."""
    step_scale: float = 0.02
    """Length of a step that counts as one [m]: fast motion over one control step."""
    length_scale: float = 0.75
    """Distance from the origin that counts as one [m]."""
    height_scale: float = 0.05
    """Height that counts as one [m]."""
    change_scale: float = 2e-5
    """Difference between two steps that counts as one [m]: what braking changes in a few control steps."""
    half_extent: float | None = None
    """Where the target's centre turns back at a square table's cushions, |x| or |y| [m]; None where space is open."""
    square_symmetry: bool = False
    """Whether mirrored or turned histories (about z, by quarters) have exactly mirrored or turned forecasts."""

    def __post_init__(self) -> None:
        check_number("history", self.history, minimum=2, integer=True)
        for name in ("horizon", "channels", "convolutions", "hidden", "rank"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        for name in ("step_scale", "length_scale", "height_scale", "change_scale"):
            check_number(name, getattr(self, name), minimum=1e-9)
        if self.half_extent is not None:
            check_number("half_extent", self.half_extent, minimum=1e-9)
        if not isinstance(self.square_symmetry, bool):
            raise InputError(f"square_symmetry must be a bool, got {self.square_symmetry!r}")


class Forecaster(Pretrained, nn.Module):
    """Trajectory forecasting network P_traj^O (paper, eq. 2), after the convolutional one of Nikhil & Morris (2018).

    Relative displacements are embedded step by step, convolved over the history, joined with the newest position and
    step, and turned by one linear head into all F positions, as departures from constant velocity. On a table with
    cushions it forecasts the unfolded line (`torchdyn_plan.nets.cushions`) and folds it back.
    """

    kind = "forecaster"
    config_type = ForecasterConfig
    symmetries: Tensor
    steps_ahead: Tensor
    _time: Tensor
    _scale: Tensor

    def __init__(self, config: ForecasterConfig | None = None, **settings: Any) -> None:
        """Build the network from ``config``, or from the fields of `ForecasterConfig` given as keywords."""
        super().__init__()
        self.config = config = config or ForecasterConfig(**settings)
        channels, length = config.channels, config.history - 1
        self.embed = nn.Conv1d(7, channels, 1)
        self.convolve = nn.ModuleList(
            nn.Conv1d(channels, channels, 3, stride=2, padding=1) for _ in range(config.convolutions)
        )
        for _ in range(config.convolutions):
            length = (length + 1) // 2
        self.join = nn.Linear(channels * length + self._present_size, config.hidden)
        self.hidden = nn.Linear(config.hidden, config.hidden)
        self.mix = nn.Linear(config.hidden, config.rank)
        self.head = nn.Linear(config.rank, 3 * config.horizon)
        nn.init.zeros_(self.head.bias)
        self.head.weight.data.mul_(0.1)
        self.register_buffer("symmetries", square_symmetries(), persistent=False)
        steps = torch.arange(1.0, config.horizon + 1.0)
        level, height = config.step_scale * steps, torch.full_like(steps, config.height_scale)
        self.register_buffer("steps_ahead", steps, persistent=False)
        self.register_buffer("_time", torch.stack([steps, steps, torch.zeros_like(steps)]), persistent=False)
        self.register_buffer("_scale", torch.stack([level, level, height]), persistent=False)

    def forward(self, target_history: Tensor) -> Tensor:
        """Positions at the next F control steps.

        Args:
            target_history: ``(*B, H, 3)`` positions, oldest first; rows before the first sample repeat it [m, world].

        Returns:
            ``(*B, F, 3)``: entry e-1 is the position in e steps [m, world].

        Raises:
            InputError: the history has another shape, another device than the network, or holds a NaN.
        """
        if not torch.compiler.is_compiling():
            self._check(target_history)
        turn, line = self._line(target_history)
        if self.config.half_extent is not None:
            level, height = line.split([2, 1], dim=-2)
            line = torch.cat([fold(level, self.config.half_extent), height], dim=-2)
        return line.mT if turn is None else (turn @ line).mT

    def unfolded(self, target_history: Tensor) -> Tensor:
        """Same as `forward` before cushions mirror the line: what training compares, ``(*B, F, 3)`` [m, world]."""
        turn, line = self._line(target_history)
        return line.mT if turn is None else (turn @ line).mT

    def _line(self, target_history: Tensor) -> tuple[Tensor | None, Tensor]:
        """Unfolded line (*B, 3, F) of the turned history, and the matrix (*B, 3, 3) that turns it back."""
        now, step = target_history[..., -1, :], target_history.diff(dim=-2)
        if not self.config.square_symmetry:
            return None, self._line_ahead(now, step)
        # A pinch of position decides for a target that moves along an axis or lies still.
        direction = step[..., -1, :2] + 1e-6 * now[..., :2]
        turn = self.symmetries[octant(direction)]
        return turn, self._line_ahead((now.unsqueeze(-2) @ turn).squeeze(-2), step @ turn)

    def _line_ahead(self, now: Tensor, step: Tensor) -> Tensor:
        """Positions ``(*B, 3, F)`` after the newest position ``(*B, 3)`` and the steps ``(*B, H-1, 3)`` [m]."""
        config, batch = self.config, step.shape[:-2]
        features = self._step_features(step).reshape(-1, step.shape[-2], 7)
        for layer in (self.embed, *self.convolve):
            features = torch.relu(_convolve(features, layer))
        present = self._present_features(now, step[..., -1, :])
        joined = torch.cat([features.mT.reshape(*batch, -1), present], dim=-1)
        hidden = torch.relu(self.hidden(torch.relu(self.join(joined))))
        departure = self.head(self.mix(hidden)).unflatten(-1, (3, config.horizon))
        straight = torch.addcmul(now.unsqueeze(-1), step[..., -1, :].unsqueeze(-1), self._time)
        return torch.addcmul(straight, departure, self._scale)

    def _step_features(self, step: Tensor) -> Tensor:
        """Each step, its difference from the newest one, and whether it is no padding, ``(*B, H-1, 7)``."""
        real = (step != 0).any(dim=-1, keepdim=True).to(step.dtype)
        # Braking changes a step by a thousandth, a bounce by twice itself: a logarithm shows both.
        change = torch.asinh((step - step[..., -1:, :]) / self.config.change_scale) * real
        return torch.cat([step / self.config.step_scale, 0.2 * change, real], dim=-1)

    def _present_features(self, now: Tensor, step: Tensor) -> Tensor:
        """Newest position and step, ``(*B, 3)`` each, and when and where they lead to a cushion: ``(*B, P)``."""
        config = self.config
        features = [now / config.length_scale, step / config.step_scale]
        if config.half_extent is not None:
            ahead = config.half_extent - now[..., :2] * _direction(step[..., :2])
            wait = (ahead / step[..., :2].abs().clamp(min=1e-6)).clamp(0.0, 2.0 * config.horizon)
            meeting = now[..., :2] + step[..., :2] * wait.flip(-1)
            features += [
                wait / config.horizon,
                torch.log1p(wait) / 4,
                fold(meeting, config.half_extent) / config.length_scale,
            ]
        return torch.cat(features, dim=-1)

    @property
    def _present_size(self) -> int:
        return 6 if self.config.half_extent is None else 12

    def _check(self, target_history: Tensor) -> None:
        check_trailing_shape("target_history", target_history, self.config.history, 3)
        check_same_device("target_history", target_history, self.head.weight.device, type(self).__name__)
        check_finite("target_history", target_history)


def _convolve(features: Tensor, layer: Any) -> Tensor:
    """What ``layer`` makes of ``features`` (R, L, C), as a matrix product: faster for few rows and channels."""
    size, stride, margin = layer.kernel_size[0], layer.stride[0], int(layer.padding[0])
    padded = nn.functional.pad(features, (0, 0, margin, margin)) if margin else features
    seen = padded.unfold(-2, size, stride).flatten(-2)
    return nn.functional.linear(seen, layer.weight.flatten(1), layer.bias)


def _direction(step: Tensor) -> Tensor:
    return torch.where(step < 0, -1.0, 1.0)
