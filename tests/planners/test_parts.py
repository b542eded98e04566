"""Planners are put together from parts: any of them with any others, and none changes afterwards."""

import dataclasses
import itertools
from typing import ClassVar, NamedTuple

import pytest
import torch
from torch import Tensor, nn

from tests.planners.toy import NO_MEMORY, StraightArrival, go_straight, make_planner, observation
from tests.tasks.trapper.crossing import MANEUVER, line, world
from tests.tasks.trapper.crossing import make_planner as make_waiting_planner
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Actor, FunctionArrival, FunctionForecast
from torchdyn_plan.planners import (
    Background,
    CornerSearch,
    Delayed,
    DynamicPlanner,
    EventSchedule,
    ExactSearch,
    GoTo,
    LostBelow,
    PlanStatus,
    PolicyPlanner,
    ReplanSchedule,
    SoftCornerSearch,
    SoftExactSearch,
    TargetPursuit,
    oracle_trajectory,
)
from torchdyn_plan.tasks import load_task

SCHEDULES = [ReplanSchedule.every(5, first_step=3), EventSchedule(first_step=3)]
MANEUVERS = [GoTo(), MANEUVER]
DELIVERIES = [None, Delayed(3), Delayed(3, compensate=False)]


def written_below_plan(td):
    return {key for key in td.keys(True, True) if isinstance(key, tuple)}


def declared(keys):
    return {key for key in keys if isinstance(key, tuple)}


@pytest.mark.parametrize(
    ("schedule", "maneuver", "delivery"), list(itertools.product(SCHEDULES, MANEUVERS, DELIVERIES))
)
def test_whatever_its_parts_a_planner_declares_what_it_writes(schedule, maneuver, delivery):
    planner = make_planner().with_parts(schedule=schedule, maneuver=maneuver, delivery=delivery)
    for td in world(2).run(planner, 12):
        assert written_below_plan(td) == declared(planner.out_keys)
    read = declared(planner.out_keys) - {("plan", "replanned"), ("plan", "status")}
    assert declared(planner.in_keys) == read
    assert len(set(planner.in_keys)) == len(planner.in_keys)
    assert len(set(planner.out_keys)) == len(planner.out_keys)


@pytest.mark.filterwarnings(NO_MEMORY)
def test_a_static_planner_that_remembers_is_declared_too():
    torch.manual_seed(0)
    planner = make_planner().with_parts(static=PolicyPlanner(Actor(hidden=8, robot_state_size=15), period=4))
    assert {("plan", "policy_age"), ("plan", "policy_action")} < declared(planner.in_keys)
    assert declared(planner.in_keys) | {("plan", "replanned"), ("plan", "status")} == declared(planner.out_keys)
    for name in ("window", "goal", "policy_goal"):
        assert ("plan", name) in planner.in_keys


def test_with_parts_makes_another_planner_and_leaves_the_first_as_it_was():
    first = make_planner(chunk=4)
    before, in_keys, out_keys = first.part_settings(), list(first.in_keys), list(first.out_keys)
    schedule = EventSchedule()
    second = first.with_parts(schedule=schedule, chunk=None)
    assert second is not first
    assert (second.schedule, second.chunk) == (schedule, None)
    after = first.part_settings()
    assert all(after[name] is before[name] for name in before)
    assert (first.in_keys, first.out_keys) == (in_keys, out_keys)
    assert ("plan", "path") in second.out_keys
    same = {name for name, value in second.part_settings().items() if value is before[name]}
    assert same == set(before) - {"schedule", "chunk"}


@pytest.mark.parametrize("training", [True, False])
def test_with_parts_keeps_the_mode(training):
    planner = make_planner().train(training)
    assert planner.with_parts(chunk=3).training is training
    assert planner.for_inference().training is training


def test_an_unknown_part_is_refused_with_a_hint():
    with pytest.raises(InputError, match=r"unknown part 'serach'.*did you mean 'search'"):
        make_planner().with_parts(serach=ExactSearch())
    with pytest.raises(InputError, match=r"unknown part 'latency'.*delivery"):
        make_planner().with_parts(latency=3)


PARTS = [CornerSearch(), ExactSearch(), SoftCornerSearch(), SoftExactSearch(), *SCHEDULES, *MANEUVERS, Delayed(3)]
PARTS += [LostBelow(seen_below=0.0, forecast_below=0.0)]


@pytest.mark.parametrize("part", PARTS, ids=lambda part: type(part).__name__)
def test_parts_do_not_change(part):
    for one in dataclasses.fields(part):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(part, one.name, 1)
    assert dataclasses.replace(part) == part


def test_functions_may_stand_in_for_any_network():
    def at_rest(history):
        return history[..., -1:, :].expand(*history.shape[:-2], 40, 3)

    def steps(robot_state, goal):
        return (goal - robot_state[..., -3:]).norm(dim=-1) / 0.01

    planner = DynamicPlanner.paper(go_straight(), at_rest, steps, schedule=SCHEDULES[0])
    assert isinstance(planner.forecaster, FunctionForecast)
    assert isinstance(planner.eta, FunctionArrival)
    td = world(3).run(planner, 4)[-1]
    torch.testing.assert_close(td["goal"], td["target_pos"])
    module = nn.Identity()
    assert "function" in dict(DynamicPlanner(go_straight(), module, steps).forecaster.named_children())
    for bad in ({"forecaster": 3}, {"eta": 3}, {"static": "ik"}):
        with pytest.raises(InputError, match=f"{next(iter(bad))} must be"):
            make_planner().with_parts(**bad)


class Twice(NamedTuple):
    """A state with the name of another part's."""

    goal: Tensor


class Greedy(GoTo):
    """A maneuver whose state bears the name of a field of `Plan`."""

    State: ClassVar = Twice


def test_two_parts_that_remember_one_name_are_refused():
    with pytest.raises(InputError, match=r"two parts of a planner remember goal: rename"):
        make_planner(maneuver=Greedy())


def test_a_static_planner_that_remembers_the_planners_own_names_is_refused():
    with pytest.raises(InputError, match=r"the static planner and the planner both store .*window"):
        make_planner().with_parts(static=make_planner())


def test_waiting_and_dropping_runs_in_a_world_in_which_nothing_can_be_lost():
    planner = make_waiting_planner(lost=None)
    found = line().run(planner, 140)
    assert planner.lost is None
    assert all(td["plan", "status"] <= PlanStatus.UNREACHABLE for td in found)
    assert all(bool(td["goal"].isfinite().all()) for td in found)
    assert any(td["plan", "drop_step"] >= 0 for td in found)


@pytest.mark.parametrize("name", ["wait_and_drop", "oracles"])
def test_a_planner_that_a_task_does_not_have_is_answered_with_those_it_has(name):
    task = load_task("fetch_reach")
    with pytest.raises(InputError, match=rf"unknown planner of fetch_reach '{name}'.*choose from .*corner"):
        task.planner(name)
    assert "wait_and_drop" in load_task("trapper").planners


@pytest.mark.parametrize("first", [0, 5])
def test_the_oracles_parts_can_be_chosen(first):
    planner = oracle_trajectory(go_straight(), StraightArrival(), schedule=ReplanSchedule.every(5, first_step=first))
    assert planner.schedule.first_step == first
    assert "target_future" in planner.in_keys
    assert planner.with_parts(search=ExactSearch()).search == ExactSearch()


def test_a_planner_carries_the_scene_that_it_belongs_to():
    assert make_planner().scene is None
    assert make_planner(scene="abc").with_parts(chunk=2).scene == "abc"
    assert TargetPursuit(go_straight(), scene="abc").scene == "abc"
    task = load_task("trapper")
    assert {task.planner(name).scene for name in task.planners} == {task.digest()}


def test_a_background_planner_is_no_part_that_can_be_shared_by_accident():
    delivery = Background(latency=1, deadline=3)
    planner = make_planner(delivery=delivery)
    assert planner.with_parts(delivery=None).delivery is None
    assert planner.delivery is delivery
    delivery.close()
    assert not declared(planner.out_keys) & {("plan", "pending_steps")}


def test_nothing_is_planned_before_the_first_step():
    td = make_planner()(observation((2,)))
    assert td["plan", "status"].tolist() == [PlanStatus.WAITING] * 2
