"""Two forecasters of the same targets, of which the noise of what is measured chooses one."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.nets.forecast import Forecast, ForecastModel

LEAST_NOISE = 5e-4
"""Standard deviation from which on a measurement counts as noisy [m]."""


class ForecastByNoise(ForecastModel):
    """Forecasts targets that are seen exactly; and holds another forecaster for those measured with noise.

    A `torchdyn_plan.planners.TrackedPlanner` takes the one for the noise of its track.
    """

    def __init__(self, exact: ForecastModel, noisy: ForecastModel, *, least_noise: float = LEAST_NOISE) -> None:
        """Hold both.

        Args:
            exact: forecasts, and does so alone wherever nobody asks for another.
            noisy: for targets that a track sees.
            least_noise: standard deviation of a measurement's error along each axis from which on it is taken [m].
        """
        super().__init__()
        check_number("least_noise", least_noise, minimum=0.0)
        self.exact, self.noisy, self.least_noise = exact, noisy, least_noise
        self.in_keys, self.history, self.samples = exact.in_keys, exact.history, exact.samples

    @property
    def chosen(self) -> ForecastModel:
        """The one that forecasts."""
        return self.exact.chosen

    def predict(self, *seen: Tensor) -> Forecast:
        """As of the one for targets that are seen exactly."""
        return self.exact.predict(*seen)

    def for_noise(self, noise: float) -> ForecastModel:
        """The forecaster for measurements of standard deviation ``noise`` [m]."""
        return self.noisy if noise >= self.least_noise else self

    def for_inference(self) -> ForecastModel:
        """Both in as few operations as possible."""
        return type(self)(self.exact.for_inference(), self.noisy.for_inference(), least_noise=self.least_noise)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        return {name: getattr(self, name) for name in ("exact", "noisy", "least_noise")}
