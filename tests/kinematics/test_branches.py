import dataclasses
import math

import pytest
import torch
from torch.autograd import gradcheck

from tests.kinematics.arms import ARMS, configurations, universal, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, Coupling, IKStatus, Joint, branches, solve_ik
from torchdyn_plan.kinematics.joint import rotation_about, transform

DOUBLE = torch.float64
TURN = 2.0 * math.pi
ARM = Arm.ur5(dtype=DOUBLE)


def chain(arm):
    return list(arm.part_settings()["joints"])


def anywhere(seed):
    """A pose, from random numbers."""
    random = torch.Generator().manual_seed(seed)
    axis, place = torch.randn(2, 3, generator=random, dtype=DOUBLE)
    return transform(rotation_about(axis / axis.norm(), 2.0 + seed), place)


def disguised(seed):
    """An arm of the family with another base and tool, other zeros of its joints, and some that turn the other way."""
    random = torch.Generator().manual_seed(seed)
    joints = [anywhere(seed), *chain(ARM)[:6]]
    joints[0] = Joint(offset=joints[0])
    for index in range(1, 7):
        joint = joints[index]
        zero = rotation_about(joint.axis, float(torch.randn((), generator=random)))
        sign = 1.0 if float(torch.rand((), generator=random)) > 0.5 else -1.0
        joints[index] = dataclasses.replace(joint, offset=joint.offset @ transform(zero), axis=sign * joint.axis)
    return Arm(joints, tool=anywhere(seed + 100), dtype=DOUBLE)


def whole_turns_off(way):
    return (way - TURN * (way / TURN).round()).abs().amax(dim=-1)


@pytest.mark.parametrize("arm", [ARM, *map(disguised, range(6))])
def test_all_that_is_valid_reaches_the_pose_and_the_own_position_is_among_it(arm):
    q = configurations(300, 6)
    found = branches(arm, arm(q))
    assert (arm(found.q) - arm(q).unsqueeze(1)).abs().amax(dim=(-2, -1))[found.valid].max() < 1e-9
    near = whole_turns_off(found.q - q.unsqueeze(1)).masked_fill(~found.valid, torch.inf)
    assert near.amin(dim=1).max() < 1e-6


def test_nothing_else_solves_it():
    target = ARM(configurations(20, 6, seed=2))
    # One round alone knows nothing of branches.
    others = solve_ik(ARM, target, rounds=(300,), solutions=12, position_tolerance=1e-6, rotation_tolerance=1e-6)
    solved = others.status == IKStatus.SOLVED
    assert solved.sum(dim=1).double().mean() > 5.0
    found = branches(ARM, target)
    near = whole_turns_off(others.q.unsqueeze(2) - found.q.unsqueeze(1)).masked_fill(~found.valid[:, None], torch.inf)
    assert near.amin(dim=2)[solved].max() < 1e-3
    assert torch.equal(solved.sum(dim=1), found.valid.sum(dim=1))


def test_single_precision_reaches_it_too_and_autocast_changes_nothing():
    arm = Arm.ur5()
    q = configurations(500, 6, dtype=torch.float32)
    found = branches(arm, arm(q))
    assert (arm(found.q) - arm(q).unsqueeze(1)).abs().amax(dim=(-2, -1))[found.valid].max() < 1e-4
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(branches(arm, arm(q)).q, found.q)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize(
    "special", [{4: 0.0}, {4: math.pi}, {2: 0.0}, {2: 0.0, 4: 0.0}, {1: -math.pi / 2, 2: 0.0, 3: -math.pi / 2}]
)
def test_singular_positions_are_found(special, dtype):
    arm, q = Arm.ur5(dtype=dtype), configurations(100, 6, seed=4, dtype=dtype)
    for joint, value in special.items():
        q[:, joint] = value
    found = branches(arm, arm(q), q0=q)
    assert found.valid.any(dim=1).all()
    tolerance = 1e-3 if dtype == torch.float32 else 1e-6
    assert (arm(found.q) - arm(q).unsqueeze(1)).abs().amax(dim=(-2, -1))[found.valid].max() < tolerance


def test_the_last_joint_stays_where_it_may_be_anywhere():
    q = configurations(50, 6, seed=5)
    q[:, 4] = 0.0
    found = branches(ARM, ARM(q), q0=q)
    assert (found.q[..., 5] - q[:, None, 5]).abs().amin(dim=1).max() < 1e-9


def test_limits_hold_also_for_who_is_at_one():
    narrow = Arm.from_urdf(urdf([row._replace(lower=-1.5, upper=1.5) for row in ARMS["ur5"]]), tip="tool", dtype=DOUBLE)
    q = configurations(400, 6, seed=6, spread=1.5)
    rows = torch.arange(400)
    q[rows, rows % 6] = torch.where(rows % 12 < 6, 1.5, -1.5).to(q)
    found = branches(narrow, narrow(q), q0=q)
    inside = ((found.q >= narrow.lower) & (found.q <= narrow.upper)).all(dim=-1)
    assert inside[found.valid].all()
    assert found.valid.float().sum(dim=1).mean() < 4.0
    near = (found.q - q.unsqueeze(1)).abs().amax(dim=-1).masked_fill(~found.valid, torch.inf)
    assert near.amin(dim=1).max() < 1e-6


def test_joints_are_turned_to_the_start():
    q = ARM.upper * configurations(200, 6, seed=7, spread=0.99)
    found = branches(ARM, ARM(q), q0=q)
    near = (found.q - q.unsqueeze(1)).abs().amax(dim=-1).masked_fill(~found.valid, torch.inf)
    assert near.amin(dim=1).max() < 1e-6


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_batch_dimensions_are_free(batch):
    target = ARM(configurations(math.prod(batch), 6)).reshape(*batch, 4, 4)
    found = branches(ARM, target, q0=torch.zeros(6, dtype=DOUBLE))
    assert (found.q.shape, found.valid.shape) == ((*batch, 8, 6), (*batch, 8))


def test_a_row_does_not_depend_on_its_company_and_bad_rows_have_no_solution():
    target = ARM(configurations(130, 6, seed=8))
    target[3] = math.nan
    target[7, :3, :3] = 0.0
    target[9, :3, 3] *= 10.0
    found = branches(ARM, target)
    assert not found.valid[[3, 7, 9]].any()
    assert found.q.isfinite().all()
    for rows in (slice(0, 1), slice(3, 10), slice(60, 129, 13)):
        alone = branches(ARM, target[rows])
        assert torch.equal(alone.q, found.q[rows])
        assert torch.equal(alone.valid, found.valid[rows])


def moved(pose, small):
    """``pose`` moved by ``small`` (6,), a twist about the place of the tool."""
    x, y, z = small[3:].unbind(-1)
    zero = torch.zeros_like(x)
    turned = torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)) @ pose[:3, :3]
    return torch.cat([torch.cat([turned, (pose[:3, 3] + small[:3]).unsqueeze(-1)], dim=-1), pose[3:]])


def test_every_branch_has_its_derivative_in_the_target():
    pose = ARM(torch.tensor([0.3, -1.0, 1.2, 0.4, 1.0, 0.2], dtype=DOUBLE))
    found = branches(ARM, pose)
    assert found.valid.sum() == 8

    def solved(small):
        return branches(ARM, moved(pose, small), differentiable=True).q

    still = torch.zeros(6, dtype=DOUBLE, requires_grad=True)
    assert gradcheck(solved, still, eps=1e-6, atol=1e-5, rtol=1e-4)
    slope = torch.func.jacrev(solved)(still.detach())
    torch.testing.assert_close(slope, torch.linalg.inv(ARM.pose_and_jacobian(found.q)[1]), atol=1e-5, rtol=1e-5)


def test_branches_have_their_derivative_in_the_arm():
    def solved(length):
        joints = chain(ARM)
        stretch = torch.zeros(4, 4, dtype=DOUBLE)
        stretch[0, 3] = 1.0
        joints[2] = dataclasses.replace(joints[2], offset=joints[2].offset + length * stretch)
        return branches(Arm(joints, dtype=DOUBLE), pose, differentiable=True).q

    pose = ARM(torch.tensor([0.3, -1.0, 1.2, 0.4, 1.0, 0.2], dtype=DOUBLE))
    assert gradcheck(solved, torch.zeros((), dtype=DOUBLE, requires_grad=True), eps=1e-6, atol=1e-5, rtol=1e-4)


def tilted():
    joints = chain(ARM)
    joints[2] = dataclasses.replace(joints[2], offset=joints[2].offset @ anywhere(1))
    return Arm(joints, dtype=DOUBLE)


def coupled():
    joints = [dataclasses.replace(joint, name=f"joint{index}") for index, joint in enumerate(chain(ARM))]
    joints[5] = dataclasses.replace(joints[5], coupling=Coupling(driver=joints[4]))
    return Arm(joints, dtype=DOUBLE)


@pytest.mark.parametrize(
    ("arm", "reason"),
    [
        (Arm.from_urdf(urdf(ARMS["panda"]), tip="tool", dtype=DOUBLE), "it has 7 joints of kinds revolute"),
        (Arm.from_urdf(urdf(ARMS["gantry"]), tip="tool", dtype=DOUBLE), "it has 4 joints of kinds prismatic"),
        (Arm.from_urdf(urdf(universal(0.1, 0.0, -0.4, 0.1, 0.1, 0.1)), tip="tool", dtype=DOUBLE), "are the same"),
        (tilted(), "its axes 2 and 3 are not parallel"),
        (coupled(), "some of its joints move together"),
    ],
)
def test_other_arms_are_refused_with_the_reason_and_solved_otherwise(arm, reason):
    target = arm(configurations(5, arm.num_joints, seed=9, spread=1.0))
    with pytest.raises(InputError, match=f"branches handles arms of the UR family only: .*{reason}"):
        branches(arm, target)
    assert (solve_ik(arm, target, solutions=2).status[:, 0] == IKStatus.SOLVED).all()


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        (torch.zeros(3, 4), {}, r"target must have shape \(\*B, 4, 4\)"),
        (torch.eye(4), {}, "target is torch.float32, but the arm is torch.float64"),
        (torch.eye(4, dtype=DOUBLE, device="meta"), {}, "target is on meta"),
        (torch.eye(4, dtype=DOUBLE), {"q0": torch.zeros(5, dtype=DOUBLE)}, "q0 must have shape"),
    ],
)
def test_a_mistake_is_named(target, options, message):
    with pytest.raises(InputError, match=message):
        branches(ARM, target, **options)
