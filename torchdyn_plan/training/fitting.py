"""What the fits of a task's networks need to know about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torch import Tensor

from torchdyn_plan.checks import check_choice, check_number
from torchdyn_plan.nets.eta import ETAConfig
from torchdyn_plan.nets.forecaster import ForecasterConfig
from torchdyn_plan.planners import Lost
from torchdyn_plan.tasks.task import NOISY
from torchdyn_plan.training.arrival_data import Arrivals
from torchdyn_plan.training.metrics import FAST, NEAR, arrival_groups
from torchdyn_plan.training.optimise import Recipe
from torchdyn_plan.training.sighted_data import Sighting
from torchdyn_plan.training.windows import WindowConfig, Windows

RECIPES = {
    "forecaster": Recipe(steps=20_000, batch=512, lr=2e-3),
    "eta": Recipe(steps=64_000, batch=1024, lr=2e-3),
    "spread": Recipe(steps=3_000, batch=256, lr=2e-3, validations=8),
}
"""How each network is fitted where its task does not say otherwise."""


class ExtraCoverage(NamedTuple):
    """Windows of targets that move otherwise than those in the data, to see whether a spread still covers them."""

    caption: str
    """Of the table."""
    windows: Sequence[tuple[dict[str, Any], Windows]]
    """Windows, and the first columns of the rows of the table that tell of them."""


def _every_arrival(held: Arrivals) -> dict[str, Tensor]:
    return arrival_groups(held.arrival)


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """Sizes of a task's networks, and how they are scored."""

    forecaster: ForecasterConfig
    """Of the forecaster, unless another is asked for."""
    eta: ETAConfig = field(default_factory=ETAConfig)
    """Of the arrival-time network, unless another is asked for."""
    noisy_forecaster: ForecasterConfig | None = None
    """Of a second forecaster, for targets that are measured with noise and seen by a track; None for none."""
    sighting: Sighting = field(default_factory=Sighting)
    """How that one sees the recorded paths."""
    spread: bool = False
    """Whether a spread can be fitted to the forecaster's errors; its sizes are the forecaster's."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """How windows are drawn from paths; history and horizon are the forecaster's."""
    ahead: tuple[int, ...] = ()
    """Control steps ahead at which forecasts are scored; for none a twelfth, a third and all of the horizon."""
    fast: float = FAST
    """Motion from which a target is fast [m a step]."""
    near: float = NEAR
    """Distance along both level axes within which a robot that waits has the target [m]: a spread is scored by it."""
    lost: Lost | None = None
    """When a target is lost, which is scored too; None if it cannot be."""
    recipes: Mapping[str, Recipe] = field(default_factory=dict)
    """How networks are fitted, by name, where it is not as in `RECIPES`."""
    groups: Callable[[Arrivals], dict[str, Tensor]] = _every_arrival
    """Masks ``(n,)`` of the arrivals that are scored together."""
    extra_coverage: Callable[[WindowConfig], ExtraCoverage] | None = None
    """Makes further windows on which a spread is scored."""

    def recipe(self, network: str) -> Recipe:
        """How the network of that name is fitted."""
        return self.recipes.get(network, RECIPES[network.removeprefix(NOISY)])

    def __post_init__(self) -> None:
        for network in self.recipes:
            check_choice("network of recipes", network, RECIPES)
        check_number("fast", self.fast, minimum=0.0)
        check_number("near", self.near, minimum=0.0)
        horizon = self.forecaster.horizon
        if not self.ahead:
            # Frozen, but for what is left to the forecaster.
            object.__setattr__(self, "ahead", tuple(sorted({max(1, horizon // share) for share in (12, 3, 1)})))
        for steps in self.ahead:
            check_number("ahead", steps, minimum=1, maximum=horizon, integer=True)
