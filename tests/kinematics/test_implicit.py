import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from tests.kinematics.arms import ARMS, urdf
from torchdyn_plan.kinematics import Arm, Joint, solve_ik
from torchdyn_plan.kinematics.implicit import refine
from torchdyn_plan.kinematics.joint import rotation_about, transform

DOUBLE = torch.float64
ARM = Arm.ur5(dtype=DOUBLE)
SEVEN = Arm.from_urdf(urdf(ARMS["panda"]), tip="tool", dtype=DOUBLE)
REGULAR = torch.tensor([0.3, -1.0, 1.2, 0.4, 1.0, 0.2], dtype=DOUBLE)
NEAR_SINGULAR = torch.tensor([0.3, -1.0, 1.2, 0.4, 0.05, 0.2], dtype=DOUBLE)


def moved(pose, small):
    """``pose`` moved by ``small`` (6,), a twist about the place of the tool."""
    x, y, z = small[3:].unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    turned = torch.linalg.matrix_exp(skew) @ pose[:3, :3]
    top = torch.cat([turned, (pose[:3, 3] + small[:3]).unsqueeze(-1)], dim=-1)
    return torch.cat([top, pose[3:]], dim=0)


def solved(small, q, arm=ARM, **options):
    return solve_ik(arm, moved(arm(q), small), q0=q, rounds=(1,), differentiable=True, **options).q


def still():
    return torch.zeros(6, dtype=DOUBLE, requires_grad=True)


@pytest.mark.parametrize("q", [REGULAR, NEAR_SINGULAR], ids=["regular", "near singular"])
@pytest.mark.parametrize("constraint", ["pose", "axis", "position"])
def test_the_solution_has_its_derivative_in_the_target(q, constraint):
    assert gradcheck(lambda small: solved(small, q, constraint=constraint), still(), eps=1e-5, atol=2e-3, rtol=2e-3)


def test_the_derivative_is_the_inverse_jacobian():
    slope = torch.func.jacrev(solved)(still().detach(), REGULAR)
    torch.testing.assert_close(slope, torch.linalg.inv(ARM.pose_and_jacobian(REGULAR)[1]), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(torch.func.jacfwd(solved)(still().detach(), REGULAR), slope)


def test_the_second_derivative_holds_too():
    assert gradgradcheck(lambda small: solved(small, REGULAR), still(), eps=1e-4, atol=1e-2, rtol=1e-3)


def test_a_redundant_arm_follows_by_the_smallest_motion():
    q = torch.tensor([0.1, -0.5, 0.2, -1.5, 0.3, 1.0, 0.4], dtype=DOUBLE)
    slope = torch.func.jacrev(lambda small: solved(small, q, arm=SEVEN))(still().detach())
    torch.testing.assert_close(slope, torch.linalg.pinv(SEVEN.pose_and_jacobian(q)[1]), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("q", [(0.3, -1.0, 1.2, 0.4, 0.0, 0.2), (0.3, -1.0, 0.0, 0.4, 1.0, 0.2)])
def test_at_a_singularity_the_derivative_is_that_of_the_directions_that_are_left(q):
    q = torch.tensor(q, dtype=DOUBLE)
    slope = torch.func.jacrev(lambda small: refine(ARM, moved(ARM(q), small), q, torch.tensor(True)))(still().detach())
    expected = torch.linalg.pinv(ARM.pose_and_jacobian(q)[1], rtol=1e-6)
    torch.testing.assert_close(slope, expected, atol=1e-3, rtol=1e-3)


def test_a_joint_at_its_limit_does_not_move_and_the_others_do_what_they_can():
    limited = Arm.ur5(dtype=DOUBLE)
    limited.upper[2] = REGULAR[2]
    q = solved(still(), REGULAR, arm=limited)
    assert q[2] == REGULAR[2]
    slope = torch.func.jacrev(lambda small: solved(small, REGULAR, arm=limited))(still().detach())
    jacobian = ARM.pose_and_jacobian(REGULAR)[1].clone()
    jacobian[:, 2] = 0.0
    torch.testing.assert_close(slope, torch.linalg.pinv(jacobian), atol=1e-4, rtol=1e-4)
    assert (slope[2] == 0.0).all()


def test_rows_that_are_not_solved_have_derivative_zero_and_spoil_no_other():
    target = ARM(REGULAR).repeat(4, 1, 1)
    target[1, :3, 3] *= 9.0
    target[2] = math.nan
    target.requires_grad_()
    result = solve_ik(ARM, target, q0=REGULAR, differentiable=True)
    assert (result.status == 0).tolist() == [True, False, False, True]
    (slope,) = torch.autograd.grad(result.q.sum(), target)
    assert slope.isfinite().all()
    assert (slope[1:3] == 0.0).all()
    torch.testing.assert_close(slope[0], slope[3])
    assert slope[0].abs().max() > 0.1


def test_the_refined_solution_is_within_rounding_of_its_target():
    target = ARM(REGULAR + 0.3)
    q = solve_ik(ARM, target, q0=REGULAR, differentiable=True).q
    assert (ARM(q) - target).abs().max() < 1e-9


def test_the_solution_has_its_derivative_in_the_arm():
    axis, right = torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE), math.pi / 2
    q, turn = torch.tensor([0.3, -0.4, 0.5], dtype=DOUBLE), rotation_about(torch.tensor([1.0, 0.0, 0.0]), right)

    def arm(length):
        upper = transform(position=torch.stack([length, 0 * length, 0 * length]))
        offsets = [transform(), transform(turn), upper, transform(position=(0.3, 0.0, 0.0))]
        moving = [Joint(offset=offset, kind="revolute", axis=axis) for offset in offsets[:3]]
        return Arm([*moving, Joint(offset=offsets[3])], dtype=DOUBLE)

    start = torch.tensor(0.4, dtype=DOUBLE, requires_grad=True)
    place = arm(start.detach())(q)

    def solve(length):
        return solve_ik(arm(length), place, q0=q, constraint="position", rounds=(1,), differentiable=True).q

    assert gradcheck(solve, start, eps=1e-5, atol=1e-3)


def test_it_is_batched_by_vmap():
    small = 1e-3 * torch.randn(5, 6, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    target = torch.stack([moved(ARM(REGULAR), one) for one in small])
    result = solve_ik(ARM, target, q0=REGULAR)
    rows = torch.func.vmap(lambda t, q, s: refine(ARM, t, q, s))(target, result.q, result.status == 0)
    torch.testing.assert_close(rows, refine(ARM, target, result.q, result.status == 0))
