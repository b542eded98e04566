"""Quaternions against the rotations that they stand for."""

import torch
from torch.testing import assert_close

from torchdyn_plan.kinematics import quat_between, quat_matrix, quat_multiply
from torchdyn_plan.kinematics.quaternions import is_turned, matrix_quat
from torchdyn_plan.kinematics.targets import rotation_matrix

DRAW = torch.Generator().manual_seed(0)


def quats(*batch):
    return torch.nn.functional.normalize(torch.randn(*batch, 4, generator=DRAW, dtype=torch.float64), dim=-1)


def test_a_product_is_that_of_the_matrices():
    first, second = quats(5, 1), quats(7)
    assert_close(quat_matrix(quat_multiply(first, second)), quat_matrix(first) @ quat_matrix(second))


def test_a_matrix_is_that_of_its_axis_and_angle_whatever_the_length():
    vector = torch.randn(20, 3, generator=DRAW, dtype=torch.float64)
    angle = vector.norm(dim=-1, keepdim=True)
    quat = torch.cat([(angle / 2).cos(), (angle / 2).sin() * vector / angle], dim=-1)
    assert_close(quat_matrix(3.0 * quat), rotation_matrix(vector))


def test_a_matrix_gives_its_quaternion_back_half_turns_too():
    half_turns = torch.eye(4, dtype=torch.float64)
    given = torch.cat([quats(50), half_turns])
    found = matrix_quat(quat_matrix(given))
    assert_close((found * given).sum(-1).abs(), torch.ones(54, dtype=torch.float64))


def test_the_least_turn_brings_one_direction_to_the_other_and_no_farther():
    start, end = torch.randn(2, 30, 3, generator=DRAW, dtype=torch.float64).unbind(0)
    end[0] = -2.0 * start[0]
    quat = quat_between(start, end)
    turned = (quat_matrix(quat) @ start.unsqueeze(-1)).squeeze(-1)
    assert_close(torch.nn.functional.normalize(turned, dim=-1), torch.nn.functional.normalize(end, dim=-1))
    cosine = torch.cosine_similarity(start, end, dim=-1)
    assert_close(2.0 * quat[:, 0] ** 2 - 1.0, cosine)


def test_zeros_say_nothing_and_turn_nothing():
    zero = torch.zeros(2, 4)
    assert not is_turned(zero).any()
    assert is_turned(quats(3)).all()
    assert_close(quat_matrix(zero), torch.eye(3).expand(2, 3, 3))
