"""A sensor model of the target's position in six numbers. Imports nothing heavy."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

LOWEST_RATE, HIGHEST_RATE = 1.0, 10_000.0
"""Allowed range of a sensor's rate [Hz]."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """How an environment measures its target; by default exactly, at every control step, without delay.

    Measurement n is taken about n / ``rate`` seconds after the reset, and arrives ``latency`` seconds later. The first
    one is available at the reset and never lost.
    """

    rate: float | None = None
    """Measurements a second [Hz]; one at each control step for None."""
    noise: float = 0.0
    """Standard deviation of a measurement's error along each axis [m]."""
    latency: float = 0.0
    """Time from a measurement to its arrival [s]."""
    jitter: float = 0.0
    """Standard deviation of the time at which a measurement is taken [s]."""
    dropout: float = 0.0
    """Share of the measurements that are lost."""
    quantisation: float = 0.0
    """Measurements are rounded to multiples of this along each axis [m]; 0 for no rounding."""

    def __post_init__(self) -> None:
        from torchdyn_plan.checks import check_number

        if self.rate is not None:
            check_number("rate", self.rate, minimum=LOWEST_RATE, maximum=HIGHEST_RATE)
        for name in ("noise", "latency", "jitter", "quantisation"):
            check_number(name, getattr(self, name), minimum=0.0, maximum=10.0)
        check_number("dropout", self.dropout, minimum=0.0, maximum=1.0)

    @property
    def is_exact(self) -> bool:
        """Whether it reports the true position at every control step."""
        return self == type(self)()

    @property
    def deviation(self) -> float:
        """Standard deviation of a measurement along each axis, including quantisation [m]."""
        # The rounding error is uniform within half a step.
        return math.hypot(self.noise, self.quantisation / math.sqrt(12.0))

    def slots(self, control_step: float) -> int:
        """Most measurements that can arrive within a control step [s]; if jitter brings more, the first are lost."""
        regular = math.ceil(control_step * (self.rate or 1.0 / control_step) - 1e-9)
        return max(regular, 1) + (3 if self.jitter else 0)

    def told(self) -> dict[str, float | None]:
        """Its settings by name, to be stored in files."""
        return dataclasses.asdict(self)
