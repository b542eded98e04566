"""Two forecasters of the same targets, selected by the measurement noise."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.nets.forecast import Forecast, ForecastModel

LEAST_NOISE = 5e-4
"""Standard deviation from which a measurement counts as noisy [m]."""


class ForecastByNoise(ForecastModel):
    """Forecasts exactly observed targets, and holds another forecaster for noisy measurements.

    A `torchdyn_plan.planners.TrackedPlanner` selects the one for its track's noise.
    """

    def __init__(self, exact: ForecastModel, noisy: ForecastModel, *, least_noise: float = LEAST_NOISE) -> None:
        """Hold both.

        Args:
            exact: the default forecaster.
            noisy: forecaster for targets seen through a track.
            least_noise: standard deviation of the measurement error along each axis from which ``noisy`` is used [m].
        """
        super().__init__()
        check_number("least_noise", least_noise, minimum=0.0)
        self.exact, self.noisy, self.least_noise = exact, noisy, least_noise
        self.in_keys, self.history, self.samples = exact.in_keys, exact.history, exact.samples

    @property
    def chosen(self) -> ForecastModel:
        """The forecaster in use."""
        return self.exact.chosen

    def predict(self, *seen: Tensor) -> Forecast:
        """The forecast of ``exact``."""
        return self.exact.predict(*seen)

    def for_noise(self, noise: float) -> ForecastModel:
        """The forecaster for measurements of standard deviation ``noise`` [m]."""
        return self.noisy if noise >= self.least_noise else self

    def for_inference(self) -> ForecastModel:
        """Both forecasters prepared for inference, in as few operations as possible."""
        return type(self)(self.exact.for_inference(), self.noisy.for_inference(), least_noise=self.least_noise)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        return {name: getattr(self, name) for name in ("exact", "noisy", "least_noise")}
