from concurrent.futures import Executor, Future

import pytest
import torch

from tests.planners.test_delivery import run
from tests.planners.toy import NO_MEMORY, assert_same, make_planner, observation
from tests.tasks.trapper.crossing import line
from tests.tasks.trapper.crossing import make_planner as make_waiting_planner
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import Background, Delayed, Observation, ReplanSchedule, measured_latency

pytestmark = pytest.mark.filterwarnings(NO_MEMORY)

SCHEDULE = ReplanSchedule.every(10, first_step=3)
LATENCY = 2


class ByHand(Executor):
    """Runs a job when it is asked for its result, and says that it is done from the step on that a test sets."""

    def __init__(self, steps):
        self.steps, self.now, self.jobs = steps, 0, []

    def submit(self, function, /, *args):
        executor, number = self, len(self.jobs)
        observation = next(value for value in args if isinstance(value, Observation))
        self.jobs.append((observation.step_count.max().item(), args))

        class Job(Future):
            def done(self):
                return executor.now >= executor.jobs[number][0] + executor.steps

            def result(self, timeout=None):
                return function(*args)

        return Job()


def play(ready_after, steps=30, deadline=5, latency=LATENCY):
    """What is written at each step when a plan is ready so many steps after it was ordered; and the delivery."""
    executor = ByHand(ready_after)
    delivery = Background(latency=latency, deadline=deadline, executor=executor)
    planner = make_planner(schedule=SCHEDULE, delivery=delivery)
    clock = planner.forward

    def forward(td):
        executor.now = int(td["step_count"].max())
        return clock(td)

    planner.forward = forward
    return run(planner, steps), delivery


@pytest.mark.parametrize("ready_after", [0, 1, 2])
def test_a_plan_that_is_ready_in_time_comes_into_use_as_one_that_takes_as_long_as_foreseen(ready_after):
    found, delivery = play(ready_after)
    foreseen = run(make_planner(schedule=SCHEDULE, delivery=Delayed(LATENCY)), 30)
    for one, other in zip(found, foreseen, strict=True):
        pending = [("plan", name) for name in other["plan"].keys() if name.startswith("pending_")]  # noqa: SIM118
        assert len(pending) == 8
        assert_same(one, other.exclude(*pending))
    assert (delivery.used, delivery.missed) == (3, 0)


def test_a_late_plan_is_as_old_as_it_is():
    found, delivery = play(4)
    foreseen = run(make_planner(schedule=SCHEDULE, delivery=Delayed(LATENCY)), 30)
    assert torch.equal(found[7]["goal"], foreseen[7]["goal"])
    assert torch.equal(found[7]["arrival_steps"], foreseen[7]["arrival_steps"])
    assert torch.equal(found[6]["goal"], foreseen[4]["goal"])
    assert (delivery.used, delivery.missed) == (3, 0)


def test_past_the_deadline_the_last_valid_goal_is_kept():
    found, delivery = play(6)
    assert all(torch.equal(td["goal"], found[0]["goal"]) for td in found)
    assert (delivery.used, delivery.missed) == (0, 3)


def test_no_drop_begins_when_plans_stay_away():
    """The first plan comes, the others never do: what is known of the path ends before the target is there."""
    drops = []
    for deadline in (4, 400):
        executor = ByHand(2)
        planner = make_waiting_planner(delivery=Background(latency=2, deadline=deadline, executor=executor))
        scene, plan = line(), None
        for step in range(140):
            executor.now, executor.steps = step, 2 if step < 20 or deadline > 4 else 9
            plan = scene.run(planner, 1, plan)[0]["plan"]
            drops.append((deadline, int(plan["drop_step"])))
    assert max(step for deadline, step in drops if deadline == 400) > 10
    assert max(step for deadline, step in drops if deadline == 4) == -1


def test_a_plan_for_an_episode_that_is_over_is_dropped():
    executor = ByHand(3)
    delivery = Background(latency=2, deadline=9, executor=executor)
    planner = make_planner(schedule=SCHEDULE, delivery=delivery)
    td = observation((2,), step=3)
    executor.now = 3
    planner(td)
    for row_0, now in ((0, 4), (1, 5), (2, 6), (3, 7), (4, 8)):
        executor.now = now
        td["step_count"] = torch.tensor([row_0, now])
        planner(td)
    assert torch.equal(td["goal"][0], td["tool_pos"][0])
    assert not torch.equal(td["goal"][1], td["tool_pos"][1])


def test_a_thread_of_its_own_plans_and_its_errors_come_to_the_loop():
    delivery = Background(latency=0, deadline=400)
    planner = make_planner(schedule=SCHEDULE, delivery=delivery)
    td = observation((2,), step=3)
    planner(td)
    delivery.executor.submit(int).result()
    td["step_count"] += 1
    assert not torch.equal(planner(td)["goal"], td["tool_pos"])
    planner.forecaster.horizon = "broken"
    td["step_count"] += 9
    td["plan", "countdown"] = torch.ones(2, dtype=torch.int64)
    planner(td)
    delivery.close()
    td["step_count"] += 1
    with pytest.raises(TypeError):
        planner(td)


def test_a_plan_under_way_that_is_dropped_is_forgotten():
    delivery = Background(latency=1, deadline=3)
    planner = make_planner(schedule=SCHEDULE, delivery=delivery)
    for _ in range(3):
        td = planner(observation((4,), step=SCHEDULE.first_step))
        assert td["plan", "replanned"].all()
        assert not planner(observation((4,), step=SCHEDULE.first_step))["plan", "replanned"].any()
        delivery.drop()
    delivery.drop()
    delivery.close()


def test_measured_latency_counts_steps_upwards():
    assert measured_latency(lambda: None, 100.0, runs=3) == 1
    calls = []
    measured_latency(lambda: calls.append(0), 1.0, runs=4)
    assert len(calls) == 5


@pytest.mark.parametrize("bad", [{"deadline": 1}, {"latency": -1}, {"deadline": 2.5}])
def test_a_bad_number_is_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        Background(**{"latency": 2, "deadline": 4, **bad})
