"""Arms and solvers: autocast, half precision, empty batches, `torch.vmap`."""

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import (
    Arm,
    constraint_error,
    constraint_jacobian,
    dls_step,
    limited_step,
    solve_ik,
    upright_error,
)

HALVES = torch.float16, torch.bfloat16


@pytest.fixture(scope="module", params=["sines", "transforms"])
def arm(request):
    text = Arm.ur5(tool_length=0.1).part_settings()
    return Arm(**{**text, "form": request.param})


def positions(count):
    return 2.0 * torch.rand(count, 6, generator=torch.Generator().manual_seed(count)) - 1.0


def step_towards(arm, q, target, constraint):
    """Pose, Jacobian, error and step: everything that a step of inverse kinematics is made of."""
    pose, jacobian = arm.pose_and_jacobian(q)
    error = constraint_error(pose, target, constraint=constraint, symmetry=4 if constraint == "pose" else 1)
    rows = constraint_jacobian(jacobian, target, constraint=constraint)
    step = dls_step(rows, error, 0.02, preferred=-0.1 * q)
    return arm(q), pose, jacobian, error, limited_step(step, arm.speed_limit, 0.25), upright_error(pose[..., :3, :3])


@pytest.mark.parametrize("constraint", ["pose", "axis", "position"])
def test_autocast_changes_no_step(arm, constraint):
    q, target = positions(5), arm(positions(6)[:5])
    expected = step_towards(arm, q, target, constraint)
    for dtype in HALVES:
        with torch.autocast("cpu", dtype=dtype):
            found = step_towards(arm, q, target, constraint)
        assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("differentiable", [False, True])
def test_autocast_changes_no_solution(arm, dtype, differentiable):
    target, settings = arm(positions(6)), {"symmetry": 4, "differentiable": differentiable}
    expected = solve_ik(arm, target, **settings)
    assert bool((expected.status == 0).all())
    with torch.autocast("cpu", dtype=dtype):
        found = solve_ik(arm, target, **settings)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


@pytest.mark.parametrize("dtype", HALVES)
def test_an_arm_stays_in_float32(arm, dtype):
    made = Arm(**{**arm.part_settings(), "dtype": dtype})
    for half in (made, Arm(**arm.part_settings()).to(dtype)):
        assert {value.dtype for value in half.buffers()} == {torch.float32}
        assert torch.equal(half(positions(3)), arm(positions(3)))
        with pytest.raises(InputError, match=r"joint_pos is torch\.(b?float16), but the arm is torch\.float32"):
            half(positions(3).to(dtype))


def test_empty_batches(arm):
    for batch in ((0,), (0, 3), (3, 0)):
        q = torch.zeros(*batch, 6)
        pose, jacobian = arm.pose_and_jacobian(q)
        assert arm(q).shape == pose.shape == (*batch, 4, 4)
        assert jacobian.shape == (*batch, 6, 6)
        for found in step_towards(arm, q, pose, "pose"):
            assert found.shape[: len(batch)] == batch
        for differentiable in (False, True):
            result = solve_ik(arm, pose, differentiable=differentiable)
            assert result.q.shape == (*batch, 6)
            assert result.status.shape == batch
            assert result.residual.shape == (*batch, 2)


@pytest.mark.parametrize("constraint", ["pose", "axis", "position"])
def test_vmap_is_the_batch(arm, constraint):
    q, target = positions(6), arm(positions(6).flip(0))
    expected = step_towards(arm, q, target, constraint)

    def step(q, target):
        return step_towards(arm, q, target, constraint)

    for found in (
        torch.vmap(step)(q, target),
        [part.flatten(0, 1) for part in torch.vmap(step)(q.view(2, 3, 6), target.view(2, 3, 4, 4))],
    ):
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)
