import math

import pytest
import torch
from torch.autograd import gradcheck

from torchdyn_plan.kinematics import Arm, constraint_error, constraint_jacobian, rotation_vector
from torchdyn_plan.kinematics.joint import rotation_about, transform

DOUBLE = torch.float64


def unit(count, seed=0):
    vector = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)
    return vector / vector.norm(dim=-1, keepdim=True)


def turns(axes, angles):
    return torch.stack([rotation_about(axis, float(angle)) for axis, angle in zip(axes, angles, strict=True)])


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 2e-3)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.1, 1.5, 3.0, 3.0784, 3.08, 3.1, math.pi - 1e-5, math.pi])
def test_rotation_vector_is_axis_times_angle_at_every_angle(angle, dtype, tolerance):
    axes = unit(50)
    vector = rotation_vector(turns(axes, [angle] * 50).to(dtype)).double()
    # After half a turn either direction of the axis is right.
    sign = (vector * axes).sum(dim=-1, keepdim=True).sign() if angle == math.pi else 1.0
    torch.testing.assert_close(vector, sign * axes * angle, atol=tolerance, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 2.5])
def test_rotation_vector_has_a_gradient(angle):
    start = turns(unit(1), [angle])[0]

    def turned(small):
        x, y, z = small.unbind(-1)
        zero = torch.zeros_like(x)
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
        return rotation_vector(start @ torch.linalg.matrix_exp(skew))

    assert gradcheck(turned, torch.zeros(3, dtype=DOUBLE, requires_grad=True), atol=1e-5)


@pytest.mark.parametrize("constraint", ["pose", "axis", "position"])
def test_rows_of_the_jacobian_move_along_the_error(constraint):
    arm = Arm.ur5(dtype=DOUBLE)
    q = torch.randn(20, 6, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    target = arm(q)
    for joint in range(6):
        moved = q.clone()
        moved[:, joint] += 1e-5
        slope = -constraint_error(arm(moved), target, constraint=constraint) / 1e-5
        rows = constraint_jacobian(arm.pose_and_jacobian(q)[1], target, constraint=constraint)
        torch.testing.assert_close(rows[..., joint], slope, atol=2e-5, rtol=0)


def test_yaw_is_free_for_an_axis():
    pose = transform(rotation_about(torch.tensor([0.0, 0.6, 0.8], dtype=DOUBLE), 0.7), (0.1, 0.2, 0.3))
    yaw = transform(rotation_about(torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE), 1.3))
    assert constraint_error(pose @ yaw, pose, constraint="axis").abs().max() < 1e-12
    flipped = pose @ transform(rotation_about(torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE), math.pi))
    assert constraint_error(flipped, pose, constraint="axis")[3:].norm() == pytest.approx(math.pi)


@pytest.mark.parametrize("symmetry", [2, 4, 6])
def test_parts_of_a_turn_are_nothing_to_a_symmetric_tool(symmetry):
    pose = transform(rotation_about(torch.tensor([0.0, 0.6, 0.8], dtype=DOUBLE), 0.7), (0.1, 0.2, 0.3))
    for part in range(-symmetry, symmetry + 1):
        yaw = transform(
            rotation_about(torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE), part * 2 * math.pi / symmetry + 0.1)
        )
        error = constraint_error(pose @ yaw, pose, symmetry=symmetry)
        assert error[3:].norm() == pytest.approx(0.1)
        assert error[:3].abs().max() < 1e-12
