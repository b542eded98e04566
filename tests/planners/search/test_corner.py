import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Arrival, Forecast
from torchdyn_plan.planners import CornerSearch, search_corners


def table(first, corners, never_here=False, never=(False,) * 4):
    """An arrival predictor that answers ``first`` for one goal, ``corners`` for four, and keeps the questions."""
    asked = []

    def eta(goals):
        asked.append(goals)
        if goals.shape[-2] == 1:
            steps, no = torch.tensor([float(first)]), torch.tensor([never_here])
        else:
            steps, no = torch.tensor([float(s) for s in corners]), torch.tensor(never)
        shape = goals.shape[:-1]
        return Arrival(steps.to(goals.dtype).expand(shape), no.expand(shape))

    return eta, asked


def line(horizon=10, step=1.0):
    """A target that was at the origin and goes along x, one unit a control step."""
    forecast = torch.zeros(horizon, 3)
    forecast[:, 0] = step * torch.arange(1, horizon + 1)
    return forecast, torch.zeros(3)


def test_a_case_worked_by_hand():
    # e_t = 2, so d = 2 and the corners are (2,2) (2,-2) (-2,-2) (-2,2), where the target is at x = e_i.
    # Distances for e = 5, 2, 0, 9: |(3,2)|, |(0,2)| = 2, |(2,2)|, |(11,2)|: the second wins.
    forecast, here = line()
    eta, asked = table(2, [5, 2, 0, 9])
    result = search_corners(forecast, here, eta)
    assert [tuple(goals.shape) for goals in asked] == [(1, 3), (4, 3)]
    assert asked[1].tolist() == [[2, 2, 0], [2, -2, 0], [-2, -2, 0], [-2, 2, 0]]
    assert result.goal.tolist() == [2, 0, 0]
    assert int(result.arrival_steps) == 2
    assert not bool(result.clamped)
    assert bool(result.reachable)


def test_meeting_now_is_where_the_target_is_and_in_one_step_the_first_entry():
    forecast, here = line()
    for steps in (0, 1, 10):
        result = search_corners(forecast, here, table(0, [steps] * 4)[0])
        assert result.goal.tolist() == [steps, 0, 0]
        assert int(result.arrival_steps) == steps
        assert not bool(result.clamped)


def test_times_beyond_the_horizon_are_cut_and_reported():
    forecast, here = line()
    corner_late = search_corners(forecast, here, table(0, [11] * 4)[0])
    here_late = search_corners(forecast, here, table(499, [3] * 4)[0])
    assert corner_late.goal.tolist() == [10, 0, 0]
    assert int(corner_late.arrival_steps) == 10
    assert bool(corner_late.clamped)
    assert bool(here_late.clamped)
    # A corner that lost does not count.
    assert not bool(search_corners(forecast, here, table(1, [499, 1, 499, 499])[0]).clamped)


def test_corners_never_reached_are_passed_over():
    forecast, here = line()
    result = search_corners(forecast, here, table(2, [5, 2, 0, 9], never=(False, True, False, False))[0])
    assert int(result.arrival_steps) == 0
    assert bool(result.reachable)


def test_never_anywhere_still_gives_the_nearest_goal():
    forecast, here = line()
    result = search_corners(forecast, here, table(2, [5, 2, 0, 9], never=(True,) * 4)[0])
    assert result.goal.tolist() == [2, 0, 0]
    assert not bool(result.reachable)


def test_a_target_out_of_reach_now_takes_its_square_from_the_likeliest_time_all_the_same():
    forecast, here = line()
    eta, asked = table(7, [1] * 4, never_here=True)
    result = search_corners(forecast, here, eta)
    assert asked[1][0].tolist() == [7, 7, 0]
    assert bool(result.reachable)
    assert not bool(result.clamped)


def test_the_first_of_equal_corners_wins():
    forecast = torch.zeros(5, 3)
    assert int(search_corners(forecast, torch.zeros(3), table(1, [3, 1, 4, 2])[0]).arrival_steps) == 3


def test_the_distance_counts_height():
    forecast = torch.zeros(5, 3)
    forecast[:, 2] = -torch.arange(1.0, 6.0)
    eta, asked = table(3, [1, 2, 3, 4])
    search_corners(forecast, torch.zeros(3), eta)
    assert asked[1][0].tolist() == [3, 3, 0]


def moving_arrival(goals):
    """A robot at (1, -2, 0) that never goes beyond x = 3."""
    steps = 4 * (goals - goals.new_tensor([1.0, -2.0, 0.0])).norm(dim=-1)
    return Arrival(steps, goals[..., 0] > 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3, 4)])
def test_a_batch_is_a_loop_over_its_rows(batch, dtype):
    generator = torch.Generator().manual_seed(3)
    forecast = torch.randn(*batch, 12, 3, generator=generator, dtype=dtype).cumsum(-2)
    here = torch.randn(*batch, 3, generator=generator, dtype=dtype)
    result = search_corners(forecast, here, moving_arrival)
    assert result.goal.dtype == dtype
    assert [x.shape for x in result] == [(*batch, 3), batch, batch, batch]
    rows = zip(forecast.reshape(-1, 12, 3), here.reshape(-1, 3), strict=True)
    for row, (f, p) in enumerate(rows):
        alone = search_corners(f, p, moving_arrival)
        for whole, single in zip(result, alone, strict=True):
            assert torch.equal(whole.reshape(-1, *single.shape)[row], single)


def naive(forecast, here, eta):
    """The paper's text, one row, one goal at a time."""
    at = [here, *forecast]
    last = len(forecast)

    def ask(goal):
        arrival = eta(goal.view(1, 3))
        return min(round(float(arrival.steps)), last), bool(arrival.never)

    steps, never = ask(here)
    d = float((at[last if never else steps] - here).norm())
    corners = [here + torch.tensor(c) * d for c in ((1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0))]
    asked = [ask(c) for c in corners]
    usable = [i for i in range(4) if not asked[i][1]] or list(range(4))
    best = min(usable, key=lambda i: float((corners[i] - at[asked[i][0]]).norm()))
    return at[asked[best][0]], asked[best][0]


def test_agrees_with_the_papers_text():
    generator = torch.Generator().manual_seed(5)
    forecast = torch.randn(50, 12, 3, generator=generator).cumsum(-2) * 0.5
    here = torch.randn(50, 3, generator=generator)
    result = search_corners(forecast, here, moving_arrival)
    assert len(result.arrival_steps.unique()) > 4
    for row in range(50):
        goal, steps = naive(forecast[row], here[row], moving_arrival)
        assert torch.equal(result.goal[row], goal)
        assert int(result.arrival_steps[row]) == steps


def test_the_goal_carries_the_gradient_of_the_forecast():
    forecast, here = line()
    forecast.requires_grad_()
    search_corners(forecast, here, table(2, [5, 2, 0, 9])[0]).goal.sum().backward()
    expected = torch.zeros(10, 3)
    expected[1] = 1.0
    assert torch.equal(forecast.grad, expected)


def test_corner_search_hands_its_estimator_on():
    estimators = []

    def eta(goals, *, estimator):
        estimators.append(estimator)
        return moving_arrival(goals)

    forecast, here = line()
    CornerSearch(estimator="expectation")(Forecast(forecast), here, eta)
    assert estimators == ["expectation"] * 2
    with pytest.raises(InputError, match=r"estimator 'mod'.*did you mean 'mode'"):
        CornerSearch(estimator="mod")


@pytest.mark.parametrize(("forecast", "here"), [((5, 2), (3,)), ((5, 3), (2,)), ((3,), (3,)), ((2, 5, 3), (4, 3))])
def test_wrong_shapes_are_named(forecast, here):
    with pytest.raises(InputError, match=r"must have shape"):
        search_corners(torch.zeros(forecast), torch.zeros(here), moving_arrival)
