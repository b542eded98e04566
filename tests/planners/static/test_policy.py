"""The learned policy as a static planner: protocol, period, memory."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchdyn_plan import keys
from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Actor
from torchdyn_plan.planners import PolicyPlanner
from torchdyn_plan.tasks.trapper.approach import BoxApproach


class Counting(nn.Module):
    """Acts by counting its calls, so that an action tells when it was chosen."""

    def __init__(self) -> None:
        super().__init__()
        self.config, self.calls = Actor().config, 0

    def forward(self, state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return torch.full((*goal.shape[:-1], 6), float(self.calls))


def seen(step: int, goal: float = 0.0, rows: int = 2) -> TensorDict:
    entries = {
        keys.ROBOT_STATE: torch.zeros(rows, 15),
        keys.GOAL: torch.full((rows, 3), goal),
        keys.STEP_COUNT: torch.full((rows,), step),
    }
    return TensorDict(entries, batch_size=[rows])


def play(planner: PolicyPlanner, steps: list[TensorDict]) -> list[list[float]]:
    actions, memory = [], None
    for tensordict in steps:
        if memory is not None:
            tensordict[keys.PLAN] = memory
        memory = planner(tensordict).get(keys.PLAN, None)
        actions.append(tensordict[keys.ACTION][:, 0].tolist())
    return actions


def test_every_step_by_default_and_nothing_to_remember() -> None:
    planner = PolicyPlanner(Counting())
    assert play(planner, [seen(0), seen(1)]) == [[1.0, 1.0], [2.0, 2.0]]
    assert planner.out_keys == [keys.ACTION]


def test_an_action_holds_for_the_period() -> None:
    rows = play(PolicyPlanner(Counting(), period=3), [seen(step) for step in range(7)])
    assert [row[0] for row in rows] == [1.0, 1.0, 1.0, 4.0, 4.0, 4.0, 7.0]


def test_a_new_goal_is_heard_at_once_row_by_row() -> None:
    steps = [seen(step) for step in range(3)]
    steps[1][keys.GOAL][1] = 0.5
    steps[2][keys.GOAL][1] = 0.5
    assert play(PolicyPlanner(Counting(), period=3), steps) == [[1.0, 1.0], [1.0, 2.0], [1.0, 2.0]]


def test_a_reset_starts_afresh() -> None:
    steps = [seen(0), seen(1)]
    steps[1][keys.STEP_COUNT][0] = 0
    assert play(PolicyPlanner(Counting(), period=5), steps)[1] == [2.0, 1.0]


def test_chunks_make_rows_independent_of_the_batch() -> None:
    torch.manual_seed(0)
    planner = PolicyPlanner(Actor(), chunk=4)
    tensordict = seen(0, rows=7)
    tensordict[keys.ROBOT_STATE] = torch.randn(7, 15)
    whole = planner(tensordict.clone())[keys.ACTION]
    rows = torch.cat([planner(tensordict[row : row + 1].clone())[keys.ACTION] for row in range(7)])
    assert torch.equal(whole, rows)


def test_says_what_is_missing() -> None:
    with pytest.raises(InputError, match="PolicyPlanner reads the key 'goal'"):
        PolicyPlanner(Actor())(seen(0).exclude(keys.GOAL))
    with pytest.raises(InputError, match="period"):
        PolicyPlanner(Actor(), period=0)


def test_goals_beyond_the_arm_are_brought_to_the_edge_of_its_reach() -> None:
    seen_goals = []
    approach = BoxApproach.of(TrapperScene())

    class Spy(Counting):
        def forward(self, state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
            seen_goals.append(goal)
            return super().forward(state, goal)

    tensordict = seen(0, rows=3)
    tensordict[keys.GOAL] = torch.tensor([[0.1, -0.3, 0.042], [0.2, 0.7, 0.105], [0.75, -0.8, 0.042]])
    PolicyPlanner(Spy(), approach=approach)(tensordict)
    (goal,) = seen_goals
    torch.testing.assert_close(goal[0], tensordict[keys.GOAL][0])
    base = torch.tensor(approach.base_pos[:2])
    assert float((goal[1, :2] - base).norm()) == pytest.approx(approach.max_radius, abs=1e-5)
    assert torch.equal(goal[:, 2], tensordict[keys.GOAL][:, 2])
    assert goal[:, :2].abs().max() <= approach.half_extent + 1e-6
