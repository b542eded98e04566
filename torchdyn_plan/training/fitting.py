"""What a task defines for the fits of its networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torch import Tensor

from torchdyn_plan.checks import check_choice, check_number
from torchdyn_plan.nets.capture import CaptureConfig
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
    "capture": Recipe(steps=8_000, batch=512, lr=3e-3, weight_decay=5e-2, validations=8),
    "spread": Recipe(steps=3_000, batch=256, lr=2e-3, validations=8),
}
"""Default recipe of each network."""


class ExtraCoverage(NamedTuple):
    """Windows of targets that move differently from the training data, to test a spread's coverage."""

    caption: str
    """Caption of the table."""
    windows: Sequence[tuple[dict[str, Any], Windows]]
    """Windows, with the first columns of their rows in the table."""


def _every_arrival(held: Arrivals) -> dict[str, Tensor]:
    return arrival_groups(held.arrival)


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """Sizes of a task's networks, and how they are fitted and scored."""

    forecaster: ForecasterConfig
    """Default configuration of the forecaster."""
    eta: ETAConfig = field(default_factory=ETAConfig)
    """Default configuration of the arrival-time network."""
    capture: CaptureConfig | None = None
    """Default configuration of the network of captures; None for none."""
    noisy_forecaster: ForecasterConfig | None = None
    """Configuration of a second forecaster, for noisy measurements seen through a track; None for none."""
    sighting: Sighting = field(default_factory=Sighting)
    """How the second forecaster sees the recorded paths."""
    spread: bool = False
    """Whether a spread can be fitted to the forecaster's errors; its sizes are the forecaster's."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """How windows are drawn from paths; history and horizon are the forecaster's."""
    ahead: tuple[int, ...] = ()
    """Control steps ahead at which forecasts are scored; if empty, a twelfth, a third and all of the horizon."""
    fast: float = FAST
    """Speed from which a target is fast [m a step]."""
    near: float = NEAR
    """Distance along both horizontal axes within which a waiting robot has the target [m]; used to score a spread."""
    lost: Lost | None = None
    """Decides when a target is lost, which is also scored; None if targets cannot be lost."""
    recipes: Mapping[str, Recipe] = field(default_factory=dict)
    """Recipes by network that replace those in `RECIPES`."""
    groups: Callable[[Arrivals], dict[str, Tensor]] = _every_arrival
    """Masks ``(n,)`` of the arrivals that are scored together."""
    extra_coverage: Callable[[WindowConfig], ExtraCoverage] | None = None
    """Makes further windows on which a spread is scored."""

    def recipe(self, network: str) -> Recipe:
        """How the network of that name is fitted; one for noisy measurements like the other of its kind."""
        kind = network.removeprefix(NOISY)
        return self.recipes.get(kind, RECIPES[kind])

    def __post_init__(self) -> None:
        for network in self.recipes:
            check_choice("network of recipes", network, RECIPES)
        check_number("fast", self.fast, minimum=0.0)
        check_number("near", self.near, minimum=0.0)
        horizon = self.forecaster.horizon
        if not self.ahead:
            # Frozen dataclass; only fields left to the forecaster are set here.
            object.__setattr__(self, "ahead", tuple(sorted({max(1, horizon // share) for share in (12, 3, 1)})))
        for steps in self.ahead:
            check_number("ahead", steps, minimum=1, maximum=horizon, integer=True)
