import pytest
import torch

from tests.planners.toy import (
    NO_MEMORY,
    SPEED,
    StraightArrival,
    ToyEnv,
    assert_same,
    make_planner,
    observation,
)
from tests.tasks.trapper.crossing import make_planner as make_waiting_planner
from tests.tasks.trapper.crossing import world
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Arrival, ArrivalModel
from torchdyn_plan.nets.distributions import decode_distribution
from torchdyn_plan.planners import Delayed, ExactSearch, ReplanSchedule

WINDOW = 10


def run(planner, steps, batch=(2,)):
    """What the planner wrote at each step, of a target that goes straight on."""
    td, found = observation(batch), []
    velocity = torch.tensor([0.004, 0.002, 0.0])
    start = td["target_pos"]
    for step in range(steps):
        td["step_count"] = torch.full(batch, step)
        td["target_pos"] = start + step * velocity
        td["target_history"] = start.unsqueeze(-2) + (step + torch.arange(-5, 1)[:, None]) * velocity
        found.append(planner(td).clone())
    return found


@pytest.mark.parametrize("latency", [1, 4])
def test_a_plan_takes_effect_latency_steps_after_what_it_was_made_from(latency):
    schedule = ReplanSchedule.every(WINDOW, first_step=3)
    found = run(make_planner(schedule=schedule, delivery=Delayed(latency)), 40)
    for step, td in enumerate(found):
        assert td["plan", "replanned"].all() == (step in (3, 13, 23, 33))
    for ordered in (3, 13, 23):
        taken = ordered + latency
        waiting = found[ordered]["plan", "pending_goal"]
        for step in range(ordered, taken):
            assert torch.equal(found[step]["goal"], found[ordered - 1]["goal"])
            assert found[step]["plan", "pending_steps"].tolist() == [taken - step] * 2
        assert torch.equal(found[taken]["goal"], waiting)
        assert not torch.equal(found[taken]["goal"], found[taken - 1]["goal"])
        assert torch.equal(found[taken]["arrival_steps"], found[ordered]["plan", "pending_arrival_steps"])


def test_a_planner_that_compensates_plans_for_the_moment_when_the_plan_is_there():
    """On a straight path, with an arrival that needs nothing but time, both worlds meet at the same place."""
    latency, step, velocity = 4, 3, torch.tensor([0.004, 0.002, 0.0])
    planner = make_planner(delivery=Delayed(latency), search=ExactSearch(stride=1))
    found = run(planner, step + latency + 1)
    aware = found[-1]
    met = aware["target_pos"] + aware["arrival_steps"].unsqueeze(-1) * velocity
    torch.testing.assert_close(aware["goal"], met, atol=1e-5, rtol=0)
    unaware = make_planner(search=ExactSearch(stride=1), delivery=Delayed(latency, compensate=False))
    stale = run(unaware, step + latency + 1)[-1]
    behind = stale["target_pos"] + (stale["arrival_steps"] - latency).unsqueeze(-1) * velocity
    torch.testing.assert_close(stale["goal"], behind, atol=1e-5, rtol=0)


def test_the_arrival_is_counted_from_then():
    """A robot that goes on to its goal needs as many steps less."""
    goals = torch.tensor([[0.2, 0.0, 0.0], [0.01, 0.0, 0.0], [1e3, 0.0, 0.0]])
    arrival = StraightArrival().arrival(torch.zeros(1, 3), goals).after(4)
    assert arrival.steps.tolist() == pytest.approx([0.2 / SPEED - 4, 0.0, 1e3 / SPEED - 4])
    assert arrival.never.tolist() == [False, False, True]


class Spy(ArrivalModel):
    """Tells a distribution, and keeps what a search was handed in place of it."""

    def arrival(self, robot_state, goal, *, estimator="mode"):
        steps = torch.linalg.vector_norm(goal - robot_state[..., -3:], dim=-1) / SPEED
        number = torch.arange(41.0) * 5 + 2
        return decode_distribution(-((number - steps.unsqueeze(-1)) / 10).square())


@pytest.mark.filterwarnings(NO_MEMORY)
@pytest.mark.parametrize("delivery", [None, Delayed(1), Delayed(5), Delayed(5, compensate=False)])
def test_the_search_is_handed_the_whole_distribution_from_then(delivery):
    handed, td, search = [], observation((4,), step=3), ExactSearch(probability_weight=5.0, footprint=0.1)

    def watched(forecast, target_pos, eta, context):
        def asked(goal, *, estimator):
            handed.append((estimator, eta(goal, estimator=estimator), goal))
            return handed[-1][1]

        return search(forecast, target_pos, asked, context)

    make_planner(search=watched, delivery=delivery).with_parts(eta=Spy())(td)
    ((estimator, arrival, goal),) = handed
    now: Arrival = Spy().arrival(td["robot_state"].unsqueeze(1), goal)
    delay = delivery.delay if delivery else 0
    assert estimator == "distribution"
    torch.testing.assert_close(arrival.bins, now.bins)
    for time in (0.0, 7.0, 31.0):
        there = torch.full_like(now.steps, time)
        torch.testing.assert_close(arrival.by(there), now.by(there + delay))
    assert bool((arrival.steps >= 0).all())


def test_without_latency_nothing_more_is_kept():
    planner, td = make_planner(), observation((2,))
    assert set(planner.out_keys) == set(make_planner(delivery=None).out_keys)
    assert not any("pending" in name for name in map(str, planner(td)["plan"].keys()))


@pytest.mark.parametrize("make", [make_planner, make_waiting_planner])
def test_keys_are_declared_and_written(make):
    planner = make(delivery=Delayed(3))
    td = world(2).run(planner, 1)[0] if make is make_waiting_planner else planner(observation((2,)))
    assert set(planner.out_keys) <= set(td.keys(True, True))
    written = {key for key in td.keys(True, True) if isinstance(key, tuple)}
    assert written == {key for key in planner.out_keys if isinstance(key, tuple)}


def test_a_row_that_is_busy_begins_no_other_plan():
    planner = make_planner(schedule=ReplanSchedule.every(5, first_step=3), delivery=Delayed(9))
    planner.forecaster.horizon = 60
    due = [step for step, td in enumerate(run(planner, 40)) if td["plan", "replanned"].all()]
    assert due == [3, 13, 23, 33]


def test_auto_resets_leave_each_episode_as_if_alone():
    data = ToyEnv(5).rollout(400, make_planner(delivery=Delayed(3)), break_when_any_done=False)
    whole = 0
    for row in data.unbind(0):
        for episode in row["episode"].unique().tolist():
            part = row[row["episode"] == episode]
            if bool(part["next", "done"][-1]):
                alone = ToyEnv(1, first_episode=episode).rollout(200, make_planner(delivery=Delayed(3)))[0]
                # What waited in the row before the reset is gone, though its values are kept until the first plan.
                pending = [("plan", name) for name in map(str, part["plan"].keys()) if name.startswith("pending_")]
                first = int(part["plan", "replanned"].int().argmax())
                assert_same(part[:first].exclude(*pending), alone[:first].exclude(*pending))
                assert_same(part[first:], alone[first:])
                whole += 1
    assert whole > 12


def test_one_that_compensates_drops_as_one_without_latency():
    """On a path that is forecast without error latency costs the first steps alone."""
    steps = 140
    plain = world(3, seed=5).run(make_waiting_planner(), steps)
    late = world(3, seed=5).run(make_waiting_planner(delivery=Delayed(5)), steps)
    drops = [torch.stack([td["plan", "drop_step"] for td in found]).amax(0) for found in (plain, late)]
    assert (drops[0] > 10).any()
    assert torch.equal(drops[0] > 10, drops[1] > 10)
    assert all((td["plan", "drop_step"] == -1).all() for td in late[:18])
    for td in late[18:]:
        ahead = td["plan", "path"].gather(-2, td["plan", "age"][:, None, None].expand(-1, 1, 3))
        torch.testing.assert_close(ahead.squeeze(-2), td["target_pos"], atol=1e-4, rtol=0)


@pytest.mark.filterwarnings(NO_MEMORY)
def test_a_forecast_that_ends_before_the_plan_is_there_is_refused():
    planner = make_planner(delivery=Delayed(50))
    with pytest.raises(InputError, match="delay must be below the forecast's 40 steps, got 50"):
        planner(observation((2,), step=3))


@pytest.mark.parametrize("steps", [-1, 0, 2.5])
def test_a_bad_latency_is_refused(steps):
    with pytest.raises(InputError, match=f"steps.*{steps}"):
        Delayed(steps)
