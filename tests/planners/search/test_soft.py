import math

import pytest
import torch

from tests.planners.search.test_exact import POCKETED, flight, meet
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Arrival, ETANetwork, Forecast, Forecaster, FunctionArrival
from torchdyn_plan.planners import (
    CornerSearch,
    DynamicPlanner,
    ExactSearch,
    Observation,
    Plan,
    SoftCornerSearch,
    SoftExactSearch,
)
from torchdyn_plan.planners.search.soft import between

SEARCHES = [SoftExactSearch(), SoftCornerSearch()]


def robot(tool, speed=0.012, reach=0.8):
    """Distance / speed from tool places (*B, 3); sure to arrive well within ``reach``, sure not to well beyond it."""

    def eta(goals, *, estimator):
        steps = (goals - tool.unsqueeze(-2)).norm(dim=-1) / speed
        never = torch.sigmoid((goals.norm(dim=-1) - reach) / 0.02)
        return Arrival(steps, never if estimator == "soft" else never > 0.5)

    return eta


def scenes(count, horizon=120, dtype=torch.float64, seed=0):
    """Targets on smooth curves about the table, and tool places: forecast, target now, tool."""
    draw = torch.Generator().manual_seed(seed)
    here, velocity, bend, tool = (torch.rand(4, count, 1, 3, generator=draw, dtype=dtype) - 0.5).unbind(0)
    ahead = torch.arange(horizon + 1, dtype=dtype).unsqueeze(-1)
    path = here + 0.016 * velocity * ahead + 4e-5 * bend * ahead.square()
    path[..., 2], tool[..., 2] = 0.04, 0.04
    return path[:, 1:], path[:, 0], tool.squeeze(1)


@pytest.mark.parametrize(
    "hard", [ExactSearch(), ExactSearch(stride=2, height=0.1, half_extent=0.6, descent_steps=3, margin=4)]
)
def test_the_soft_exact_search_tends_to_the_hard_one(hard):
    forecast, here, tool = scenes(200)
    expected = meet(hard, forecast, here, robot(tool))
    assert 40 < expected.reachable.sum() < 200
    errors = []
    for temperature in (8.0, 2.0, 0.5, 0.1, 0.02):
        soft = meet(SoftExactSearch(search=hard, temperature=temperature), forecast, here, robot(tool))
        errors.append(float((soft.arrival_steps - expected.arrival_steps).abs().mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.2
    assert (soft.reachable == expected.reachable).double().mean() > 0.98
    assert (soft.goal - expected.goal).norm(dim=-1).median() < 1e-6


def test_the_soft_exact_search_tends_to_the_hard_one_that_weighs_dwelling():
    forecast, here, tool = scenes(100)
    hard = ExactSearch(
        height=0.1, half_extent=0.6, descent_steps=3.0, footprint=0.05, longest_dwell=12, waiting_cost=0.01
    )
    expected = meet(hard, forecast, here, robot(tool))
    soft = meet(SoftExactSearch(search=hard, temperature=0.02), forecast, here, robot(tool))
    assert (soft.arrival_steps - expected.arrival_steps).abs().quantile(0.9) < 0.1


def test_the_soft_corner_search_tends_to_the_hard_one_between_steps():
    forecast, here, tool = scenes(200)
    expected = meet(CornerSearch(estimator="expectation"), forecast, here, robot(tool))
    errors = []
    for temperature in (0.4, 0.1, 0.02, 0.001):
        soft = meet(SoftCornerSearch(temperature=temperature), forecast, here, robot(tool))
        errors.append(float((soft.arrival_steps - expected.arrival_steps)[expected.reachable].abs().quantile(0.8)))
    assert errors == sorted(errors, reverse=True)
    # Half a step is what the hard search rounds by.
    assert errors[-1] < 0.5
    assert torch.equal(soft.clamped, expected.clamped)


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_a_batch_is_a_loop_over_its_rows(search, batch):
    forecast, here, tool = (value.reshape(*batch, *value.shape[1:]) for value in scenes(math.prod(batch)))
    found = meet(search, forecast, here, robot(tool))
    assert [value.shape for value in found] == [(*batch, 3), batch, batch, batch]
    rows = zip(forecast.reshape(-1, 120, 3), here.reshape(-1, 3), tool.reshape(-1, 3), strict=True)
    for row, (f, h, t) in enumerate(rows):
        alone = meet(search, f, h, robot(t))
        for whole, single in zip(found, alone, strict=True):
            torch.testing.assert_close(whole.reshape(-1, *single.shape)[row], single)


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("mirror", [(-1, 1, 1), (1, -1, 1), (-1, -1, 1)])
def test_a_mirrored_scene_has_mirrored_goals(search, mirror):
    mirror = torch.tensor(mirror, dtype=torch.float64)
    forecast, here, tool = scenes(40)
    one, other = (
        meet(search, forecast, here, robot(tool)),
        meet(search, forecast * mirror, here * mirror, robot(tool * mirror)),
    )
    torch.testing.assert_close(one.goal * mirror, other.goal)
    torch.testing.assert_close(one.arrival_steps, other.arrival_steps)


@pytest.mark.parametrize("search", SEARCHES)
def test_gradients_match_differences(search):
    inputs = [value.requires_grad_() for value in scenes(3, horizon=20)]
    # The last is so far away that nothing is in time, and some corners lie beyond the horizon.
    inputs[2].data[2] += 1.0

    def meeting(forecast, here, tool):
        return meet(search, forecast, here, robot(tool))[:2]

    assert torch.autograd.gradcheck(meeting, inputs, eps=1e-7, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("heat", [100.0, 1.0, 0.01])
@pytest.mark.parametrize("search", [SoftExactSearch, SoftCornerSearch])
def test_gradients_are_finite_at_every_edge(search, heat):
    forecast, here, tool = scenes(6, horizon=20, dtype=torch.float32)
    forecast[1] = here[1].unsqueeze(0)  # at rest
    tool[2] = here[2]  # already there
    forecast[3, 5:, 2] = -1.0  # in a pocket
    forecast[4] = forecast[4] + 100.0  # out of reach for ever
    tool[5] = tool[5] + 50.0  # late everywhere
    inputs = [value.requires_grad_() for value in (forecast, here, tool)]
    found = meet(search(temperature=heat), forecast, here, robot(tool))
    (found.goal.sum() + found.arrival_steps.sum()).backward()
    assert all(bool(value.grad.isfinite().all()) for value in inputs if value.grad is not None)
    # At the lowest temperature nothing but the best is left, and no gradient.
    assert bool(tool.grad.any()) or heat < 1.0
    assert bool(found.goal.isfinite().all())


@pytest.mark.parametrize("search", SEARCHES)
def test_gradients_reach_history_networks_and_robot_state(search):
    torch.manual_seed(0)
    forecaster, eta = Forecaster(square_symmetry=True, half_extent=0.75, hidden=32), ETANetwork(hidden=32)
    planner = DynamicPlanner(lambda td: td, forecaster, eta, search=search, lost=POCKETED)
    state = torch.rand(4, 15, requires_grad=True)
    history = (torch.rand(4, 1, 3) - 0.5 + 0.01 * torch.rand(4, 24, 3).cumsum(1)).requires_grad_()
    tool = torch.rand(4, 3)
    observation = Observation(tool, history[:, -1], state, torch.full((4,), 13), (history,))
    found = planner.replan(observation, Plan.hold(observation, 0))
    (found.goal.sum() + found.arrival_steps.sum()).backward()
    parameters = dict(planner.named_parameters())
    for name, value in {"state": state, "history": history, **parameters}.items():
        assert value.grad is not None, name
        assert bool(value.grad.isfinite().all()), name
        assert bool(value.grad.any()), name


@pytest.mark.parametrize("search", SEARCHES)
def test_heights_are_not_judged_where_nothing_is_lost(search):
    above, below = (search(Forecast(forecast), here, eta) for forecast, here, eta in map(flight, (0.3, -0.3)))
    torch.testing.assert_close(above.goal[:2], below.goal[:2])
    torch.testing.assert_close(above.arrival_steps, below.arrival_steps)
    assert bool(above.reachable) == bool(below.reachable) is True


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("reach", [0.0, 0.6])
def test_a_function_that_says_never_by_infinite_steps_leaves_goals_finite(search, reach):
    def steps(robot_state, goal):
        far = goal.norm(dim=-1)
        return (far / 0.01).masked_fill(far >= reach, torch.inf)

    forecast, here, tool = scenes(20)
    found = meet(search, forecast, here, FunctionArrival(steps).from_state(tool))
    assert bool(found.goal.isfinite().all())
    assert bool(found.arrival_steps.isfinite().all())
    assert bool(found.reachable.any()) == (reach > 0.0)


def test_between_steps_the_path_is_linear():
    path = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]], dtype=torch.float64)
    steps = torch.tensor([-1.0, 0.0, 0.25, 1.0, 1.5, 2.0, 9.0], dtype=torch.float64, requires_grad=True)
    places = between(path, steps)[:, 0]
    assert places.tolist() == [0, 0, 0.25, 1, 2, 3, 3]
    (slope,) = torch.autograd.grad(places.sum(), steps)
    assert slope.tolist()[2:5:2] == [1, 2]
    assert slope.tolist()[::6] == [0, 0]


@pytest.mark.parametrize("search", [SoftExactSearch, SoftCornerSearch])
def test_wrong_arguments_are_named(search):
    with pytest.raises(InputError, match=r"temperature.*0"):
        search(temperature=0.0)
    with pytest.raises(InputError, match="forecast must have shape"):
        meet(search(), torch.zeros(5, 2), torch.zeros(3), robot(torch.zeros(3)))
