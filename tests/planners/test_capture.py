"""A planner that knows how likely a capture is: where it goes, and how it is kept."""

import pytest
import torch

from tests.planners.toy import (
    HISTORY,
    NO_MEMORY,
    Straight,
    StraightArrival,
    assert_same,
    go_straight,
    make_planner,
    observation,
)
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import CaptureNetwork
from torchdyn_plan.planners import DynamicPlanner, ExactSearch

pytestmark = pytest.mark.filterwarnings(NO_MEMORY)

SEARCH = ExactSearch(stride=2, probability_weight=50.0, waiting_cost=0.1)


def planner(capture, **parts):
    return make_planner(search=SEARCH, capture=capture, **parts)


def network(seed=0):
    torch.manual_seed(seed)
    return CaptureNetwork(window=4, hidden=8)


def near_the_middle(path, goal, steps):
    return (-5.0 * goal[..., :2].square().sum(-1)).exp()


def test_it_goes_where_captures_are_likely():
    seen = observation((40,), step=3)
    # Targets that the robot can catch up with, on their way to the middle.
    place = seen["target_pos"].unsqueeze(-2)
    seen["target_history"] = place + 0.008 * place * torch.arange(HISTORY - 1.0, -1.0, -1.0).unsqueeze(-1)
    seen["tool_pos"] = seen["robot_state"] = seen["target_pos"] + 0.05
    blind, knowing = (planner(capture)(seen.clone())["goal"] for capture in (None, near_the_middle))
    away = [goal[:, :2].norm(dim=-1).mean().item() for goal in (blind, knowing)]
    assert away[1] < 0.95 * away[0]


def test_without_such_a_model_nothing_is_described_of_it():
    assert "capture" not in planner(None).part_settings()
    assert planner(network()).with_parts(capture=None).capture is None


def test_a_network_goes_where_its_planner_goes(tmp_path):
    kept = DynamicPlanner(go_straight(), Straight(), StraightArrival(), search=SEARCH, capture=network()).eval()
    kept.save_pretrained(tmp_path)
    own = {"static": go_straight(), "forecaster": Straight(), "eta": StraightArrival()}
    again = DynamicPlanner.from_pretrained(tmp_path, **own)
    seen = observation((6,), step=3)
    assert_same(again(seen.clone()), kept(seen.clone()))
    assert again.double().capture.head.weight.dtype == torch.float64
    assert "capture.head.weight" in kept.state_dict()


def test_bad_models_are_named():
    with pytest.raises(InputError, match=r"capture must be a CaptureModel or a function .* got 3"):
        planner(3)
