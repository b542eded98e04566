import json
import re

import pytest
import torch

from tests.bench import own
from tests.bench.columns import COLUMNS
from torchdyn_plan import keys
from torchdyn_plan.bench import replan_forms
from torchdyn_plan.bench.observations import moments, observe, pursued
from torchdyn_plan.bench.replan import bench, max_error
from torchdyn_plan.bench.replan_parts import flat_replan, in_blocks, replans, searches, steps
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import (
    Background,
    CallablePlanner,
    Delayed,
    DynamicPlanner,
    EventSchedule,
    Plan,
    ReplanSchedule,
    shipped_planners,
)
from torchdyn_plan.tasks import load_task

TASK = load_task("trapper")
QUICK = {"seconds": 0.0, "compiled": False, "progress": False}


@pytest.fixture(scope="module")
def planner():
    return untrained(TASK.static_planner())


def untrained(static, **parts):
    torch.manual_seed(0)
    networks = Forecaster(square_symmetry=True, half_extent=0.75), ETANetwork()
    return DynamicPlanner.paper(static, *networks, **parts).eval().requires_grad_(False)


def whats(rows):
    return {row["what"] for row in rows}


def names_of(rows):
    return [(row["what"], row["implementation"]) for row in rows]


def test_a_replan_is_measured_in_its_parts_and_a_batch_equals_its_rows(planner):
    rows = bench({"own": planner}, task=TASK, batches=(1, 5), **QUICK)
    both = ["forecast", "ETA, 1 goal", "ETA, 4 goals", "ETA, 60 goals", "re-plan, own"]
    alone = ["search alone, own", "step that plans, own", "step between plans, own"]
    alone += ["static planner's step", "IK path of 5 steps"]
    expected = [(name, "torchdyn_plan") for name in both + alone]
    expected += [(name, "torchdyn_plan, for inference") for name in both]
    assert names_of(row for row in rows if row["batch"] == 5) == expected
    for row in rows:
        assert row.keys() >= COLUMNS | {"per_second"}
        assert "error" not in row
        assert (row["device"], row["compiled"]) == ("cpu", False)
        assert row["max_error"] < 1e-3, row
        assert row["median_us"] > 0.0


def test_a_planner_alone_is_measured_by_itself(planner):
    assert "re-plan, planner" in whats(bench(planner, batches=(1,), **QUICK))


def test_every_part_of_somebody_s_own_is_the_one_that_is_measured():
    calls = set()

    def noted(name, function):
        def call(*values):
            calls.add(name)
            return function(*values)

        return call

    parts = {"static": CallablePlanner(noted("static", own.stand_still)), "forecaster": noted("path", own.straight_on)}
    parts |= {"eta": noted("eta", own.always_forty), "search": noted("search", own.meet_in_hundred)}
    rows = bench(own.make_planner().with_parts(**parts), batches=(3,), **QUICK)
    assert calls == {"static", "path", "eta", "search"}
    expected = {"re-plan, planner", "search alone, planner", "step that plans, planner", "static planner's step"}
    assert expected <= whats(rows)
    assert not any("IK" in row["what"] or "error" in row for row in rows)


def test_a_search_that_is_a_module_and_asks_for_the_distribution_of_arrivals_is_measured():
    class Search(torch.nn.Module):
        def forward(self, forecast, target_pos, eta, context):
            arrival = eta(forecast.path[..., ::60, :], estimator="distribution")
            meeting = own.meet_in_hundred(forecast, target_pos, eta)
            return meeting._replace(reachable=(arrival.bins.sum(-1) > 0.5).any(-1))

    rows = bench(untrained(TASK.static_planner(), search=Search()), batches=(2,), **QUICK)
    assert {"re-plan, planner", "search alone, planner"} <= whats(rows)
    assert not any("error" in row for row in rows)


def test_the_replan_and_the_search_that_are_measured_are_the_planner_s_own(planner):
    class Own(DynamicPlanner):
        def replan(self, observation, plan):
            plan = super().replan(observation, plan)
            return plan._replace(goal=plan.goal + 1.0)

    made = Own(**planner.with_parts(search=own.meet_in_hundred).part_settings()).eval()
    seen = moments(TASK, made)
    ahead = made.forecaster(seen.planning["target_history"])[:, 99]
    for parts, shift in ((replans("own", made), 1.0), (searches("own", made), 0.0)):
        ((_, part),) = parts.items()
        goal, arrival_steps = part.call(*part.inputs(seen))
        assert torch.allclose(goal, ahead + shift)
        assert (arrival_steps == 100).all()


@pytest.mark.parametrize(
    ("task", "static", "joints"), [("trapper", "rl", False), ("fetch_reach", "proportional", False)]
)
def test_other_static_planners_and_tasks_are_measured(task, static, joints):
    if task == "fetch_reach":
        pytest.importorskip("gymnasium_robotics")
    task = load_task(task)
    rows = bench("corner", task=task, static=static, batches=(2,), **QUICK)
    named = whats(rows)
    assert {"re-plan, corner", "step that plans, corner", "static planner's step"} <= named
    assert ("IK path of 5 steps" in named) == joints
    # A planner that plans at every step has no step between plans.
    assert ("step between plans, corner" in named) == (task.name == "trapper")


def test_every_planner_of_trapper_and_every_one_that_ships_for_it_is_measured():
    names = [*TASK.planners, *TASK.static_planners, *(name for name in shipped_planners() if "trapper" in name)]
    rows = bench(names, task=TASK, batches=(1,), **QUICK)
    assert not any("error" in row for row in rows)
    assert {"step, pursuit", "step, ik", "step, rl", "re-plan, oracle", "re-plan, trapper-rl"} <= whats(rows)
    for name in names:
        assert any(what.endswith(f", {name}") for what in whats(rows)), name


def test_parts_that_planners_share_are_measured_once(planner):
    other = planner.with_parts(eta=own.always_forty)
    named = whats(bench({"one": planner, "same": planner.with_parts(), "own": other}, batches=(1,), **QUICK))
    parts = {what for what in named if what.startswith(("forecast", "ETA, 1 goal", "static"))}
    assert parts == {"forecast", "ETA, 1 goal", "ETA, 1 goal, own", "static planner's step"}


def test_a_planner_that_has_no_copy_for_inference_is_measured_as_it_is(planner):
    class Own(DynamicPlanner):
        def __init__(self, gain):
            super().__init__(own.stand_on_tensordict, own.straight_on, own.always_forty, search=own.meet_in_hundred)
            self.gain = gain

    rows = bench({"own": Own(1.0), "other": planner}, batches=(1,), **QUICK)
    failed = [row for row in rows if "error" in row]
    assert {(row["what"], row["implementation"]) for row in failed} >= {
        ("re-plan, own", "torchdyn_plan, for inference")
    }
    assert all(row["implementation"] == "torchdyn_plan, for inference" for row in failed)
    assert all("unexpected keyword argument" in row["error"] for row in failed)
    assert {"re-plan, own", "step that plans, own", "re-plan, other"} <= whats(row for row in rows if row not in failed)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_equal_weights_are_one_part_in_any_type_of_numbers(dtype):
    made = [untrained(own.stand_on_tensordict).to(dtype) for _ in range(2)]
    one, other = (replan_forms._identity(planner, "eta") for planner in made)
    assert one == other
    with torch.no_grad():
        next(made[1].eta.parameters()).add_(1.0)
    assert replan_forms._identity(made[1], "eta") != one
    assert replan_forms._identity(made[0], "static") != replan_forms._identity(made[1], "static")


def test_a_planner_of_another_type_of_numbers_is_measured_in_its_own():
    made = untrained(TASK.static_planner()).double()
    rows = bench(made, batches=(2,), **QUICK)
    assert "step between plans, planner" in whats(rows)
    assert not any("error" in row for row in rows)
    seen = moments(TASK, made)
    assert seen.planning["target_history"].dtype == made(seen.planning.copy())["action"].dtype == torch.float64


class Uneven(ReplanSchedule):
    """Plans at another step in each half of the table."""

    def start(self, observation):
        clock = super().start(observation)
        return clock._replace(countdown=clock.countdown + 4 * (observation.target_pos[..., 0] > 0.0))


@pytest.mark.parametrize("schedule", [Uneven(), EventSchedule(), ReplanSchedule.every(1, first_step=0)])
def test_a_schedule_of_one_s_own_is_measured_where_it_plans(schedule):
    made = own.make_planner(schedule=schedule)
    rows = bench(made, batches=(5,), **QUICK)
    assert "step that plans, planner" in whats(rows)
    assert not any("error" in row for row in rows)
    seen = moments(TASK, made)
    assert made(seen.planning.copy())["plan", "replanned"].all()
    assert len(seen.planning) == 64
    if isinstance(schedule, Uneven):
        assert set(seen.planning["step_count"].flatten().tolist()) == {13, 17}
        assert not made(seen.between.copy())["plan", "replanned"].any()


def test_a_planner_that_never_plans_is_measured_in_its_steps_and_its_replan():
    never = own.make_planner(schedule=ReplanSchedule(first_step=10**6))
    named = whats(bench({"lazy": never}, batches=(2,), **QUICK))
    assert {"re-plan, lazy", "step between plans, lazy"} <= named
    assert "step that plans, lazy" not in named


@pytest.mark.parametrize("plan", [TASK.planner("pursuit"), TASK.static_planner("ik"), own.stand_on_tensordict])
def test_a_planner_that_plans_nothing_is_measured_in_its_step_alone(plan):
    rows = bench({"it": plan}, batches=(3,), **QUICK)
    assert names_of(rows) == [("step, it", "torchdyn_plan")]
    assert rows[0]["max_error"] < 1e-5


def test_plans_that_come_late_are_measured_for_the_moment_of_their_use():
    path = own.straight_on(moments(TASK, own.PLANNER).planning["target_history"])
    seen = []

    def search(forecast, target_pos, eta, context):
        seen.append(target_pos)
        return own.meet_in_hundred(forecast, target_pos, eta)

    rows = bench(own.make_planner(search=search, delivery=Delayed(5)), batches=(64,), **QUICK)
    assert not any("error" in row for row in rows)
    assert any(len(one) == 64 and torch.allclose(one, path[:, 4]) for one in seen)


def test_every_step_that_plans_in_a_thread_orders_a_plan():
    orders = []

    class Noted(Background):
        def order(self, make, due, *others):
            orders.append(int(due.sum()))
            return super().order(make, due, *others)

    delivery = Noted(latency=1, deadline=3)
    rows = bench(own.make_planner(delivery=delivery), batches=(2,), **QUICK)
    delivery.close()
    assert not any("error" in row for row in rows)
    assert orders.count(2) >= 4  # calls that are timed, and one before


class Once(Delayed):
    """Takes one order and is busy from then on: what it remembers is its own."""

    def arrive(self, plan, state, observation):
        plan, busy = super().arrive(plan, state, observation)
        return plan, busy | ("ordered" in self.__dict__)

    def order(self, make, due, *others):
        if due.any():
            self.__dict__["ordered"] = True
        return super().order(make, due, *others)


def test_a_step_that_cannot_be_repeated_is_told_and_the_rest_is_measured():
    rows = bench(own.make_planner(delivery=Once(2)), batches=(2,), **QUICK)
    (row,) = [row for row in rows if "error" in row]
    assert row["what"] == "step that plans, planner"
    assert "not when it is repeated" in row["error"]
    assert row["median_us"] is row["max_error"] is None
    assert "re-plan, planner" in whats(rows)


def test_what_cannot_be_compiled_is_told_in_its_row_and_the_rest_is_measured(monkeypatch):
    monkeypatch.setitem(replan_forms.COMPILED, "cpu", {"backend": "eager"})

    def python(forecast, target_pos, eta, context):
        if forecast.path.sum() > 1e9:
            raise ArithmeticError
        return own.meet_in_hundred(forecast, target_pos, eta)

    rows = bench(own.make_planner(search=python), batches=(1, 2), **QUICK | {"compiled": True})
    compiled = {(row["what"], row["batch"]): row for row in rows if row["compiled"]}
    for batch in (1, 2):
        assert "error" not in compiled["forecast", batch]
        assert compiled["re-plan, planner", batch]["error"].startswith("Unsupported")
        assert compiled["re-plan, planner", batch]["median_us"] is None
    assert len([row for row in rows if "error" in row]) == 2
    assert len([row for row in rows if row["what"] == "re-plan, planner" and not row["compiled"]]) == 4


def test_a_run_that_is_killed_leaves_its_rows_and_another_takes_them_anew(tmp_path):
    out, told = tmp_path / "new" / "figures.json", []

    def show(row):
        told.append(row)
        content = json.loads(out.read_text())
        assert content["rows"][-1]["what"] == row["what"]
        assert not content["complete"]
        if len(told) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench(own.PLANNER, batches=(1,), out=out, show=show, **QUICK)
    assert len(json.loads(out.read_text())["rows"]) == 3
    rows = bench(own.PLANNER, batches=(2,), out=out, **QUICK)
    content = json.loads(out.read_text())
    assert content.keys() == {"config", "machine", "versions", "commit", "complete", "rows"}
    assert content["complete"]
    assert content["rows"] == rows
    assert {row["batch"] for row in rows} == {2}
    assert content["config"]["planners"] == {"planner": "trapper"}


def test_threads_are_set_for_the_run_alone(tmp_path):
    before, seen = torch.get_num_threads(), set()

    def search(*values):
        seen.add(torch.get_num_threads())
        return own.meet_in_hundred(*values)

    rows = bench(own.make_planner(search=search), batches=(1,), threads=before + 1, **QUICK)
    assert seen == {before + 1} == {row["threads"] for row in rows}
    assert torch.get_num_threads() == before
    with pytest.raises(InputError, match="cannot act"):
        bench(lambda td: 1 / 0, batches=(1,), threads=before + 1, **QUICK)
    assert torch.get_num_threads() == before


def test_planners_stay_as_they_were():
    made = untrained(TASK.static_planner()).train()
    bench(made, batches=(1,), **QUICK)
    assert made.training
    assert made.static.training == made.forecaster.training


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"device": "gpu"}, "device 'gpu' cannot be used"),
        ({"device": "meta"}, "device 'meta' cannot be used"),
        ({"batches": ()}, "batches must name at least one number of rows"),
        ({"batches": (1, 0)}, "batches must be >= 1, got 0"),
        ({"seconds": -1.0}, "seconds must be >= 0"),
        ({"threads": -1}, "threads must be >= 0"),
        ({"task": "traper"}, "unknown task 'traper'"),
    ],
)
def test_a_mistake_is_told_before_anything_runs(given, message):
    def planner(tensordict):
        raise AssertionError("a planner acted")

    with pytest.raises(InputError, match=re.escape(message)):
        bench(planner, **given)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_told():
    with pytest.raises(InputError, match="device 'cuda' cannot be used"):
        bench(own.PLANNER, device="cuda")


def test_rows_that_depend_on_their_batch_show_as_an_error():
    goal = torch.arange(12.0).view(4, 3)

    def once(values):
        return (values - values.mean(dim=0),)

    def twice(values):
        return (values * 2.0,)

    assert max_error(once, once, (goal,)) > 1e-3
    assert max_error(twice, once, (goal,)) > 1e-3
    assert max_error(twice, twice, (goal,)) == 0.0


def test_values_that_are_no_numbers_are_equal_to_themselves_alone():
    goal = torch.tensor([[1.0], [torch.inf], [torch.nan]])

    def same(values):
        return (values,)

    def finite(values):
        return (values.nan_to_num(0.0, 0.0),)

    assert max_error(same, same, (goal,)) == 0.0
    assert max_error(same, finite, (goal,)) == max_error(finite, same, (goal,)) == torch.inf


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
        part = parts[what]
        inputs = part.inputs(seen)
        calls.clear()
        part.call(*inputs)
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
