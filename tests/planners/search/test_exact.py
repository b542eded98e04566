import dataclasses

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Arrival, Forecast
from torchdyn_plan.planners import ExactSearch, LostBelow, SearchContext

HEIGHT = 0.04
POCKETED = LostBelow(seen_below=-HEIGHT, forecast_below=0.0)


def meet(search, forecast, here, eta, *, lost=POCKETED, **known):
    """What ``search`` finds where targets below the table are lost; ``known`` is of its context."""
    return search(Forecast(forecast), here, eta, SearchContext(lost=lost, **known))


def robot(tool=(0.0, 0.0, HEIGHT), speed=0.01, reach=1.0):
    """A perfect arrival predictor, distance / speed, of a tool that stays within ``reach``; keeps the questions."""
    asked = []

    def eta(goals, *, estimator):
        asked.append((tuple(goals.shape), estimator))
        return Arrival((goals - goals.new_tensor(tool)).norm(dim=-1) / speed, goals.norm(dim=-1) > reach)

    return eta, asked


def line(start, velocity, horizon=200, dtype=torch.float32):
    """Forecast (horizon, 3) and present place of a target that goes straight on the table."""
    here = torch.tensor([*start, HEIGHT], dtype=dtype)
    ahead = torch.arange(1, horizon + 1, dtype=dtype)[:, None]
    return here + ahead * torch.tensor([*velocity, 0.0], dtype=dtype), here


def paths(*batch, horizon=90, dtype=torch.float32, seed=0):
    """Curved paths, some of which end in a pocket."""
    generator = torch.Generator().manual_seed(seed)
    path = 0.02 * torch.randn(*batch, horizon + 1, 3, generator=generator, dtype=dtype).cumsum(-2)
    path[..., 2] = path[..., 2] - path[..., 2].amin(-1, keepdim=True) - 0.02
    return path[..., 1:, :], path[..., 0, :]


FULL = ExactSearch(
    stride=3,
    height=0.1,
    half_extent=0.3,
    descent_steps=2.0,
    margin=4.0,
    footprint=0.04,
    longest_dwell=7,
    switching_cost=3.0,
    arrival_radius=0.05,
)


@pytest.mark.parametrize(
    ("start", "velocity"), [((0.9, 0.0), (-0.005, 0)), ((0.3, -0.5), (0, 0.006)), ((0.103, 0), (0, 0))]
)
@pytest.mark.parametrize("stride", [1, 5])
def test_the_first_meeting_is_found_within_the_stride_by_one_question(start, velocity, stride):
    forecast, here = line(start, velocity)
    eta, asked = robot()
    result = meet(ExactSearch(stride=stride), forecast, here, eta)
    first = next(
        t for t in range(1, 201) if float(forecast[t - 1].sub(torch.tensor([0, 0, HEIGHT])).norm()) <= 0.01 * t
    )
    steps = int(result.arrival_steps)
    assert first <= steps < first + stride
    assert torch.equal(result.goal, forecast[steps - 1])
    assert bool(result.reachable)
    assert asked == [((len(range(2, 201, stride)), 3), "expectation")]


@pytest.mark.parametrize("settings", [{"descent_steps": 10.0}, {"margin": 10.0}, {"descent_steps": 4.0, "margin": 6.0}])
def test_descent_and_margin_are_kept(settings):
    # From 0.9 at 0.005 a step to meet a tool of 0.01 a step: 0.9 - 0.005 t = 0.01 (t - 10), t = 66.7.
    forecast, here = line((0.9, 0.0), (-0.005, 0.0))
    assert int(meet(ExactSearch(stride=1, **settings), forecast, here, robot()[0]).arrival_steps) == 67


def test_out_of_reach_the_least_late_place_is_a_direction():
    forecast, here = line((0.2, 0.0), (0.02, 0.0), horizon=40)
    result = meet(ExactSearch(stride=1), forecast, here, robot()[0])
    assert not bool(result.reachable)
    assert int(result.arrival_steps) == 2
    nowhere = meet(ExactSearch(stride=1), forecast, here, robot(reach=0.0)[0])
    assert not bool(nowhere.reachable)
    assert torch.isfinite(nowhere.goal).all()


def flight(height):
    """Forecast and present place of a target that goes straight at ``height``, and a robot level with it."""
    forecast, here = line((-1.5, 1.0), (0.008, 0.0), horizon=300)
    up = torch.tensor([0.0, 0.0, height - HEIGHT])
    return forecast + up, here + up, robot(tool=(0.0, 0.0, height), reach=9.0)[0]


@pytest.mark.parametrize("search", [ExactSearch(), ExactSearch(footprint=0.05), ExactSearch(coarse=4), FULL])
def test_a_target_below_the_origin_is_met_as_one_above_where_nothing_is_lost(search):
    above, below = (search(Forecast(forecast), here, eta) for forecast, here, eta in map(flight, (0.3, -0.3)))
    assert bool(above.reachable) == bool(below.reachable) is (search is not FULL)
    assert int(above.arrival_steps) == int(below.arrival_steps)
    assert torch.equal(above.goal[:2], below.goal[:2])


@pytest.mark.parametrize("search", [ExactSearch(), ExactSearch(footprint=0.05)])
def test_what_is_lost_is_said_by_the_task(search):
    forecast, here, eta = flight(-0.3)
    # Over an edge, at step 150: later places are lost to a task that says so, and to no other.
    forecast[149:, 2] = -0.5
    late = dataclasses.replace(search, first=160)
    over_the_edge = LostBelow(seen_below=-0.45, forecast_below=-0.4)
    assert bool(meet(late, forecast, here, eta, lost=None).reachable)
    assert bool(meet(search, forecast, here, eta, lost=over_the_edge).reachable)
    assert not bool(meet(late, forecast, here, eta, lost=over_the_edge).reachable)
    assert not bool(meet(search, forecast, here, eta, lost=POCKETED).reachable)


@pytest.mark.parametrize("search", [ExactSearch(stride=1), ExactSearch(stride=1, footprint=0.05, waiting_cost=0.0)])
@pytest.mark.parametrize("reach", [1.0, 0.0])
def test_a_pocketed_target_is_never_chosen(search, reach):
    forecast, here = line((0.4, 0.0), (-0.003, 0.0))
    forecast[20:, 2] = -0.1
    result = meet(search, forecast, here, robot(reach=reach)[0])
    assert not bool(result.reachable)
    assert result.goal[2] > 0.0
    # The robot could be in time only where the ball lies in the pocket, and could get nowhere else at all.
    only_below = meet(
        search, forecast, here, lambda goals, estimator: Arrival(goals[..., 0] * 0.0, goals[..., 2] > 0.0)
    )
    assert not bool(only_below.reachable)
    assert only_below.goal[2] > 0.0


def test_the_longest_dwell_wins_where_waiting_costs_nothing_and_the_earliest_where_it_does():
    # At 0.02 a step, and half as fast from step 30 on: there it dwells twice as long.
    speed = torch.where(torch.arange(1, 101) < 30, 0.02, 0.01)
    forecast = torch.zeros(100, 3)
    forecast[:, 0], forecast[:, 2] = speed.cumsum(0) - 0.4, HEIGHT
    here = torch.tensor([-0.4, 0.0, HEIGHT])
    settings = {"stride": 1, "footprint": 0.045, "longest_dwell": 9}
    free = meet(ExactSearch(waiting_cost=0.0, **settings), forecast, here, robot(speed=0.1)[0])
    dear = meet(ExactSearch(waiting_cost=9.0, **settings), forecast, here, robot(speed=0.1)[0])
    # Nine places of 0.01 a step lie within 0.045 of each: the first such place is that of step 33, entered at 29.
    assert int(free.arrival_steps) == 29
    assert free.goal[0].item() == pytest.approx(forecast[32, 0].item())
    assert int(dear.arrival_steps) < 8


def test_the_first_of_equal_candidates_wins():
    forecast, here = line((0.1, 0.0), (0.0, 0.0), horizon=60)
    assert int(meet(ExactSearch(waiting_cost=0.0), forecast, here, robot()[0]).arrival_steps) == 12


def test_a_switching_cost_keeps_a_planned_meeting_and_forgives_its_margin():
    forecast, here = line((0.9, 0.0), (-0.005, 0.0))
    eta = robot()[0]
    planned = torch.tensor(120)
    loyal = ExactSearch(switching_cost=8.0, margin=10.0)
    assert abs(int(meet(loyal, forecast, here, eta, planned_steps=planned).arrival_steps) - 120) <= 6
    assert int(meet(loyal, forecast, here, eta).arrival_steps) == 67
    assert int(meet(ExactSearch(margin=10.0), forecast, here, eta, planned_steps=planned).arrival_steps) == 67
    # Planned for 62: too near for the margin, yet in time; the robot may not fall behind e(t) = t.
    assert int(meet(loyal, forecast, here, eta, planned_steps=torch.tensor(64)).arrival_steps) == 62
    assert int(meet(loyal, forecast, here, eta, planned_steps=torch.tensor(40)).arrival_steps) == 67


def test_a_goal_beneath_the_tool_is_reached_now_whatever_the_predictor_says():
    forecast, here = line((0.1, 0.0), (0.0, 0.0))
    never = robot(reach=0.0)[0]
    search = ExactSearch(height=0.2, arrival_radius=0.015)
    result = meet(search, forecast, here, never, tool_pos=torch.tensor([0.11, 0.005, 0.5]))
    assert bool(result.reachable)
    assert int(result.arrival_steps) == 2
    assert not bool(meet(search, forecast, here, never, tool_pos=torch.tensor([0.12, 0.0, 0.2])).reachable)


@pytest.mark.parametrize(("axis_cost", "passed"), [(0.0, False), (1.0, True)])
def test_places_near_the_robots_axis_are_left_where_others_are_as_good(axis_cost, passed):
    # From left to right over the axis at (0, 0.1), slowly: all places are in time.
    forecast, here = line((-0.8, 0.0), (0.008, 0.0))
    search = ExactSearch(
        stride=1, first=60, base_pos=(0.0, 0.1), axis_radius=0.5, axis_cost=axis_cost, waiting_cost=0.001
    )
    result = meet(search, forecast, here, robot(speed=1.0)[0])
    assert (float(result.goal[0]) > 0.0) == passed
    away = float((result.goal[:2] - torch.tensor([0.0, 0.1])).norm())
    assert (away >= 0.5) == passed


def test_only_places_within_reach_of_the_axis_lose():
    forecast, here = paths(20)
    plain, shy = ExactSearch(), ExactSearch(base_pos=(0.1, 0.0), axis_radius=0.12, axis_cost=3.0)
    whole = torch.cat([here.unsqueeze(-2), forecast], dim=-2)
    before, after = (search.candidates(whole).score.expand(20, -1) for search in (plain, shy))
    away = (plain.candidates(whole).goals[..., :2] - torch.tensor([0.1, 0.0])).norm(dim=-1)
    torch.testing.assert_close(before - after, 3.0 * ((0.12 - away) / 0.08).clamp(0.0, 1.0))


def test_goals_are_clamped_and_lifted():
    forecast, here = line((0.5, -0.6), (0.0, 0.0))
    result = meet(ExactSearch(half_extent=0.4, height=0.1), forecast, here, robot()[0])
    assert result.goal.tolist() == pytest.approx([0.4, -0.4, 0.1])
    # A target that rests 0.2 away from all places of the box is in time for none.
    assert not bool(meet(ExactSearch(half_extent=0.4, footprint=0.1), forecast, here, robot()[0]).reachable)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.2), (0.1, -0.1, 0.0)])
def test_with_an_offset_the_robot_waits_beside_the_target(offset):
    forecast, here = line((0.6, 0.0), (-0.004, 0.0))
    search = ExactSearch(stride=1, first=1, offset=offset, descent_steps=6.0)
    eta, asked = robot()
    found = meet(search, forecast, here, eta)
    place = forecast[found.arrival_steps - 1]
    torch.testing.assert_close(found.goal, place + torch.tensor(offset))
    # It is asked for where it waits, and there in time for the way from there.
    steps = (found.goal - torch.tensor([0.0, 0.0, HEIGHT])).norm() / 0.01
    assert 0.0 <= found.arrival_steps - 6.0 - steps < 2.0
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("offset", "message"),
    [((0.1,), "two or three numbers"), ((0.1, 0.0, float("nan")), "finite"), ((0.1, 0.0), "2 numbers, but places 3")],
)
def test_an_offset_that_is_none_is_named(offset, message):
    with pytest.raises(InputError, match=f"offset .*{message}"):
        meet(ExactSearch(offset=offset), *line((0.6, 0.0), (-0.004, 0.0)), robot()[0])


def test_dwells_agree_with_counting():
    forecast, here = paths(6, seed=2)
    path = torch.cat([here.unsqueeze(-2), forecast], dim=-2)
    steps = torch.arange(2, 91, 3)
    places = FULL.goals(path[:, steps])
    before, dwell = FULL.dwells(path, places, 2, POCKETED.forecast(path))
    assert len(dwell.unique()) == 8
    for row, k in [(row, k) for row in range(6) for k in range(len(steps))]:
        there = [bool((p[:2] - places[row, k, :2]).abs().max() <= 0.04 and p[2] > 0) for p in path[row]]
        there += [False] * 10
        t = first = int(steps[k])
        while there[t] and first > 0 and there[first - 1] and t - first < 7:
            first -= 1
        last = t
        while there[t] and there[last + 1] and last - t < 7:
            last += 1
        assert int(before[row, k]) == t - first
        assert int(dwell[row, k]) == (min(7, last - first + 1) if there[t] else 0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3, 4)])
@pytest.mark.parametrize("search", [ExactSearch(), FULL])
def test_a_batch_is_a_loop_over_its_rows_in_any_order(search, batch, dtype):
    forecast, here = paths(*batch, dtype=dtype)
    tool, planned = torch.roll(here, 1, -1) / 4, (here[..., 0].abs() * 500).long()
    result = meet(search, forecast, here, robot()[0], tool_pos=tool, planned_steps=planned)
    assert result.goal.dtype == dtype
    assert [x.shape for x in result] == [(*batch, 3), batch, batch, batch]
    flat = forecast.reshape(-1, 90, 3), here.reshape(-1, 3), tool.reshape(-1, 3), planned.reshape(-1)
    for row in reversed(range(len(flat[0]))):
        f, p, t, s = (value[row] for value in flat)
        alone = meet(search, f, p, robot()[0], tool_pos=t, planned_steps=s)
        for whole, single in zip(result, alone, strict=True):
            assert torch.equal(whole.reshape(-1, *single.shape)[row], single)


@pytest.mark.parametrize("mirror", [(-1, 1, 1), (1, -1, 1), (-1, -1, 1)])
def test_a_mirrored_scene_has_mirrored_goals(mirror):
    forecast, here = paths(40)
    mirror = torch.tensor(mirror, dtype=here.dtype)
    one, other = (meet(FULL, forecast * m, here * m, robot()[0]) for m in (torch.ones(3), mirror))
    assert torch.equal(one.goal * mirror, other.goal)
    assert torch.equal(one.arrival_steps, other.arrival_steps)
    assert one.reachable.any()


SHAPES = [((5, 2), (3,), {}), ((5, 3), (2,), {}), ((3,), (3,), {}), ((2, 5, 3), (4, 3), {})]
SHAPES += [((2, 5, 3), (2, 3), {"tool_pos": torch.zeros(3)}), ((2, 5, 3), (2, 3), {"planned_steps": torch.zeros(2, 1)})]


@pytest.mark.parametrize(("forecast", "here", "more"), SHAPES)
def test_wrong_shapes_are_named(forecast, here, more):
    with pytest.raises(InputError, match=next(iter(more), "") + r".*must have shape"):
        meet(ExactSearch(), torch.zeros(forecast), torch.zeros(here), robot()[0], **more)


BAD = [
    ("axis_cost", -1.0),
    ("stride", 0),
    ("stride", 2.5),
    ("longest_dwell", 0),
    ("half_extent", -1.0),
    ("height", float("nan")),
]
BAD += [
    (name, -0.5)
    for name in ("descent_steps", "margin", "footprint", "waiting_cost", "switching_cost", "arrival_radius")
]


@pytest.mark.parametrize("bad", [(0.0,), (0.0, float("nan")), (0.0, 0.0, 0.0)])
def test_an_axis_that_is_no_place_is_named(bad):
    with pytest.raises(InputError, match="base_pos"):
        ExactSearch(base_pos=bad)


@pytest.mark.parametrize(("name", "value"), BAD)
def test_a_bad_setting_is_named(name, value):
    with pytest.raises(InputError, match=f"{name}.*{value}"):
        ExactSearch(**{name: value})


def test_with_a_perfect_forecast_and_arrivals_the_true_meeting_time_is_found():
    # |p + v t| = 0.01 t has its first root t in closed form; the search answers with the next whole step.
    draw = torch.Generator().manual_seed(1)
    start, velocity = torch.rand(2, 300, 2, generator=draw, dtype=torch.float64) - 0.5
    velocity *= 0.03
    ahead = torch.arange(201.0, dtype=torch.float64).view(-1, 1)
    path = torch.nn.functional.pad(start.unsqueeze(1) + velocity.unsqueeze(1) * ahead, (0, 1), value=HEIGHT)
    a, b, c = velocity.square().sum(-1) - 1e-4, (start * velocity).sum(-1), start.square().sum(-1)
    root = torch.stack([(-b - (b * b - a * c).sqrt()) / a, (-b + (b * b - a * c).sqrt()) / a])
    root = torch.where(root > 0, root, torch.inf).nan_to_num(nan=torch.inf).amin(0)
    found = meet(ExactSearch(stride=1), path[:, 1:], path[:, 0], robot(reach=9.0)[0])
    met = root <= 200
    assert 100 < met.sum() < 300
    assert torch.equal(found.reachable, met)
    assert torch.equal(found.arrival_steps[met], root[met].ceil().clamp_min(2).long())


def same(one, other):
    return (one.arrival_steps == other.arrival_steps) & (one.reachable == other.reachable)


@pytest.mark.parametrize("coarse", [2, 3, 4, 7])
def test_coarse_to_fine_finds_the_first_crossing_with_few_questions(coarse):
    draw = torch.Generator().manual_seed(1)
    start, velocity = torch.rand(2, 60, 1, 3, generator=draw) - 0.5
    start[..., 2], velocity[..., 2] = HEIGHT, 0.0
    path = start + 0.015 * velocity * torch.arange(301.0).unsqueeze(-1)
    eta, asked = robot(reach=9.0)
    whole = meet(ExactSearch(), path[:, 1:], path[:, 0], robot(reach=9.0)[0])
    found = meet(ExactSearch(coarse=coarse), path[:, 1:], path[:, 0], eta)
    assert [shape[1] for shape, _ in asked] == [-(-60 // coarse), coarse + 1]
    assert whole.reachable.any()
    # A short stretch in time between two that are asked for first may be missed: the meeting is then a later one.
    alike = same(found, whole)[whole.reachable]
    assert alike.double().mean() > 0.9
    later = (found.arrival_steps >= whole.arrival_steps) | ~found.reachable
    assert bool(later[whole.reachable].all())
    assert torch.equal(found.goal[whole.reachable][alike], whole.goal[whole.reachable][alike])


@pytest.mark.parametrize("horizon", [1, 2, 6, 11])
def test_coarse_to_fine_works_on_short_forecasts(horizon):
    forecast, here = paths(30, horizon=horizon)
    found, whole = (meet(ExactSearch(stride=2, coarse=n), forecast, here, robot()[0]) for n in (4, 1))
    assert bool(same(found, whole)[whole.reachable].all())


def test_a_tool_waits_where_the_target_is_some_steps_before_they_meet():
    path, here = line((1.0, 0.2), (-0.004, 0.0))
    eta, _ = robot(reach=3.0)
    found = meet(ExactSearch(stride=1, first=1, early_steps=12), path, here, eta)
    plain = meet(ExactSearch(stride=1, first=1), path, here, robot(reach=3.0)[0])
    assert torch.equal(found.goal, path[found.arrival_steps - 1 - 12])
    # It is there in time, but no sooner than it must: the place is farther up than that of the meeting.
    assert eta(found.goal.unsqueeze(0), estimator="mode").steps <= found.arrival_steps
    assert plain.arrival_steps < found.arrival_steps <= plain.arrival_steps + 12
