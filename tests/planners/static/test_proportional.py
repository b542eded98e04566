import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.static.proportional import ProportionalController


def act(tool_pos, goal, *, gain=20.0, action_size=4):
    td = TensorDict({"tool_pos": tool_pos, "goal": goal}, batch_size=goal.shape[:-1])
    return ProportionalController(gain=gain, action_size=action_size)(td)["action"]


def test_it_pulls_along_the_way_and_no_harder_than_it_may():
    action = act(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[1.01, 1.0, 3.5]]), gain=20.0)
    torch.testing.assert_close(action, torch.tensor([[0.2, -1.0, 1.0, 0.0]]))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_any_batch_and_action_size(batch):
    tool = torch.zeros(*batch, 3, dtype=torch.float64)
    assert act(tool, tool + 1.0, action_size=3).shape == (*batch, 3)
    assert act(tool, tool + 1.0).dtype == torch.float64


def test_an_action_has_as_many_entries_as_the_goal_unless_it_is_told():
    assert act(torch.zeros(4, 2), torch.ones(4, 2), action_size=None).tolist() == [[1.0, 1.0]] * 4
    assert act(torch.zeros(2), torch.ones(2), action_size=3).tolist() == [1.0, 1.0, 0.0]


def test_bad_input_is_named():
    tool = torch.zeros(2, 3)
    with pytest.raises(InputError, match="goal must have shape"):
        act(tool, torch.zeros(2, 2))
    with pytest.raises(InputError, match="goal must be finite"):
        act(tool, torch.full((2, 3), torch.nan))
    with pytest.raises(InputError, match="'goal'"):
        ProportionalController(gain=20.0)(TensorDict({"tool_pos": tool}, batch_size=[2]))
    with pytest.raises(InputError, match="gain"):
        ProportionalController(gain=-1.0)
    with pytest.raises(InputError, match="action_size"):
        ProportionalController(gain=20.0, action_size=1)
    with pytest.raises(InputError, match="action_size must be at least the 3"):
        act(tool, tool, action_size=2)
