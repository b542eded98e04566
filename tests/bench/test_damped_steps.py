import pytest
import torch

from tests.kinematics.arms import ARMS, configurations, urdf
from torchdyn_plan.bench.damped_steps import DampedSteps
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, compiled_pose_and_jacobian, dls_step

DOUBLE = torch.float64


def plainly(arm, q, target, steps):
    for _ in range(steps):
        pose, jacobian = arm.pose_and_jacobian(q)
        turn = 0.5 * torch.linalg.cross(pose[:, :3, :3], target[:, :3, :3], dim=-2).sum(dim=-1)
        q = q + dls_step(jacobian, torch.cat([target[:, :3, 3] - pose[:, :3, 3], turn], dim=-1), 0.02)
    return q


def problem(arm, count=50):
    q = configurations(count, arm.num_joints, dtype=arm.lower.dtype)
    return q, arm(q + 0.2 * configurations(count, arm.num_joints, seed=1, dtype=arm.lower.dtype, spread=1.0))


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_five_steps_are_the_plain_ones(name):
    arm = Arm.from_urdf(urdf(ARMS[name]), tip="tool", dtype=DOUBLE)
    q, target = problem(arm)
    torch.testing.assert_close(DampedSteps(arm)(q, target), plainly(arm, q, target, 5), atol=1e-9, rtol=0)


def test_batch_dimensions_are_free():
    arm = Arm.ur5(dtype=DOUBLE)
    q, target = problem(arm, 6)
    expected = DampedSteps(arm)(q, target)
    torch.testing.assert_close(DampedSteps(arm)(q.view(2, 3, 6), target.view(2, 3, 4, 4)).view(6, 6), expected)
    torch.testing.assert_close(DampedSteps(arm)(q[0], target[0]), expected[0])


def test_steps_towards_a_near_target_arrive():
    arm = Arm.ur5(dtype=DOUBLE)
    q = torch.tensor([[0.3, -1.0, 1.2, 0.4, 1.0, 0.2]], dtype=DOUBLE)
    target = arm(q + 0.2)
    assert (arm(DampedSteps(arm, steps=12)(q, target)) - target).abs().max() < 1e-4


@pytest.mark.parametrize("name", ["ur5", "scara", "gantry"])
def test_steps_column_by_column_are_the_others(name):
    arm = Arm.from_urdf(urdf(ARMS[name]), tip="tool", dtype=DOUBLE)
    q, target = problem(arm)
    steps = DampedSteps(arm)
    (columns,) = steps._columns(q.unbind(-1), target.flatten(1).unbind(-1))
    torch.testing.assert_close(torch.stack(columns, dim=-1), steps(q, target), atol=1e-7, rtol=0)


def test_compiled_steps_are_those_of_the_columns():
    """With a stand-in for the compiler, which takes long over these."""
    arm = Arm.ur5(dtype=DOUBLE)
    q, target = problem(arm)
    steps, compiled = DampedSteps(arm), DampedSteps(arm, compiled=True)

    def interpreted(*arguments):
        columns = compiled._fused.function(*(argument.unbind(-1) for argument in arguments))
        return [torch.stack(vector, dim=-1) for vector in columns]

    fused, compiled._fused = compiled._fused, interpreted
    interpreted.function = fused.function
    torch.testing.assert_close(compiled(q, target), steps(q, target), atol=1e-7, rtol=0)
    torch.testing.assert_close(compiled(q[0], target[0]), steps(q[0], target[0]), atol=1e-7, rtol=0)


@pytest.mark.parametrize("name", ["ur5", "panda", "scara", "gantry"])
def test_components_are_pose_and_jacobian(name):
    arm = Arm.from_urdf(urdf(ARMS[name]), tip="tool", dtype=DOUBLE)
    q = configurations(20, arm.num_joints)
    rotation, place, columns = arm.components(q.unbind(-1))
    pose, jacobian = arm.pose_and_jacobian(q)
    for i in range(3):
        for j, entry in enumerate((*rotation[i], place[i])):
            torch.testing.assert_close(torch.as_tensor(entry).double().expand(20), pose[:, i, j], atol=1e-12, rtol=0)
    for n, column in enumerate(columns):
        for i, entry in enumerate(column):
            value = torch.as_tensor(entry, dtype=DOUBLE).expand(20)
            torch.testing.assert_close(value, jacobian[:, i, n], atol=1e-12, rtol=0)


@pytest.mark.slow
def test_compiled_pose_and_jacobian_are_the_eager_ones():
    arm = Arm.from_urdf(urdf(ARMS["panda"]), tip="tool")
    q = configurations(37, 7, dtype=torch.float32)
    pose, jacobian = arm.pose_and_jacobian(q)
    compiled = compiled_pose_and_jacobian(arm)(q)
    torch.testing.assert_close(compiled[0], pose[:, :3], atol=2e-6, rtol=0)
    torch.testing.assert_close(compiled[1], jacobian, atol=2e-6, rtol=0)


def test_mistakes_are_named():
    steps = DampedSteps(Arm.ur5())
    with pytest.raises(InputError, match=r"joint_pos must have shape \(\*B, 6\)"):
        steps(torch.zeros(5), torch.eye(4))
    with pytest.raises(InputError, match=r"target must have shape \(\*B, 2, 4, 4\), got \(3, 4, 4\)"):
        steps(torch.zeros(2, 6), torch.zeros(3, 4, 4))
    with pytest.raises(InputError, match="steps must be >= 1"):
        DampedSteps(Arm.ur5(), steps=0)
