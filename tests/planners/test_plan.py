"""Plans: what `replan` makes is what a planner uses, from nothing but what it is given."""

import inspect

import pytest
import torch

from tests.planners.first_plan import first_plan
from tests.planners.toy import NO_MEMORY, Straight, make_planner, observation, seen_by
from tests.tasks.trapper.crossing import make_planner as make_waiting_planner
from tests.tasks.trapper.crossing import world
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import Delayed, DynamicPlanner, EventSchedule, Plan, SoftExactSearch
from torchdyn_plan.tasks import load_task

SCREEN = 60
"""Lines that are seen at once."""


def in_use(td):
    """The plan that ``td`` remembers, one step later."""
    return Plan(*(td["plan", field] for field in Plan._fields)).older()


def clones(*values):
    return [tuple(one.clone() for one in value) for value in values]


def check(planner, before, after, *, exactly=True):
    """Where ``planner`` planned, it uses what `replan` returns for the same rows, all of them at once or one alone."""
    seen, plan = seen_by(planner, before), in_use(before)
    rows = after["plan", "replanned"].nonzero().squeeze(-1)
    made = planner.replan(seen, plan)
    pairs = list(zip(Plan._fields, made, strict=True))
    for field, value in pairs:
        if exactly:
            assert torch.equal(after["plan", field][rows], value[rows]), field
        else:
            torch.testing.assert_close(after["plan", field][rows], value[rows], msg=field)
    for row in rows.tolist():
        one = seen.of([value[row : row + 1] for value in seen.flat()])
        alone = planner.replan(one, Plan(*(value[row : row + 1] for value in plan)))
        for (field, value), single in zip(pairs, alone, strict=True):
            torch.testing.assert_close(single[0], value[row], msg=field)
    return len(rows)


@pytest.mark.parametrize("make", [make_planner, make_waiting_planner])
def test_what_is_planned_is_what_replan_returns(make):
    planner, scene, planned, memory = make(), world(5, seed=4), 0, None
    for step in range(60):
        before = scene.show(memory)
        (after,) = scene.run(planner, 1, memory)
        memory = after["plan"]
        if step > 0:
            planned += check(planner, before, after)
    assert planned >= 5 * 4


@pytest.mark.parametrize("name", ["corner", "exact", "wait_and_drop"])
def test_what_the_shipped_planners_plan_is_what_replan_returns(name):
    planner = load_task("trapper").planner(name, "ik")
    env = TrapperEnv(6, seed=0, num_threads=1, split="dev")
    td, planned = env.reset(), 0
    for step in range(30 if name == "wait_and_drop" else 85):
        before = td.clone()
        planner(td)
        if step > 13 and td["plan", "replanned"].any():
            planned += check(planner, before, td, exactly=False)
        td = env.step_and_maybe_reset(td)[1]
    assert planned >= 5


def test_replan_changes_nothing_and_says_the_same_twice():
    planner = make_waiting_planner()
    td = world(4).run(planner, 20)[-1]
    seen, plan = seen_by(planner, td), in_use(td)
    kept = clones(seen.flat(), plan)
    once, again = planner.replan(seen, plan), planner.replan(seen, plan)
    for one, other in ((seen.flat(), kept[0]), (plan, kept[1]), (once, again)):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_a_plan_depends_on_the_plan_in_use():
    """Hysteresis: of two meetings that are as good, the one that was planned before is kept."""
    planner = make_waiting_planner()
    seen = seen_by(planner, world(16).run(planner, 16)[-1])
    plan = Plan.hold(seen, planner.memory.path_length)
    steps = [planner.replan(seen, plan._replace(arrival_steps=torch.full((16,), n))).arrival_steps for n in (60, 110)]
    assert (steps[0] != steps[1]).any()


@pytest.mark.filterwarnings(NO_MEMORY)
def test_gradients_reach_the_forecaster_through_a_plan_and_through_a_step():
    torch.manual_seed(0)
    forecaster = Forecaster(square_symmetry=True, half_extent=0.75, hidden=32)
    planner = DynamicPlanner(lambda td: td, forecaster, ETANetwork(hidden=32), search=SoftExactSearch())
    td = first_plan(3)
    planned = planner.replan(seen_by(planner, td), Plan.hold(seen_by(planner, td), 0))
    for goal in (planned.goal, planner(td)["goal"]):
        forecaster.zero_grad()
        goal.sum().backward()
        for name, parameter in planner.named_parameters():
            assert parameter.grad is not None, name
            assert bool(parameter.grad.isfinite().all()), name
        assert bool(forecaster.head.weight.grad.any())


def test_a_plan_ages_and_runs_out():
    seen = seen_by(make_planner(), observation((2,)))
    plan = Plan.hold(seen, 4)
    assert plan.older().age.tolist() == [-1, -1]
    path = torch.arange(4.0)[:, None].expand(2, 4, 3)
    plan = plan._replace(path=path, age=torch.tensor([0, 2]), arrival_steps=torch.tensor([3, 0]))
    assert plan.ahead(3)[..., 0].tolist() == [[0, 1, 2], [2, 3, 3]]
    later = plan.older()
    assert later.age.tolist() == [1, 3]
    assert later.arrival_steps.tolist() == [2, 0]
    assert later.ahead(2)[..., 0].tolist() == [[1, 2], [3, 3]]


@pytest.mark.filterwarnings(NO_MEMORY)
@pytest.mark.parametrize("delivery", [{}, {"delivery": Delayed(4)}, {"delivery": Delayed(4, compensate=False)}])
def test_the_path_begins_with_the_target_at_the_moment_of_use(delivery):
    planner, td = make_planner(schedule=EventSchedule(first_step=3), **delivery), observation((2,), step=3)
    delay = planner.delivery.delay if delivery else 0
    whole = torch.cat([td["target_pos"].unsqueeze(-2), Straight().path(td["target_history"])], dim=-2)
    plan = planner.replan(seen_by(planner, td), Plan.hold(seen_by(planner, td), planner.memory.path_length))
    kept = min(plan.path.shape[-2], whole.shape[-2] - delay)
    torch.testing.assert_close(plan.path[:, :kept], whole[:, delay : delay + kept])
    assert torch.equal(plan.path[:, kept:], whole[:, -1:].expand(-1, plan.path.shape[-2] - kept, -1))


@pytest.mark.parametrize("code", [DynamicPlanner, DynamicPlanner.replan, DynamicPlanner.forward])
def test_the_idea_is_seen_at_once(code):
    assert len(inspect.getsource(code).splitlines()) <= SCREEN
