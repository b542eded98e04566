"""Actor and critic: shapes, bounds, features, weights."""

import pytest
import torch

from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.nets import Actor, Critic, ETANetwork, PolicyConfig


@pytest.fixture
def actor() -> Actor:
    torch.manual_seed(0)
    actor = Actor(hidden=16, layers=2)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    actor.features.set_statistics(torch.randn(50, 15), torch.randn(50, 3))
    return actor


@pytest.mark.parametrize("batch", [(), (1,), (4, 5)])
def test_actions_are_within_bounds_for_any_batch(actor: Actor, batch: tuple[int, ...]) -> None:
    action = actor(5 * torch.randn(*batch, 15), torch.randn(*batch, 3))
    assert action.shape == (*batch, 6)
    assert (action.abs() <= 1).all()


def test_a_batch_is_its_rows(actor: Actor) -> None:
    state, goal = torch.randn(7, 15), torch.randn(7, 3)
    rows = torch.stack([actor(*row) for row in zip(state, goal, strict=True)])
    torch.testing.assert_close(actor(state, goal), rows)


def test_features_are_what_they_say(actor: Actor) -> None:
    state, goal = torch.zeros(15), torch.tensor([0.3, 0.4, 1.2])
    raw = actor.features.raw(state, goal)
    torch.testing.assert_close(raw[15:21], torch.cat([goal, goal]))
    torch.testing.assert_close(raw[21:24], torch.tanh(goal / 0.05))
    torch.testing.assert_close(raw[24:], torch.tensor([0.5, 1.3]))


def test_statistics_make_features_of_unit_size() -> None:
    actor = Actor()
    state, goal = 3 + 5 * torch.randn(400, 15), torch.randn(400, 3) - 2
    actor.features.set_statistics(state, goal)
    features = actor.features(state, goal)
    torch.testing.assert_close(features.mean(0), torch.zeros(26), atol=1e-4, rtol=0)
    torch.testing.assert_close(features.std(0)[:21], torch.ones(21), atol=1e-4, rtol=0)


def test_gradients_are_right_and_finite_at_the_goal() -> None:
    actor = Actor(hidden=8, layers=1, near=0.5).double()
    state = torch.randn(3, 15, dtype=torch.float64, requires_grad=True)
    goal = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(actor, (state, goal))
    at_goal = state.detach()[:, 12:15].clone().requires_grad_()
    actor(state.detach(), at_goal).sum().backward()
    assert torch.isfinite(at_goal.grad).all()


def test_value_depends_on_the_action() -> None:
    critic = Critic(PolicyConfig(hidden=16))
    state, goal, action = torch.randn(4, 15), torch.randn(4, 3), torch.rand(2, 4, 6)
    first, second = (critic(state, goal, one) for one in action)
    assert first.shape == (4, 1)
    assert not torch.allclose(first, second)


def test_weights_go_to_a_file_and_back(actor: Actor, tmp_path) -> None:
    actor.save_pretrained(tmp_path)
    copy = Actor.from_pretrained(tmp_path)
    state, goal = torch.randn(3, 15), torch.randn(3, 3)
    assert torch.equal(actor(state, goal), copy(state, goal))
    with pytest.raises(WeightsError, match="holds Actor, expected ETANetwork"):
        ETANetwork.from_pretrained(tmp_path / "policy.safetensors")


@pytest.mark.parametrize(
    ("state", "goal", "message"),
    [
        (torch.zeros(2, 14), torch.zeros(2, 3), "robot_state"),
        (torch.zeros(2, 15), torch.zeros(2, 2), "goal"),
        (torch.full((2, 15), float("nan")), torch.zeros(2, 3), "robot_state"),
    ],
)
def test_refuses_what_does_not_fit(actor: Actor, state: torch.Tensor, goal: torch.Tensor, message: str) -> None:
    with pytest.raises(InputError, match=message):
        actor(state, goal)


@pytest.mark.parametrize("settings", [{"hidden": 0}, {"tool_slice": (13, 15)}, {"near": 0.0}])
def test_refuses_impossible_sizes(settings: dict) -> None:
    with pytest.raises(InputError, match=next(iter(settings))):
        PolicyConfig(**settings)
