"""How a tool is turned where it meets its target, and where targets may be met."""

import math

import pytest
import torch
from torch.testing import assert_close

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import quat_matrix
from torchdyn_plan.planners import AgainstVelocity, CornerSearch, DynamicPlanner, MetWithin, PointPlanner, WithTarget

PATH = torch.zeros(4, 6, 3)


def flat(yaw):
    zero = torch.zeros_like(yaw)
    return torch.stack([(yaw / 2).cos(), zero, zero, (yaw / 2).sin()], dim=-1)


def test_the_tool_looks_down_on_a_flat_target_and_is_turned_with_it():
    yaw = torch.tensor([0.0, 0.7, -2.0, 3.0])
    turn = WithTarget()(PATH, PATH[:, 0], flat(yaw))
    assert turn.shape == (4, 6, 4)
    rotation = quat_matrix(turn[:, -1])
    assert_close(rotation[..., 2], torch.tensor([0.0, 0.0, -1.0]).expand(4, 3), atol=1e-6, rtol=0)
    assert_close(rotation[..., 0], torch.stack([yaw.cos(), yaw.sin(), 0 * yaw], -1), atol=1e-6, rtol=0)


@pytest.mark.parametrize("symmetry", [2, 4])
def test_of_turns_that_are_alike_the_one_that_faces_is_taken(symmetry):
    yaw = torch.linspace(-3.1, 3.1, 4)
    rotation = quat_matrix(WithTarget(symmetry=symmetry, facing=(0.0, 1.0, 0.0))(PATH, PATH[:, 0], flat(yaw))[:, 0])
    found = torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0])
    part = 2.0 * math.pi / symmetry
    away = torch.remainder(found - yaw + part / 2, part) - part / 2
    assert away.abs().max() < 1e-5
    assert (rotation[:, 1, 0] >= math.cos(math.pi / symmetry) - 1e-5).all()
    assert_close(rotation[..., 2, 2], -torch.ones(4))


def test_a_cup_looks_where_the_target_comes_from():
    draw = torch.Generator().manual_seed(0)
    moves = 0.01 * torch.randn(4, 6, 3, generator=draw)
    moves[0, 2], moves[1, 3] = torch.tensor([0.0, 0.0, 0.01]), torch.tensor([0.0, 0.0, -0.01])
    start = torch.randn(4, 3, generator=draw)
    history = torch.stack([start - 0.01, start], dim=1)
    turn = AgainstVelocity()(start.unsqueeze(1) + moves.cumsum(1), start, history)
    assert_close(turn.norm(dim=-1), torch.ones(4, 6))
    axis = quat_matrix(turn)[..., 2]
    assert_close(axis, -torch.nn.functional.normalize(moves, dim=-1), atol=1e-4, rtol=0)


def test_a_target_that_is_expected_to_rest_comes_as_it_moves_now():
    place = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    history = torch.stack([place - torch.tensor([[0.02, 0.0, 0.0], [0.0, 0.0, 0.0]]), place], dim=1)
    turn = AgainstVelocity()(place.unsqueeze(1), place, history)
    assert_close(quat_matrix(turn[0, 0])[:, 2], torch.tensor([-1.0, 0.0, 0.0]), atol=1e-6, rtol=0)
    assert not turn[1].any()


def test_the_turn_of_a_cup_has_derivatives_also_at_rest():
    place = torch.zeros(2, 3, dtype=torch.float64)
    path = torch.tensor([[[0.01, 0.0, 0.02], [0.02, 0.01, 0.03]], [[0.0, 0.0, 0.0], [0.0, 0.0, 0.01]]]).double()
    path.requires_grad_()
    turn = AgainstVelocity()(path, place, torch.stack([place, place], dim=1))
    turn.sum().backward()
    assert path.grad.isfinite().all()
    assert path.grad[0].abs().sum() > 0.0


def test_a_box_says_where_targets_are_met_and_loses_none():
    box = MetWithin(low=(0.0, -1.0, 0.0), high=(1.0, 1.0, 1.0))
    path = torch.tensor([[0.5, 0.0, 0.5], [0.5, 1.1, 0.5], [-0.1, 0.0, 0.5], [1.0, 1.0, 1.0]])
    assert box.forecast(path).tolist() == [False, True, True, False]
    assert not box.seen(path).any()
    with pytest.raises(InputError, match="box has 3 axes, but positions have 2"):
        box.forecast(path[:, :2])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WithTarget(quat=(0.0, 0.0, 0.0, 0.0)), "quat must be a quaternion"),
        (lambda: WithTarget(symmetry=0), "symmetry must be"),
        (lambda: AgainstVelocity(slowest=-1.0), "slowest must be"),
        (lambda: AgainstVelocity()(PATH, PATH[:, 0], PATH[..., :2]), "target_history must have shape"),
        (lambda: MetWithin(low=(0.0, 0.0), high=(1.0, -1.0)), "low must be below high"),
        (
            lambda: DynamicPlanner(
                PointPlanner(speed=1.0, acceleration=1.0, control_step=0.1), turn=WithTarget(), search=CornerSearch()
            ),
            "CornerSearch does not support a turn of the tool",
        ),
    ],
)
def test_what_cannot_be_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
