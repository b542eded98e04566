"""Forecasts of a target's path with their uncertainty, and the interface of models that make them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError

if TYPE_CHECKING:
    from torchdyn_plan.nets.distributions import Spread

Symmetry = TypeVar("Symmetry")


class Forecast(NamedTuple):
    """Where the target will be."""

    path: Tensor
    """``(*B, F, D)`` [m, world]: entry e-1 is the position in e control steps."""
    spread: Spread | None = None
    """Distribution of the path's error; None if the model has none."""

    def after(self, steps: int) -> Forecast:
        """The forecast counted from ``steps`` control steps later; raises `InputError` if it does not reach so far."""
        if steps == 0:
            return self
        horizon = self.path.shape[-2]
        if steps >= horizon:
            raise InputError(f"delay must be below the forecast's {horizon} steps, got {steps}")
        return Forecast(self.path[..., steps:, :], None if self.spread is None else self.spread.after(steps))


class ForecastModel(nn.Module, ABC):
    """Forecasts a target's path from the keys ``in_keys`` of the observation, by default the target's history."""

    in_keys: Sequence[Any] = (keys.TARGET_HISTORY,)
    history: int | None = None
    """Length H of the history it reads; None for any length."""
    samples: int | None = None
    """Number of measurements by a track from which its forecasts are usable; None if unknown."""

    @abstractmethod
    def predict(self, *seen: Tensor) -> Forecast:
        """Forecast from the values of ``in_keys``, ``(*B, …)`` each."""

    @property
    def chosen(self) -> ForecastModel:
        """The model that makes the forecasts; by default the model itself."""
        return self

    def for_noise(self, noise: float) -> ForecastModel:
        """The model for targets tracked from measurements of standard deviation ``noise`` [m]; by default itself."""
        return self

    def for_inference(self) -> ForecastModel:
        """The same function in as few operations as possible; by default the model itself."""
        return self


class FunctionForecast(ForecastModel):
    """A function as a forecast model."""

    def __init__(self, function: Callable[..., Any], *, in_keys: Sequence[Any] = (keys.TARGET_HISTORY,)) -> None:
        """Wrap ``function`` (or an `nn.Module`): the values of ``in_keys`` to a path (*B, F, D) or a `Forecast`."""
        super().__init__()
        self.function, self.in_keys = function, tuple(in_keys)

    @classmethod
    def wrap(cls, model: Any) -> ForecastModel:
        """``model`` if it is a forecast model, else the function that it must be; raises `InputError`."""
        if isinstance(model, ForecastModel):
            return model
        if not callable(model):
            raise InputError(f"forecaster must be a ForecastModel or a function of the history, got {model!r}")
        return cls(model)

    def predict(self, *seen: Tensor) -> Forecast:
        """The function's result."""
        found = self.function(*seen)
        return found if isinstance(found, Forecast) else Forecast(found)


class DescribedForecast(ForecastModel):
    """A forecast model that also returns its features, from which the spread of its errors is predicted."""

    @abstractmethod
    def forward(self, target_history: Tensor, target_covariance: Tensor | None = None) -> Tensor:
        """Positions at the next F control steps, ``(*B, F, D)`` [m, world], after histories ``(*B, H, D)``.

        ``target_covariance`` (*B, 2, 2) is read by models whose ``in_keys`` have it [m², m²/s; m²/s, m²/s²].
        """

    @abstractmethod
    def describe(
        self, target_history: Tensor, target_covariance: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same positions, the features (*B, hidden) behind them, and whether x and y are swapped in these (*B,)."""

    def predict(self, *seen: Tensor) -> Forecast:
        """The path alone."""
        return Forecast(self(*seen))


def in_plane(
    forecast: Callable[..., tuple[Tensor, Tensor, Symmetry]], target_history: Tensor, *beside: Any
) -> tuple[Tensor, Tensor, Symmetry]:
    """Result of ``forecast`` for histories (*B, H, 2) taken at height 0, and the further inputs ``beside``.

    Its path, the first entry, is reduced to x and y.
    """
    path, hidden, symmetry = forecast(nn.functional.pad(target_history, (0, 1)), *beside)
    return path[..., :2], hidden, symmetry
