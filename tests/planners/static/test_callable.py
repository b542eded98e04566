import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import CallablePlanner


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_the_function_is_given_its_keys_in_order(batch):
    td = TensorDict({"joint_pos": torch.rand(*batch, 6), "goal": torch.rand(*batch, 3)}, batch)
    planner = CallablePlanner(lambda q, goal: q - goal.repeat_interleave(2, -1), in_keys=("joint_pos", "goal"))
    assert planner(td) is td
    assert torch.equal(td["action"], td["joint_pos"] - td["goal"].repeat_interleave(2, -1))


def test_a_module_keeps_its_parameters():
    planner = CallablePlanner(nn.Bilinear(15, 3, 6))
    assert len(list(planner.parameters())) == 2
    td = TensorDict({"robot_state": torch.rand(4, 15), "goal": torch.rand(4, 3)}, [4])
    assert planner(td)["action"].shape == (4, 6)


@pytest.mark.parametrize(("result", "got"), [(torch.zeros(3, 6), r"\(3, 6\)"), (None, "NoneType")])
def test_actions_of_another_shape_are_refused(result, got):
    td = TensorDict({"robot_state": torch.rand(4, 15), "goal": torch.rand(4, 3)}, [4])
    with pytest.raises(InputError, match=rf"actions of shape \(4, A\), got {got}"):
        CallablePlanner(lambda *_: result)(td)


def test_what_cannot_be_called_is_refused():
    with pytest.raises(InputError, match="function must be callable, got 3"):
        CallablePlanner(3)
