"""Distribution of a forecast's error at each future step, predicted from the forecaster's features."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_number, network_input
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.distributions import Spread
from torchdyn_plan.nets.forecast import DescribedForecast, Forecast, ForecastModel
from torchdyn_plan.nets.forecaster import Forecaster
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.precision import autocast_is_on, in_type_of, without_autocast

LOG_SCALE, LOG_SHAPE = (-18.0, 4.0), (-3.0, 3.0)
"""Least and greatest logarithm of a spread's scale [m] and of its shape."""


@dataclass(frozen=True, kw_only=True)
class SpreadConfig:
    """Sizes of a `SpreadNetwork`."""

    features: int = 384
    """Width of the forecaster's hidden layer."""
    horizon: int = 300
    """Steps F, as many as the forecaster emits."""
    hidden: int = 128
    """Width of the layer between features and head."""
    rank: int = 24
    """Rank of the head."""
    finest: float = 1e-5
    """Added to every error before its logarithm is taken, so that smaller errors are not distinguished [m]."""
    tracked: bool = False
    """Whether its forecaster is ``tracked``."""

    def __post_init__(self) -> None:
        for name in ("features", "horizon", "hidden", "rank"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_number("finest", self.finest, minimum=1e-9)


class SpreadNetwork(Pretrained, nn.Module):
    """Adds a spread to a `Forecaster`; the forecast positions do not change.

    One hidden layer and a linear head of low rank on the forecaster's last hidden layer.
    """

    kind = "spread"
    config_type = SpreadConfig

    def __init__(self, config: SpreadConfig | None = None, **settings: Any) -> None:
        """Build the network from ``config``, or from the fields of `SpreadConfig` given as keywords."""
        super().__init__()
        self.config = config = config or SpreadConfig(**settings)
        self.hidden = nn.Linear(config.features, config.hidden)
        self.mix = nn.Linear(config.hidden, config.rank)
        self.head = nn.Linear(config.rank, 5 * config.horizon)
        self.head.weight.data.mul_(0.1)
        with torch.no_grad():
            bias = self.head.bias.view(5, config.horizon)
            ahead = torch.arange(1.0, config.horizon + 1.0)
            bias[:2] = (1e-5 * ahead).log()
            bias[2:] = torch.tensor([0.0, 0.0, -4.0]).unsqueeze(-1)

    def forward(self, features: Tensor, swapped: Tensor) -> Spread:
        """Spread of the forecasts, from the outputs of `Forecaster.describe`; of their type, in float32 at least.

        Args:
            features: ``(*B, features)``.
            swapped: ``(*B,)`` bool: x and y are swapped.

        Raises:
            InputError: a shape or a device is wrong.
        """
        log_scale, log_shape, gone = self.raw(features, swapped)
        return Spread(log_scale.exp(), log_shape.exp(), gone.sigmoid())

    def raw(self, features: Tensor, swapped: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logarithms of scale and shape (*B, F, 2) and the logit of ``gone`` (*B, F), as used by the training loss."""
        weight = self.head.weight
        if autocast_is_on():
            return without_autocast(self.raw, features, swapped)
        about: Any = {"like": weight, "owner": type(self).__name__, "finite": False}
        seen = network_input("features", features, self.config.features, **about)
        if swapped.shape != features.shape[:-1] or swapped.dtype != torch.bool:
            expected = f"bool of shape {tuple(features.shape[:-1])}"
            raise InputError(f"swapped must be {expected}, got {swapped.dtype} of shape {tuple(swapped.shape)}")
        out = in_type_of(features, self.head(self.mix(self.hidden(seen).relu())))
        out = out.view(*features.shape[:-1], 5, self.config.horizon)
        level = out[..., :4, :].unflatten(-2, (2, 2)).transpose(-1, -2)
        level = torch.where(swapped[..., None, None, None], level.flip(-1), level)
        scale, shape = level.unbind(-3)
        return scale.clamp(*LOG_SCALE), shape.clamp(*LOG_SHAPE), out[..., 4, :]


class SpreadForecaster(ForecastModel):
    """A forecaster with the spread of its error."""

    def __init__(self, forecaster: DescribedForecast, spread: SpreadNetwork) -> None:
        """Combine ``forecaster`` with ``spread``, which was fitted to its errors."""
        super().__init__()
        if not isinstance(spread, SpreadNetwork):
            raise InputError(f"spread is {type(spread).__name__}, expected a SpreadNetwork")
        self.forecaster, self.spread, self.history = forecaster, spread, forecaster.history
        self.in_keys, self.samples = forecaster.in_keys, forecaster.samples

    def predict(self, *seen: Tensor) -> Forecast:
        """Path and spread."""
        path, features, swapped = self.forecaster.describe(*seen)
        return Forecast(path, self.spread(features, swapped))

    def for_inference(self) -> ForecastModel:
        """A copy for inference with the current weights, in fewer operations; it does not follow later training."""
        from torchdyn_plan.nets.inference import InferenceForecaster

        if not isinstance(self.forecaster, Forecaster):
            return self
        return InferenceForecaster(self.forecaster, self.spread)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        return {"forecaster": self.forecaster, "spread": self.spread}
