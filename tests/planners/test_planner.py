import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.planners.test_schedule import PAPER_STEPS
from tests.planners.toy import (
    HISTORY,
    NO_MEMORY,
    SCHEDULE,
    Straight,
    StraightArrival,
    assert_same,
    go_straight,
    make_planner,
    observation,
)
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import DynamicPlanner, search_corners
from torchdyn_plan.planners.memory import REPORTED

pytestmark = pytest.mark.filterwarnings(NO_MEMORY)


def test_plans_at_the_papers_steps_with_two_arrival_passes_each():
    eta, forecaster = StraightArrival(), Straight()
    planner = DynamicPlanner.paper(go_straight(), forecaster, eta)
    td = observation((2,))
    for step in range(500):
        td["step_count"].fill_(step)
        before = len(eta.shapes)
        td = planner(td)
        planned = step in PAPER_STEPS
        assert td["plan", "replanned"].tolist() == [planned, planned]
        assert eta.shapes[before:] == ([(2, 1, 3), (2, 4, 3)] if planned else [])
    assert len(forecaster.rows) == td["plan", "replans"][0] == 13


def test_before_the_first_plan_the_goal_is_where_the_tool_was_at_reset():
    planner, td = make_planner(), observation((2,))
    home = td["tool_pos"].clone()
    for step in range(3):
        td["step_count"].fill_(step)
        td["tool_pos"] = home + 0.1 * step
        planner(td)
        assert torch.equal(td["goal"], home)
        assert not td["arrival_steps"].any()
        assert td["plan", "countdown"].tolist() == [3 - step] * 2


def test_a_plan_is_the_search_on_the_forecast_and_is_kept_until_the_next():
    planner, td = make_planner(), observation((2,), step=3)
    eta = StraightArrival()
    forecast = Straight().path(td["target_history"])
    expected = search_corners(
        forecast, td["target_pos"], lambda goals: eta.arrival(td["robot_state"].unsqueeze(-2), goals)
    )
    planner(td)
    assert torch.equal(td["goal"], expected.goal)
    assert torch.equal(td["arrival_steps"], expected.arrival_steps)
    assert torch.equal(td["plan", "clamped"], expected.clamped)
    assert torch.equal(td["plan", "reachable"], expected.reachable)
    for later in range(1, 10):
        td["step_count"] += 1
        td["target_history"] = td["target_history"] + 1.0
        planner(td)
        assert torch.equal(td["goal"], expected.goal)
        assert torch.equal(td["arrival_steps"], (expected.arrival_steps - later).clamp_min(0))
    td["step_count"] += 1
    assert planner(td)["plan", "replanned"].all()


def test_the_same_tensordict_comes_back_and_the_goal_of_a_static_task_is_overruled():
    planner, td = make_planner(), observation((2,))
    td["goal"] = torch.full((2, 3), 9.0)
    assert planner(td) is td
    td["step_count"] += 1
    td["goal"] = torch.full((2, 3), 9.0)
    planner(td)
    assert torch.equal(td["goal"], td["tool_pos"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_a_batch_is_a_loop_over_its_rows(batch, dtype):
    whole = [observation(batch, step, dtype, seed=step) for step in range(20)]
    together, memory = [], TensorDict({}, batch)
    for td in whole:
        together.append(make_planner()(td.clone().update(memory)))
        memory = together[-1].select("plan")
    for row in range(max(1, int(torch.tensor(batch).prod()))):
        memory = TensorDict({}, ())
        for step, td in enumerate(whole):
            single = make_planner()(td.reshape(-1)[row].clone().update(memory))
            memory = single.select("plan")
            assert single["goal"].dtype == dtype
            assert_same(single, together[step].reshape(-1)[row])


def test_with_a_chunk_networks_see_blocks_of_that_many_rows():
    planner = make_planner(chunk=4)
    td = observation((6,), step=3)
    planner(td)
    assert planner.forecaster.rows == [4, 4]
    td["step_count"] = torch.tensor([0, 0, 3, 0, 0, 0])
    td["plan", "countdown"] = torch.ones(6, dtype=torch.int64)
    planner(td)
    assert planner.forecaster.rows == [4, 4, 4]


def test_networks_are_found_as_parameters_and_a_callable_may_stand_in_for_any_part():
    planner = make_planner()
    assert isinstance(planner.forecaster, nn.Module)
    assert "forecaster" in dict(planner.named_children())

    def stay(td):
        return td.set("action", torch.zeros_like(td["tool_pos"]))

    simple = DynamicPlanner.paper(stay, lambda history: history, StraightArrival(), schedule=SCHEDULE)
    assert not simple(observation((2,), step=3))["action"].any()


def test_keys_are_declared_and_written():
    planner, td = make_planner(), observation((2,))
    written = set(planner(td.clone()).keys(True, True)) - set(td.keys(True, True))
    assert written == set(planner.out_keys)
    memory = {key for key in written if isinstance(key, tuple)} - {("plan", name) for name in REPORTED}
    assert set(planner.in_keys) == set(td.keys()) | memory


def test_a_history_of_another_length_than_the_forecasters_is_refused():
    planner, td = make_planner(), observation((3,))
    planner.forecaster.history = HISTORY + 1
    with pytest.raises(InputError, match=r"target_history must have shape \(\*B, 7, 3\), got \(3, 6, 3\)"):
        planner(td)


def test_a_missing_key_is_named():
    with pytest.raises(InputError, match=r"DynamicPlanner reads the key 'target_pos'.*it has: .*tool_pos"):
        make_planner()(observation().exclude("target_pos"))


@pytest.mark.parametrize(("part", "key"), [("forecaster", "target_history"), ("eta", "robot_state")])
def test_data_on_another_device_than_the_networks_is_refused(part, key):
    networks = {
        "forecaster": Forecaster(history=HISTORY, hidden=8),
        "eta": ETANetwork(robot_state_size=3, tool_slice=(0, 3)),
    }
    networks[part].to("meta")
    with pytest.raises(InputError, match=rf"{key} is on cpu, but \w+ is on meta"):
        make_planner().with_parts(**networks)(observation((2,), step=3))


def test_an_unknown_pretrained_name_is_answered_with_those_there_are():
    with pytest.raises(InputError, match=r"unknown planner 'trapper-ki'.*did you mean 'trapper-ik'"):
        DynamicPlanner.from_pretrained("trapper-ki")


@pytest.mark.parametrize("chunk", [0, 2.5])
def test_a_bad_chunk_is_refused(chunk):
    with pytest.raises(InputError, match=f"chunk.*{chunk}"):
        make_planner(chunk=chunk)
