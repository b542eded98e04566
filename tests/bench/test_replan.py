from dataclasses import dataclass, replace

import pytest
import torch

from tests.bench.columns import COLUMNS
from torchdyn_plan import keys
from torchdyn_plan.bench import replan as bench_replan
from torchdyn_plan.bench.observations import moments, observe, pursued
from torchdyn_plan.bench.replan_parts import flat_replan, in_blocks, steps
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import CallablePlanner, DynamicPlanner, Meeting, Plan, ReplanSchedule
from torchdyn_plan.tasks import load_task

TASK = load_task("trapper")
QUICK = {"seconds": 0.0, "compiled": False}


@pytest.fixture(scope="module")
def planner():
    return untrained(TASK.static_planner())


def untrained(static, **parts):
    torch.manual_seed(0)
    networks = Forecaster(square_symmetry=True, half_extent=0.75), ETANetwork()
    return DynamicPlanner(static, *networks, **parts).eval().requires_grad_(False)


def names_of(rows):
    return [(row["what"], row["implementation"]) for row in rows]


def test_a_replan_is_measured_in_its_parts_and_a_batch_equals_its_rows(planner):
    rows = bench_replan.bench(TASK, planners={"own": planner}, batches=(1, 5), **QUICK)
    both = ["forecast", "ETA, 1 goal", "ETA, 4 goals", "ETA, 60 goals", "re-plan, own"]
    alone = ["search alone, own", "step that plans, own", "step between plans, own"]
    alone += ["static planner's step", "IK path of 5 steps"]
    expected = [(name, "torchdyn_plan") for name in both + alone]
    expected += [(name, "torchdyn_plan, for inference") for name in both]
    assert names_of(row for row in rows if row["batch"] == 5 and row["device"] == "cpu") == expected
    for row in rows:
        assert row.keys() >= COLUMNS | {"per_second"}
        assert not row["compiled"]
        assert row["max_error"] < 1e-3, row
        assert row["median_us"] > 0.0


def test_default_planners_are_those_of_the_task_that_plan_on_what_is_seen():
    made = bench_replan._planners(TASK, None)
    assert list(made) == ["wait", "corner", "exact", "exact, coarse to fine", "wait_and_drop"]
    assert made["exact, coarse to fine"].search.coarse == 4


def test_a_planner_on_somebody_s_own_static_planner_is_measured():
    still = CallablePlanner(lambda state, goal: torch.zeros(*state.shape[:-1], 6))
    rows = bench_replan.bench(TASK, planners={"own": untrained(still)}, batches=(2,), **QUICK)
    assert "static planner's step" in {row["what"] for row in rows}
    assert not any("IK" in row["what"] for row in rows)


def test_a_planner_s_own_search_is_the_one_that_is_measured():
    @dataclass(frozen=True)
    class Own:
        calls: list[int]

        def __call__(self, forecast, target_pos, eta, context=None):
            self.calls.append(len(target_pos))
            no = torch.zeros(target_pos.shape[:-1], dtype=torch.bool)
            return Meeting(forecast.path[..., 99, :], torch.full(no.shape, 100), no, ~no)

    own = Own([])
    rows = bench_replan.bench(
        TASK, planners={"own": untrained(TASK.static_planner(), search=own)}, batches=(3,), **QUICK
    )
    assert {"re-plan, own", "search alone, own"} <= {row["what"] for row in rows}
    assert own.calls


@pytest.mark.parametrize(
    ("task", "static", "joints"), [("trapper", "rl", False), ("fetch_reach", "proportional", False)]
)
def test_other_static_planners_and_tasks_are_measured(task, static, joints):
    if task == "fetch_reach":
        pytest.importorskip("gymnasium_robotics")
    task = load_task(task)
    rows = bench_replan.bench(task, planners={"corner": task.planner("corner", static)}, batches=(2,), **QUICK)
    named = {row["what"] for row in rows}
    assert {"re-plan, corner", "step that plans, corner", "static planner's step"} <= named
    assert ("IK path of 5 steps" in named) == joints
    # A planner that plans at every step has no step between plans.
    assert ("step between plans, corner" in named) == (task.name == "trapper")


def test_what_plans_nothing_is_refused():
    with pytest.raises(InputError, match="'pursuit' is TargetPursuit"):
        bench_replan.bench(TASK, planners=["pursuit"])
    with pytest.raises(InputError, match="at least, got none"):
        bench_replan.bench(TASK, planners={})
    with pytest.raises(InputError, match="got the string 'corner'"):
        bench_replan.bench(TASK, planners="corner")
    alone = replace(TASK, planners={"pursuit": TASK.planners["pursuit"]})
    with pytest.raises(InputError, match="no default planner of trapper"):
        bench_replan.bench(alone)


def test_a_planner_that_never_plans_is_named(planner):
    never = planner.with_parts(schedule=ReplanSchedule(first_step=10**6))
    with pytest.raises(InputError, match="'lazy' does not plan"):
        moments(TASK, never, "'lazy'")


def test_rows_that_depend_on_their_batch_show_as_an_error():
    goal = torch.arange(12.0).view(4, 3)

    def once(values):
        return (values - values.mean(dim=0),)

    def twice(values):
        return (values * 2.0,)

    assert bench_replan.max_error(once, once, (goal,)) > 1e-3
    assert bench_replan.max_error(twice, once, (goal,)) > 1e-3
    assert bench_replan.max_error(twice, twice, (goal,)) == 0.0


def test_more_rows_than_a_block_are_worked_on_block_by_block():
    sizes = []

    def part(one, other):
        sizes.append(len(one))
        return one + other, other

    found = in_blocks(part, 4, torch.arange(10), torch.ones(10))
    assert sizes == [4, 4, 2]
    assert torch.equal(found[0], torch.arange(1, 11))
    in_blocks(part, 10, torch.arange(10), torch.ones(10))
    assert sizes[3:] == [10]


def test_the_planner_step_that_plans_plans_and_the_other_does_not(planner, monkeypatch):
    calls = []
    plan = DynamicPlanner.replan

    def counted(self, *seen):
        calls.append(0)
        return plan(self, *seen)

    monkeypatch.setattr(DynamicPlanner, "replan", counted)
    seen = moments(TASK, planner).repeated(3)
    parts = steps("own", planner, seen)
    for what, planned in (("step between plans, own", 0), ("step that plans, own", 1)):
        calls.clear()
        part = parts[what]
        part.call(*part.inputs(seen))
        assert len(calls) == planned


def test_a_flat_replan_is_the_planner_s_own(planner):
    observation = observe(planner, moments(TASK, planner).repeated(70).planning)
    plan = Plan.hold(observation, 0)
    expected = planner.replan(observation, plan)
    goal, arrival_steps = flat_replan(planner)(*plan, *observation.flat())
    assert torch.equal(goal, expected.goal)
    assert torch.equal(arrival_steps, expected.arrival_steps)
    assert torch.equal(goal[64:], goal[:6])


def test_what_is_seen_is_the_same_at_every_run_and_in_motion():
    one, other = pursued(TASK, 70), pursued(TASK, 70)
    assert all(torch.equal(one[key], other[key]) for key in (keys.JOINT_POS, keys.GOAL, keys.TARGET_HISTORY))
    assert (one[keys.JOINT_VEL].abs().amax(-1) > 0).all()
    assert torch.equal(one[keys.GOAL], one[keys.TARGET_POS])
    seen = moments(TASK, TASK.planner("corner"))
    assert (seen.planning[keys.STEP_COUNT] == ReplanSchedule().first_step).all()
    assert (seen.between[keys.STEP_COUNT] == ReplanSchedule().first_step + 1).all()
