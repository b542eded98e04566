"""Trajectory forecasting: a convolutional network that emits the whole horizon at once, without recurrence."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_count, check_number, check_trailing_shape, check_vector, network_input
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.analytic import Ballistic
from torchdyn_plan.nets.forecast import DescribedForecast, in_plane
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.nets.reflection import reflect
from torchdyn_plan.nets.symmetry import octant, square_symmetries
from torchdyn_plan.precision import Precise, autocast_is_on, in_type_of, without_autocast

if TYPE_CHECKING:
    from torchdyn_plan.nets.inference import InferenceForecaster


@dataclass(frozen=True, kw_only=True)
class ForecasterConfig:
    """Sizes of a `Forecaster`, and its prior knowledge of the space in which the target moves."""

    history: int = 24
    """Positions H that it reads, including the newest."""
    horizon: int = 300
    """Positions F that it emits."""
    channels: int = 32
    """Features per step after the embedding and after each convolution."""
    convolutions: int = 3
    """Convolutions over the history, each of stride 2."""
    hidden: int = 384
    """Width of the two layers between convolutions and head."""
    rank: int = 64
    """Rank of the head: forecasts are mixtures of this many learned path shapes."""
    step_scale: float = 0.02
    """Unit for the length of a step [m]: fast motion over one control step."""
    length_scale: float = 0.75
    """Unit for the distance from the origin [m]."""
    height_scale: float = 0.05
    """Unit for height [m]."""
    change_scale: float = 2e-5
    """Unit for the difference of two steps [m]: the effect of braking over a few control steps."""
    half_extent: float | None = None
    """Where the target's centre turns back at a square table's cushions, |x| or |y| [m]; None for open space."""
    square_symmetry: bool = False
    """Whether mirrored or rotated histories (about z, by quarter turns) have exactly mirrored or rotated forecasts."""
    stride: int = 1
    """Stride at which the history is read, including the newest position."""
    tracked: bool = False
    """Whether it also reads the covariance of position and velocity from a `torchdyn_plan.planners.Track`."""
    gravity: tuple[float, float, float] | None = None
    """Acceleration of a target that flies [m/s², world]. The network then learns what a `Ballistic` forecast leaves
    out, in units of ``change_scale`` for each step. None for a target that does not fall."""
    drag: float = 0.0
    """Of that `Ballistic` forecast: deceleration over speed squared [1/m]."""
    control_step: float = 0.004
    """Time between two positions, for that forecast [s]."""

    def __post_init__(self) -> None:
        check_number("history", self.history, minimum=2, integer=True)
        check_number("stride", self.stride, minimum=1, maximum=self.history // 2, integer=True)
        if self.history % self.stride:
            raise InputError(f"history must be a multiple of stride = {self.stride}, got {self.history}")
        for name in ("horizon", "channels", "convolutions", "hidden", "rank"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_count("convolutions", self.convolutions, maximum=16)
        for name in ("step_scale", "length_scale", "height_scale", "change_scale"):
            check_number(name, getattr(self, name), minimum=1e-9)
        if self.half_extent is not None:
            check_number("half_extent", self.half_extent, minimum=1e-9)
        for name in ("square_symmetry", "tracked"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"{name} must be a bool, got {getattr(self, name)!r}")
        check_number("drag", self.drag, minimum=0.0)
        check_number("control_step", self.control_step, minimum=1e-6)
        if self.gravity is None:
            return
        object.__setattr__(self, "gravity", check_vector("gravity", self.gravity))
        if len(self.gravity) != 3 or self.half_extent is not None or self.square_symmetry or self.stride > 1:
            raise InputError(
                "gravity is three numbers, for a network without half_extent, square_symmetry and stride, got "
                f"{self.gravity!r}"
            )


class Forecaster(Pretrained, Precise, DescribedForecast):
    """Trajectory forecasting network P_traj^O (paper, eq. 2), after the convolutional one of Nikhil & Morris (2018).

    Displacements are embedded step by step, convolved over the history, concatenated with the newest position and step,
    and mapped by one linear head to all F positions, as deviations from constant velocity. On a table with cushions it
    forecasts a line that runs on through them, and then reflects it (`torchdyn_plan.nets.reflection`). With a
    ``gravity`` the deviations are from a ballistic flight, and displacements are seen as if nothing fell.
    """

    kind = "forecaster"
    config_type = ForecasterConfig
    symmetries: Tensor
    steps_ahead: Tensor
    step_feature_scale: Tensor
    present_feature_scale: Tensor
    step_factor: Tensor
    departure_scale: Tensor
    per_variance: Tensor
    fallen: Tensor

    def __init__(self, config: ForecasterConfig | None = None, **settings: Any) -> None:
        """Build the network from ``config``, or from the fields of `ForecasterConfig` given as keywords."""
        super().__init__()
        self.config = config = config or ForecasterConfig(**settings)
        self.history, self.in_keys = config.history, keys_of(config)
        self.samples = LEAST_SAMPLES if config.tracked else None
        channels, length = config.channels, config.history // config.stride - 1
        self.embed = nn.Conv1d(7, channels, 1)
        self.convolve = nn.ModuleList(nn.Conv1d(channels, channels, 3, stride=2) for _ in range(config.convolutions))
        for _ in range(config.convolutions):
            length = max(length // 2, 1)
        step = [1.0 / config.step_scale] * 3
        present = [1.0 / config.length_scale] * 3 + step
        if config.half_extent is not None:
            present += [1.0 / config.horizon] * 2 + [0.25] * 2 + [1.0 / config.length_scale] * 2
        if config.tracked:
            present += [0.125, 0.125, 1.0]
        self.join = nn.Linear(channels * length + len(present), config.hidden)
        self.hidden = nn.Linear(config.hidden, config.hidden)
        self.mix = nn.Linear(config.hidden, config.rank)
        self.head = nn.Linear(config.rank, 3 * config.horizon)
        nn.init.zeros_(self.head.bias)
        self.head.weight.data.mul_(0.1)
        steps = torch.arange(1.0, config.horizon + 1.0)
        level, height = config.step_scale * steps, torch.full_like(steps, config.height_scale)
        constants = {"per_variance": torch.tensor([1e6, 1e2])} if config.tracked else {}
        self.law = None
        if config.gravity is not None:
            law: dict[str, Any] = {"control_step": config.control_step, "gravity": config.gravity, "drag": config.drag}
            self.law = Ballistic(horizon=config.horizon, **law)
            level = height = 0.5 * config.change_scale * steps.square()
            # What gravity has added to a step from then to now.
            ago = torch.arange(config.history - 2.0, -1.0, -1.0).unsqueeze(-1)
            constants["fallen"] = config.control_step**2 * ago * torch.tensor(config.gravity)
        constants |= {
            "symmetries": square_symmetries(),
            "steps_ahead": steps,
            "step_feature_scale": torch.tensor([*step, 0.2, 0.2, 0.2, 1.0]),
            "present_feature_scale": torch.tensor(present),
            "step_factor": torch.stack([steps, steps, torch.zeros_like(steps)]),
            "departure_scale": torch.stack([level, level, height]),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, target_history: Tensor, target_covariance: Tensor | None = None) -> Tensor:
        """Positions at the next F control steps.

        Args:
            target_history: ``(*B, H, D)`` positions, oldest first; rows before the first sample repeat it [m, world].
                Targets in a plane, D = 2, are taken at height 0.
            target_covariance: ``(*B, 2, 2)`` of position and velocity along each axis, for a ``tracked`` network
                [m², m²/s; m²/s, m²/s²].

        Returns:
            ``(*B, F, D)``, of the history's type: entry e-1 is the position in e steps [m, world].

        Raises:
            InputError: an argument is missing, has the wrong shape or device, or holds a NaN.
        """
        return self._forecast(target_history, target_covariance, reflected=self.config.half_extent is not None)[0]

    def describe(
        self, target_history: Tensor, target_covariance: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same forecast, and the features that a `torchdyn_plan.nets.SpreadNetwork` reads.

        Returns:
            Positions (*B, F, 3) [m, world] and the last hidden layer (*B, hidden), of the history's type (the latter in
            float32 at least), and whether x and y are swapped in it (*B,): mirrored and rotated histories share their
            features.
        """
        reflected = self.config.half_extent is not None
        forecast, features, swapped = self._forecast(target_history, target_covariance, reflected=reflected)
        batch = target_history.shape[:-2]
        return forecast, in_type_of(forecast, features).view(*batch, self.config.hidden), swapped.view(batch)

    def unreflected(self, target_history: Tensor, target_covariance: Tensor | None = None) -> Tensor:
        """`forward` before the line is reflected at cushions, as compared in training: ``(*B, F, 3)`` [m, world]."""
        return self._forecast(target_history, target_covariance, reflected=False)[0]

    def for_inference(self) -> InferenceForecaster:
        """A copy for inference with the current weights, in fewer operations; it does not follow later training."""
        from torchdyn_plan.nets.inference import InferenceForecaster

        return InferenceForecaster(self)

    def _forecast(
        self, target_history: Tensor, target_covariance: Tensor | None, *, reflected: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (*B, F, 3), hidden features (R, hidden) and whether x and y are swapped in them (R,)."""
        if autocast_is_on():
            return without_autocast(self._forecast, target_history, target_covariance, reflected=reflected)
        if target_history.shape[-1] == 2:
            return in_plane(partial(self._forecast, reflected=reflected), target_history, target_covariance)
        config, about = self.config, {"like": self.steps_ahead, "owner": type(self).__name__}
        seen = network_input("target_history", target_history, config.history, 3, **about)
        history, turn = seen.reshape(-1, config.history, 3), None
        if config.square_symmetry:
            now, before = history[:, -1, :2], history[:, -2, :2]
            # A small share of the position breaks ties for a target that moves along an axis or rests.
            turn = self.symmetries[octant(torch.add(now - before, now, alpha=1e-6))]
            history = torch.bmm(history, turn)
        known: tuple[Tensor, ...] = ()
        if config.tracked:
            covariance = check_covariance(target_covariance, target_history, **about)
            known = how_well_known(covariance, self.per_variance)
        line, hidden = self._line(history[:, config.stride - 1 :: config.stride], known)
        if reflected:
            assert config.half_extent is not None
            line = torch.cat([reflect(line[:, :2], config.half_extent), line[:, 2:]], dim=1)
        if turn is not None:
            line = torch.bmm(turn, line)
        swapped = hidden.new_zeros(len(hidden), dtype=torch.bool) if turn is None else turn[:, 0, 0] == 0.0
        path = line.mT.view(*target_history.shape[:-2], config.horizon, 3)
        return path if path.dtype == target_history.dtype else path.to(target_history.dtype), hidden, swapped

    def _line(self, history: Tensor, known: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Unreflected positions (R, 3, F) for the rotated histories (R, H, 3) [m], and the last hidden layer.

        ``known`` is from `how_well_known`, if at all. Features and hidden values have the type of the layers' weights.
        """
        now, step = history[:, -1], history[:, 1:] - history[:, :-1]
        if self.config.stride > 1:
            step = step / self.config.stride
        newest, stored = step[:, -1], self.join.weight.dtype
        features, present = self._step_features(step), self._present_features(now, newest, known)
        if features.dtype != stored:
            features, present = features.to(stored), present.to(stored)
        for layer in (self.embed, *self.convolve):
            features = convolve(features, layer).relu_()
        joined = torch.cat([features.flatten(1), present], dim=-1)
        hidden = self.hidden(self.join(joined).relu_()).relu_()
        departure = self.head(self.mix(hidden)).view(-1, 3, self.config.horizon)
        if departure.dtype != now.dtype:
            departure = departure.to(now.dtype)
        if self.law is None:
            expected = torch.addcmul(now.unsqueeze(-1), newest.unsqueeze(-1), self.step_factor)
        else:
            expected = self.law.continued(now, newest).mT
        return torch.addcmul(expected, departure, self.departure_scale), hidden

    def _step_features(self, step: Tensor) -> Tensor:
        """Each step, its difference from the newest one, and whether it is not padding, ``(R, H-1, 7)``."""
        real = (step != 0).any(dim=-1, keepdim=True)
        if self.law is not None:
            step = torch.addcmul(step, real.to(step.dtype), self.fallen)
        # Braking changes a step by a thousandth of it, a bounce by twice: a logarithm resolves both.
        change = torch.asinh((step - step[:, -1:]) * (real / self.config.change_scale))
        return torch.cat([step, change, real.to(step.dtype)], dim=-1) * self.step_feature_scale

    def _present_features(self, now: Tensor, step: Tensor, known: tuple[Tensor, ...]) -> Tensor:
        """Newest position and step, ``(R, 3)`` each, when and where they reach a cushion, and ``known``."""
        features, extent, horizon = [now, step], self.config.half_extent, self.config.horizon
        if extent is not None:
            place, speed = now[:, :2], step[:, :2]
            direction = torch.where(speed < 0, -1.0, 1.0)
            wait = (extent - place * direction).div_((speed * direction).clamp_min(1e-6)).clamp(0.0, 2.0 * horizon)
            features += [wait, wait.log1p(), reflect(torch.addcmul(place, speed, wait.flip(-1)), extent)]
        return torch.cat([*features, *known], dim=-1) * self.present_feature_scale


def keys_of(config: ForecasterConfig) -> tuple[str, ...]:
    """Keys of the observation that a forecaster of ``config`` reads."""
    return (keys.TARGET_HISTORY, keys.TARGET_COVARIANCE) if config.tracked else (keys.TARGET_HISTORY,)


def check_covariance(covariance: Tensor | None, history: Tensor, **about: Any) -> Tensor:
    """The covariance (*B, 2, 2) of histories (*B, H, D), as `network_input` takes it; raises `InputError`."""
    if covariance is None:
        raise InputError("a tracked forecaster reads target_covariance (*B, 2, 2) in addition to the history, got none")
    if covariance.shape[:-2] != history.shape[:-2]:
        check_trailing_shape(keys.TARGET_COVARIANCE, covariance, *history.shape[:-2], 2, 2)
    return network_input(keys.TARGET_COVARIANCE, covariance, 2, 2, **about)


def how_well_known(covariance: Tensor, per_variance: Tensor) -> tuple[Tensor, Tensor]:
    """Features of covariances (R, 2, 2) of position and velocity: logarithms of both variances, and the correlation.

    ``per_variance`` (2,) are one over the variances' units. Returns ``(R, 2)`` and ``(R, 1)``.
    """
    numbers = covariance.reshape(-1, 4)
    variances = numbers[:, ::3] + LEAST_VARIANCE
    correlation = numbers[:, 1:2] * variances.prod(-1, keepdim=True).rsqrt()
    return (variances * per_variance).log(), correlation


LEAST_SAMPLES = 2
"""Number of measurements after which a track has a velocity."""
LEAST_VARIANCE = 1e-10
"""Added to variances before their logarithm is taken [m², m²/s²]."""


def convolve(features: Tensor, layer: Any) -> Tensor:
    """``layer`` applied to ``features`` (R, L, C) as a matrix product, which is faster for few rows and channels.

    The oldest step is repeated if needed so that the last window ends with the newest step.
    """
    size, stride = layer.kernel_size[0], layer.stride[0]
    if size == 1:
        return nn.functional.linear(features, layer.weight.squeeze(-1), layer.bias)
    length = features.shape[1]
    missing = size - length if length < size else (size - length) % stride
    if missing:
        features = torch.cat([features[:, :1].expand(-1, missing, -1), features], dim=1)
    seen = features.unfold(1, size, stride).flatten(2)
    return nn.functional.linear(seen, layer.weight.flatten(1), layer.bias)
