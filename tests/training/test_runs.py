"""What runs of a static planner teach: an arm that swings about a place for ever."""

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.training.runs import RunPlan, record_runs

SIZE = 4


class Swinging:
    """Arms that reach goals on the left of x = 0 after ten steps, and never those on its right, but never rest."""

    def __init__(self, count: int) -> None:
        self.count, self.steps, self.goal = count, torch.zeros(count), None

    @property
    def robot_state(self) -> torch.Tensor:
        return torch.ones(self.count, SIZE)

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
