"""What all planners have in common: types of numbers, autocast, empty batches, `torch.vmap`."""

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.planners.kinds import DYNAMIC, FOR_INFERENCE, PLANNERS, ROWS, observe
from tests.planners.toy import NO_MEMORY
from torchdyn_plan.planners import DynamicPlanner
from torchdyn_plan.planners.memory import Remembering
from torchdyn_plan.planners.planner import observe as observation_of

pytestmark = [pytest.mark.filterwarnings(NO_MEMORY), pytest.mark.usefixtures("no_gradients")]
HALVES = torch.float16, torch.bfloat16
WRITTEN = ("action", "goal", "arrival_steps")


@pytest.fixture
def no_gradients():
    with torch.no_grad():
        yield


@pytest.fixture(scope="module", params=PLANNERS)
def case(request):
    task, make = PLANNERS[request.param]
    return task, make()


def convert(td, dtype):
    return td.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)


def act(planner, td):
    """What ``planner`` writes in two steps, without a change to ``td``: its plan, and what it does about it next."""
    written = []
    td = td.clone()
    for _ in range(2):
        td = planner(td)
        written.append({key: td[key].clone() for key in WRITTEN if key in td})
        td["step_count"] += 1
    return written


def assert_close(found, expected, tolerance=2e-5):
    for one, other in zip(found, expected, strict=True):
        assert one.keys() == other.keys()
        for key in one:
            value = one[key].to(other[key].dtype)
            torch.testing.assert_close(
                value, other[key], rtol=0.0, atol=tolerance, msg=lambda text, k=key: f"{k}: {text}"
            )


def test_float64_goes_in_and_comes_out(case):
    task, planner = case
    td = observe(task)
    found = act(planner, convert(td, torch.float64))
    for written in found:
        assert {value.dtype for key, value in written.items() if key != "arrival_steps"} == {torch.float64}
    assert_close(found, act(planner, td))


def test_states_that_numpy_made_do_for_any_planner(case):
    task, planner = case
    td = observe(task)
    entries = {
        key: np.asarray(value) for key, value in convert(td, torch.float64).items() if isinstance(value, torch.Tensor)
    }
    assert entries["target_pos"].dtype == np.float64
    made = TensorDict({key: torch.as_tensor(value) for key, value in entries.items()}, batch_size=td.batch_size)
    assert_close(act(planner, made), act(planner, td))


@pytest.mark.parametrize("key", ["target_history", "robot_state", "joint_pos", "tool_pos", "target_pos", "goal"])
def test_types_may_be_mixed(case, key):
    task, planner = case
    td = observe(task)
    assert_close(act(planner, td.clone().set(key, td[key].double())), act(planner, td))


def test_a_planner_in_float64_plans_the_same(case):
    task, planner = case
    exact, td = copy.deepcopy(planner).double(), observe(task)
    expected = act(planner, td)
    whole = act(exact, convert(td, torch.float64))
    assert whole[0]["action"].dtype == torch.float64
    assert_close(whole, expected, 1e-4)
    single = act(exact, td)
    assert single[0]["action"].dtype == torch.float32
    assert_close(single, expected, 1e-4)


@pytest.mark.parametrize("dtype", HALVES)
def test_a_planner_in_half_precision_acts(case, dtype):
    task, planner = case
    found = act(copy.deepcopy(planner).to(dtype), observe(task))
    for written, expected in zip(found, act(planner, observe(task)), strict=True):
        assert written["action"].dtype == torch.float32
        assert bool(written["action"].isfinite().all())
        assert written["action"].shape == expected["action"].shape


@pytest.mark.parametrize("dtype", HALVES)
def test_half_precision_that_comes_in_is_planned_with_in_float32(case, dtype):
    task, planner = case
    td = convert(observe(task), dtype)
    found, expected = act(planner, td), act(planner, convert(td, torch.float32))
    step = 4e-3 if dtype == torch.float16 else 3e-2
    assert_close([found[0]], [expected[0]], step)
    if isinstance(planner, DynamicPlanner):
        assert found[0]["goal"].dtype == torch.float32


@pytest.mark.parametrize("dtype", HALVES)
def test_autocast_changes_nothing(case, dtype):
    task, planner = case
    td = observe(task)
    expected = act(planner, td)
    with torch.autocast("cpu", dtype=dtype):
        found = act(planner, td)
    assert_close(found, expected, 0.0)


def test_an_empty_batch_is_planned_for(case):
    task, planner = case
    td = observe(task)
    full = act(planner, td)
    for written, expected in zip(act(planner, td[:0]), full, strict=True):
        assert {key: tuple(value.shape) for key, value in written.items()} == {
            key: (0, *value.shape[1:]) for key, value in expected.items()
        }
    nested = act(planner, td[:0].reshape(3, 0) if task == "trapper" else td[:0].reshape(0, 2))
    assert nested[0]["action"].shape[-1] == full[0]["action"].shape[-1]


@pytest.mark.parametrize("of", [torch.float32, torch.float64, torch.int32, torch.int16])
def test_steps_may_be_counted_in_any_type(case, of):
    task, planner = case
    td = observe(task)
    assert_close(act(planner, td.clone().set("step_count", td["step_count"].to(of))), act(planner, td), 0.0)


def test_vmap_is_the_batch(case):
    task, planner = case
    td = observe(task)
    expected = act(planner, td)

    def written(rows):
        found = act(planner, rows)
        return tuple(tuple(step[key] for key in WRITTEN if key in step) for step in found)

    names = list(expected[0])
    for mapped, batch in (
        (torch.vmap(written), (ROWS,)),
        (torch.vmap(written), (2, 3)),
        (torch.vmap(torch.vmap(written)), (2, 3)),
    ):
        found = mapped(td.reshape(*batch))
        steps = [
            dict(zip(names, (value.reshape(ROWS, *value.shape[len(batch) :]) for value in step), strict=True))
            for step in found
        ]
        assert_close(steps, expected, 1e-5)


@pytest.mark.parametrize("name", [*DYNAMIC, *FOR_INFERENCE])
def test_planning_alone_is_pure_under_vmap(name):
    planner, td = PLANNERS[name][1](), observe("trapper")
    seen = observation_of(td, planner.forecaster)
    held = planner.memory.slots[1].start(seen)
    expected = planner.replan(seen, held)
    for new, old in zip(torch.vmap(planner.replan)(seen, held), expected, strict=True):
        torch.testing.assert_close(new.to(old.dtype), old, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["wait and drop", "on events", "delayed", "soft corner"])
def test_parts_under_vmap(name):
    planner, td = PLANNERS[name][1](), observe("trapper")
    seen = observation_of(td, planner.forecaster)
    held = planner.memory.slots[1].start(seen)
    plan = planner.replan(seen, held)
    state = planner.maneuver.start(seen)
    for function, arguments in (
        (lambda p, s: planner.forecaster.predict(*s.seen).path, (plan, seen)),
        (lambda p, s: p.older().held(p.reachable, s.tool_pos).goal, (plan, seen)),
        (lambda p, s: p.status(p.age, p.age + 1), (plan, seen)),
        (lambda p, s: p.ahead(min(4, p.path.shape[-2])), (plan, seen)),
        (lambda p, s, m: planner.maneuver(p, s, ~p.usable, m), (plan, seen, state)),
        (
            lambda p, s: planner.schedule.tick(
                planner.schedule.start(s), s, p, busy=None, late=lambda rows: 0.0 * rows
            ),
            (plan, seen),
        ),
    ):
        if name == "soft corner" and arguments is not None and planner.memory.path_length == 0:
            continue
        expected, found = function(*arguments), torch.vmap(function)(*arguments)
        for one, other in zip(
            torch.utils._pytree.tree_leaves(found), torch.utils._pytree.tree_leaves(expected), strict=True
        ):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


def test_a_primer_primes_in_the_type_of_the_environment():
    planner = PLANNERS["wait and drop"][1]()
    assert isinstance(planner, Remembering)
    spec = planner.make_tensordict_primer(dtype=torch.float64).primers["plan"]
    assert spec["goal"].dtype == torch.float64
    assert spec["age"].dtype == torch.int64
    assert planner.make_tensordict_primer().primers["plan"]["goal"].dtype == torch.float32
