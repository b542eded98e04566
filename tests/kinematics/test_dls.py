import math

import pytest
import torch
from torch.autograd import gradcheck

from torchdyn_plan.kinematics import Arm, dls_step, limited_step, square_turn, upright_error

DAMPING = 0.02


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def turn(axis, angle):
    """Rotation matrices about a world axis, (M,) -> (M, 3, 3)."""
    cross = torch.linalg.cross(torch.eye(3, dtype=angle.dtype)[axis].expand(3, 3), torch.eye(3, dtype=angle.dtype)).T
    return torch.linalg.matrix_exp(angle[:, None, None] * cross)


@pytest.mark.parametrize("joints", [4, 6, 7])
def test_step_is_that_of_the_normal_equations(joints):
    jacobian, error = random(50, 6, joints), random(50, 6, seed=1)
    gram = jacobian @ jacobian.mT + DAMPING**2 * torch.eye(6, dtype=torch.float64)
    expected = jacobian.mT @ torch.linalg.solve(gram, error.unsqueeze(-1))
    torch.testing.assert_close(dls_step(jacobian, error, DAMPING), expected.squeeze(-1), rtol=1e-7, atol=1e-7)


def test_step_minimises_the_damped_squares():
    jacobian, error = random(30, 6, 6), random(30, 6, seed=1)
    step = dls_step(jacobian, error, DAMPING)
    residual = error - (jacobian @ step.unsqueeze(-1)).squeeze(-1)
    slope = (jacobian.mT @ residual.unsqueeze(-1)).squeeze(-1) - DAMPING**2 * step
    assert slope.abs().max() < 1e-9


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_damping_bounds_the_step_near_and_at_singular_configurations(dtype):
    arm = Arm.ur5(dtype=dtype)
    q = torch.tensor([0.3, -1.0, 0.0, 0.4, 0.0, 0.2], dtype=dtype)
    q = q + random(400, 6, dtype=dtype) * torch.logspace(-8, 0, 400, dtype=dtype)[:, None]
    q[0] = 0.0
    error = random(400, 6, seed=1, dtype=dtype)
    step = dls_step(arm.pose_and_jacobian(q)[1], error, DAMPING)
    share = step.norm(dim=-1) * 2 * DAMPING / error.norm(dim=-1)
    assert share.isfinite().all()
    assert share.max() <= 1.0 + 1e-3


def test_the_bound_is_met_where_a_singular_value_equals_the_damping():
    step = dls_step(DAMPING * torch.eye(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64), DAMPING)
    torch.testing.assert_close(step, torch.full((6,), 1 / (2 * DAMPING), dtype=torch.float64))


def test_a_rank_deficient_jacobian_has_a_finite_gradient():
    jacobian = random(6, 6)
    jacobian[0] = 0.0
    jacobian, error = jacobian.requires_grad_(), random(6, seed=1).requires_grad_()
    assert gradcheck(lambda j, e: dls_step(j, e, 0.1), (jacobian, error))


def test_batch_equals_loop():
    jacobian, error = random(2, 3, 6, 6), random(2, 3, 6, seed=1)
    step = dls_step(jacobian, error, DAMPING)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(step[i, j], dls_step(jacobian[i, j], error[i, j], DAMPING))


def test_upright_error_vanishes_for_the_four_square_poses_alone():
    down = turn(0, torch.tensor([math.pi], dtype=torch.float64))
    yaw = torch.arange(-8, 9, dtype=torch.float64) * math.pi / 8
    error = upright_error(turn(2, yaw) @ down)
    zero = error.abs().amax(dim=-1) < 1e-9
    assert zero.tolist() == [i % 4 == 0 for i in range(17)]


def test_a_quarter_turn_about_z_changes_nothing():
    rotation = turn(2, random(40)) @ turn(0, math.pi + 0.3 * random(40, seed=1)) @ turn(1, 0.3 * random(40, seed=2))
    error = upright_error(rotation)
    # The tool's own quarter turn: its z axis, and so the tilt, stays.
    turned = upright_error(rotation @ turn(2, torch.full((40,), math.pi / 2, dtype=torch.float64)))
    torch.testing.assert_close(turned[..., :2], error[..., :2])
    upright = turn(2, random(40)) @ turn(0, torch.full((40,), math.pi, dtype=torch.float64))
    other = upright @ turn(2, torch.full((40,), math.pi / 2, dtype=torch.float64))
    torch.testing.assert_close(upright_error(other), upright_error(upright), atol=1e-9, rtol=0)
    assert upright_error(upright)[..., 2].abs().max() <= math.pi / 4 + 1e-9


def test_turning_by_the_yaw_error_makes_the_box_square():
    upright = turn(2, random(40)) @ turn(0, torch.full((40,), math.pi, dtype=torch.float64))
    square = turn(2, upright_error(upright)[..., 2]) @ upright
    assert upright_error(square).abs().max() < 1e-9


@pytest.mark.parametrize("axis", [0, 1])
def test_a_small_tilt_is_undone_by_its_error(axis):
    tilt = torch.tensor([-1e-4, 1e-4], dtype=torch.float64)
    rotation = turn(axis, tilt) @ turn(0, torch.full((2,), math.pi, dtype=torch.float64))
    expected = torch.zeros(2, 3, dtype=torch.float64)
    expected[:, axis] = -tilt
    torch.testing.assert_close(upright_error(rotation), expected, atol=1e-8, rtol=0)


def test_limited_step_keeps_direction_gain_and_limits():
    step, limit = random(200, 6) * torch.logspace(-3, 1, 200, dtype=torch.float64)[:, None], torch.rand(6) + 0.5
    limit = limit.double() * 0.05
    short = limited_step(step, limit, 0.25)
    share = short / step
    assert (share.amax(dim=-1) - share.amin(dim=-1)).max() < 1e-12
    assert share.min() > 0
    assert share.max() <= 0.25 + 1e-12
    use = (short.abs() / limit).amax(dim=-1)
    assert use.max() <= 1.0 + 1e-12
    # Either the gain or a joint's limit decides, never less than both allow.
    assert torch.maximum(use, share[:, 0] / 0.25).min() > 1.0 - 1e-9


def test_no_step_stays_no_step():
    assert limited_step(torch.zeros(3, 6), torch.ones(6), 0.2).tolist() == torch.zeros(3, 6).tolist()


def test_a_square_tool_turns_to_the_nearest_axis():
    yaw = torch.tensor([-3.0, -0.8, -0.1, 0.0, 0.3, 0.7, 0.9, 1.5, 3.1], dtype=torch.float64)
    turn = square_turn(yaw.cos(), yaw.sin())
    quarters = (yaw + turn) / (math.pi / 2)
    torch.testing.assert_close(quarters, quarters.round(), atol=1e-9, rtol=0)
    assert turn.abs().max() <= math.pi / 4 + 1e-9
