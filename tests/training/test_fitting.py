import pytest

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ETAConfig, ForecasterConfig
from torchdyn_plan.training import Fitting, Recipe
from torchdyn_plan.training.fitting import RECIPES


def make(horizon=300, **settings):
    return Fitting(forecaster=ForecasterConfig(horizon=horizon), eta=ETAConfig(), **settings)


@pytest.mark.parametrize(("horizon", "ahead"), [(300, (25, 100, 300)), (50, (4, 16, 50)), (2, (1, 2))])
def test_forecasts_are_scored_near_and_far_within_the_horizon(horizon, ahead):
    assert make(horizon).ahead == ahead
    assert make(horizon, ahead=(2,)).ahead == (2,)


@pytest.mark.parametrize(
    "settings",
    [
        {"ahead": (25, 301)},
        {"ahead": (0,)},
        {"fast": -1.0},
        {"recipes": {"etta": Recipe(steps=1, batch=1, lr=1.0)}},
        {"near": float("nan")},
    ],
)
def test_what_cannot_be_scored_is_named(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        make(**settings)


def test_a_network_is_fitted_as_its_task_says_or_as_all_are():
    own = Recipe(steps=3, batch=4, lr=0.1)
    fitting = make(recipes={"eta": own})
    assert fitting.recipe("eta") is own
    assert fitting.recipe("forecaster") is RECIPES["forecaster"]
