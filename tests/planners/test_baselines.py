import pytest
import torch
from tensordict import TensorDict

from tests.planners.toy import NO_MEMORY, SCHEDULE, SPEED, Straight, StraightArrival, ToyEnv, go_straight, observation
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import (
    DynamicPlanner,
    PlanStatus,
    RecordedFuture,
    TargetPursuit,
    oracle_trajectory,
    wait_at_end,
)

pytestmark = pytest.mark.filterwarnings(NO_MEMORY)


def test_pursuit_goes_where_the_target_is_at_every_step():
    data = ToyEnv(3).rollout(60, TargetPursuit(go_straight()), break_when_any_done=False)
    assert torch.equal(data["goal"], data["target_pos"])
    assert torch.equal(data["arrival_steps"], torch.zeros(3, 60, dtype=torch.int64))
    wanted = ((data["target_pos"] - data["tool_pos"]) / SPEED).clamp(-1, 1)
    assert torch.equal(data["action"], wanted)


def test_pursuit_declares_its_keys_and_names_a_missing_one():
    planner = TargetPursuit(go_straight())
    assert planner.in_keys == ["target_pos", "robot_state"]
    assert planner.out_keys == ["goal", "arrival_steps", "action"]
    with pytest.raises(InputError, match="TargetPursuit reads the key 'target_pos'"):
        planner(TensorDict({}, ()))


def test_the_one_who_waits_goes_to_the_end_of_each_forecast():
    planner = wait_at_end(go_straight(), Straight(), StraightArrival(), schedule=SCHEDULE)
    td = observation((2, 3), 3)
    td["target_history"] = 0.1 * td["target_history"]
    end = Straight().path(td["target_history"])[..., -1, :]
    near = planner(td.clone())
    assert torch.equal(near["goal"], end)
    assert (near["arrival_steps"] == 40).all()
    assert near["plan", "reachable"].all()
    td["target_history"] = td["target_history"] + 1e2
    far = planner(td.clone())
    assert not far["plan", "reachable"].any()
    assert planner.eta.shapes == [(6, 1, 3)] * 2


def test_the_recorded_future_begins_with_the_next_step_and_stops_at_its_end():
    recording = torch.arange(8.0)[:, None].expand(8, 3).expand(3, 8, 3)
    future = RecordedFuture(horizon=4).predict(recording, torch.tensor([0, 5, 30])).path
    assert future[..., 1].tolist() == [[1, 2, 3, 4], [6, 7, 7, 7], [7, 7, 7, 7]]


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_the_oracle_is_the_dynamic_planner_with_the_truth_as_forecast(batch):
    """Where the target really goes straight on, a forecaster that says so and the oracle agree at every step."""
    start, velocity = torch.rand(*batch, 1, 3), 0.02 * torch.rand(*batch, 1, 3)
    recording = start + velocity * torch.arange(100.0)[:, None]
    parts = {"schedule": SCHEDULE}
    oracle = oracle_trajectory(go_straight(), StraightArrival(), horizon=40, **parts)
    dynamic = DynamicPlanner.paper(go_straight(), Straight(horizon=40), StraightArrival(), **parts)
    a = observation(batch).exclude("target_history").set("target_future", recording)
    b = observation(batch)
    for step in range(5, 40):
        b["target_history"] = recording[..., step - 5 : step + 1, :]
        for td in (a, b):
            td["step_count"] = torch.full(batch, step)
            td["target_pos"] = recording[..., step, :]
        oracle(a), dynamic(b)
        torch.testing.assert_close(a["goal"], b["goal"], atol=1e-5, rtol=0)
        assert torch.equal(a["arrival_steps"], b["arrival_steps"])
        assert torch.equal(a["plan", "replanned"], b["plan", "replanned"])
    assert (a["plan", "replans"] > 3).all()


def test_the_oracle_never_looks_at_the_history_and_needs_a_recording():
    oracle = oracle_trajectory(go_straight(), StraightArrival(), schedule=SCHEDULE)
    assert "target_history" not in oracle.in_keys
    with pytest.raises(InputError, match="reads the key 'target_future'"):
        oracle(observation((2,)))
    recording = torch.zeros(2, 9, 3)
    recording[1, 4] = torch.nan
    half_broken = oracle(observation((2,), step=3).set("target_future", recording))
    assert half_broken["plan", "status"].tolist() == [PlanStatus.OK, PlanStatus.BAD_INPUT]


@pytest.mark.parametrize("horizon", [0, 1.5])
def test_a_bad_horizon_is_refused(horizon):
    with pytest.raises(InputError, match=f"horizon.*{horizon}"):
        oracle_trajectory(go_straight(), StraightArrival(), horizon=horizon)
