"""What runs of a static planner teach: an arm that swings about a place for ever."""

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.training.runs import STATES_PER_RUN, RunPlan, first_as_near, record_runs

SIZE = 4


class Swinging:
    """Arms that reach goals on the left of x = 0 after ten steps, and never those on its right, but never rest."""

    def __init__(self, count: int) -> None:
        self.count, self.steps, self.goal = count, torch.zeros(count), None

    @property
    def robot_state(self) -> torch.Tensor:
        return torch.ones(self.count, SIZE)

    @property
    def tool_pos(self) -> torch.Tensor:
        """Comes 0.1 m a step nearer to its goals, and rests before them from step 4 on."""
        return torch.stack([(1.0 - 0.1 * self.steps).clamp(min=0.6), *torch.zeros(2, self.count)], dim=-1)

    def reset(self) -> None:
        self.steps[:] = 0

    def is_reached(self, goal: torch.Tensor) -> torch.Tensor:
        return (goal[:, 0] < 0) & (self.steps >= 10)

    def step(self, goal: torch.Tensor) -> None:
        same = self.goal is not None and (goal == self.goal).all(-1)
        self.steps = torch.where(torch.as_tensor(same), self.steps + 1, 1.0)
        self.goal = goal


def runs(*, comes_to_rest: bool) -> dict[str, torch.Tensor]:
    plan = RunPlan(
        goals=lambda count, draw: torch.rand(count, 3, generator=draw) - 0.5,
        at_rest=lambda state: (state == 0).all(-1),
        sequence=100,
        longest=40,
        redirected_within=20,
        redirected=0.0,
        comes_to_rest=comes_to_rest,
    )
    return record_runs(Swinging(16), plan, sequences=1, seed=0)


def test_a_restless_arm_that_is_given_up_never_arrives() -> None:
    found = runs(comes_to_rest=False)
    never, beyond = found["arrival"] < 0, found["goal"][:, 0] > 0
    assert torch.equal(never, beyond)
    assert never.any()
    assert (~never).any()


def test_otherwise_a_run_that_is_given_up_teaches_nothing() -> None:
    found = runs(comes_to_rest=True)
    assert (found["arrival"] >= 0).all()
    assert (found["goal"][:, 0] < 0).all()


def test_sequences_follow_one_another_with_draws_of_their_own() -> None:
    plan = RunPlan(
        goals=lambda count, draw: torch.rand(count, 3, generator=draw) - 0.5,
        sequence=60,
        longest=40,
        redirected_within=20,
    )
    one, two = (record_runs(Swinging(4), plan, sequences=count, seed=5) for count in (1, 2))
    count = len(one["run"])
    assert all(torch.equal(two[name][:count], one[name]) for name in one)
    assert not set(two["run"][count:].tolist()) & set(one["run"].tolist())


def test_a_run_that_is_longer_than_its_sequence_is_refused() -> None:
    with pytest.raises(InputError, match="longest"):
        RunPlan(goals=lambda count, draw: torch.zeros(count, 3), sequence=10, longest=11, redirected_within=5)


def test_a_goal_out_of_reach_is_timed_to_when_the_tool_is_as_near_as_it_comes() -> None:
    found = runs(comes_to_rest=False)
    arrived = found["arrival"] >= 0
    assert torch.equal(found["nearest"][arrived], found["arrival"][arrived])
    # The first sample of a run is at its start; the toy's counter, and so its tool, is one run behind at later ones.
    first = torch.arange(len(arrived)) % STATES_PER_RUN == 0
    assert set(found["nearest"][~arrived & first].tolist()) <= {0, 4}
    assert (found["nearest"][~arrived & first] == 4).any()
    assert (found["nearest"][~arrived & ~first] < 4).any()


def test_the_nearest_place_counts_and_not_the_distance() -> None:
    # A tool that descends a decimetre beside a goal a metre off comes hardly nearer to it by that.
    height = torch.tensor([0.1, 0.1, 0.06, 0.0, 0.0])
    level = torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0])
    path = torch.stack([level, torch.zeros(5), height], dim=-1).unsqueeze(1)
    goal = torch.tensor([[-1.0, 0.0, 0.0]])
    assert first_as_near(path, goal).tolist() == [3]
    assert first_as_near(path, goal, torch.tensor([4])).tolist() == [4]
