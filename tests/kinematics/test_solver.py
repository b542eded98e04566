import math

import pytest
import torch

from tests.kinematics.arms import ARMS, configurations, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, IKStatus, constraint_error, solve_ik

DOUBLE = torch.float64
ARM = Arm.ur5(dtype=DOUBLE)
SEVEN = Arm.from_urdf(urdf(ARMS["panda"]), tip="tool", dtype=DOUBLE)


def reachable(count, seed=0, arm=ARM):
    return arm(configurations(count, arm.num_joints, seed, arm.lower.dtype))


def holds(arm, result, target, constraint="pose", symmetry=1):
    error = constraint_error(arm(result.q), target, constraint=constraint, symmetry=symmetry)
    within = (error[..., :3].norm(dim=-1) <= 1.001e-3) & (error[..., 3:].norm(dim=-1) <= 1.001 * math.radians(0.5))
    return within & (result.q >= arm.lower).all(-1) & (result.q <= arm.upper).all(-1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_thousand_reachable_poses_are_solved_from_random_starts(dtype):
    arm = Arm.ur5(dtype=dtype)
    target = reachable(1000, arm=arm)
    result = solve_ik(arm, target, q0=configurations(1000, 6, seed=9, dtype=dtype))
    assert (result.status == IKStatus.SOLVED).all()
    assert holds(arm, result, target).all()


@pytest.mark.parametrize(
    ("name", "constraint"), [("panda", "pose"), ("iiwa", "pose"), ("scara", "position"), ("gantry", "axis")]
)
def test_other_arms_are_solved(name, constraint):
    arm = Arm.from_urdf(urdf(ARMS[name]), tip="tool", dtype=DOUBLE)
    target = reachable(60, arm=arm)
    result = solve_ik(arm, target, constraint=constraint)
    assert (result.status == IKStatus.SOLVED).all()
    assert holds(arm, result, target, constraint).all()


def mixed(count=10_000):
    """Targets of which every tenth is bad, and the statuses that name it."""
    target = reachable(count, seed=3)
    rows = torch.arange(count)
    target[rows % 50 == 0] = math.nan
    target[rows % 50 == 10, 0, 3] = math.inf
    far = rows % 50 == 20
    target[far, :3, 3] *= 2.5 / target[far, :3, 3].norm(dim=-1, keepdim=True)
    target[rows % 50 == 30, :3, :3] = 0.0
    target[rows % 50 == 40, 0, :3] *= -1.0
    return target, rows % 10 == 0, far


def test_ten_thousand_targets_of_which_a_tenth_is_bad():
    target, bad, far = mixed()
    result = solve_ik(ARM, target)
    assert (result.status[~bad] == IKStatus.SOLVED).all()
    assert holds(ARM, result, target)[~bad].all()
    assert (result.status[bad & ~far] == IKStatus.INVALID).all()
    assert torch.isin(result.status[far], torch.tensor([IKStatus.UNREACHED, IKStatus.SINGULAR, IKStatus.LIMITED])).all()
    assert (result.residual[far, 0] > 1.0).all()
    assert result.residual[bad & ~far].isinf().all()
    assert result.q.isfinite().all()
    for rows in (slice(0, 1), slice(7, 8), slice(20, 21), slice(0, 130, 13), slice(5000, 5064)):
        alone = solve_ik(ARM, target[rows])
        for one, other in zip(alone, result, strict=True):
            assert torch.equal(one, other[rows])


def test_targets_of_singular_configurations_are_solved():
    q = configurations(200, 6, seed=4)
    q[:100, 4] = 0.0
    q[50:150, 2] = 0.0
    result = solve_ik(ARM, ARM(q))
    assert (result.status == IKStatus.SOLVED).all()
    assert holds(ARM, result, ARM(q)).all()


def test_a_start_that_is_not_finite_is_named_in_its_row():
    for bad in (math.nan, math.inf, -math.inf):
        q0 = configurations(4, 6)
        q0[2, 3] = bad
        result = solve_ik(ARM, reachable(4), q0=q0)
        assert result.status.tolist() == [0, 0, IKStatus.INVALID, 0]
        assert torch.equal(result.q[2].nan_to_num(7.0), q0[2].nan_to_num(7.0))


def test_a_joint_at_its_limit_is_named():
    rows = [row._replace(lower=-0.3, upper=0.3) for row in ARMS["ur5"]]
    narrow = Arm.from_urdf(urdf(rows), tip="tool", dtype=DOUBLE)
    result = solve_ik(narrow, ARM(torch.tensor([2.5, -1.0, 1.2, 0.4, 1.0, 0.2], dtype=DOUBLE)))
    assert int(result.status) == IKStatus.LIMITED
    assert bool(((result.q >= narrow.lower) & (result.q <= narrow.upper)).all())


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("constraint", ["pose", "axis", "position"])
def test_batch_dimensions_are_free(batch, constraint):
    target = reachable(math.prod(batch)).reshape(*batch, 4, 4)
    result = solve_ik(ARM, target, constraint=constraint)
    assert (result.q.shape, result.status.shape, result.residual.shape) == ((*batch, 6), batch, (*batch, 2))
    assert holds(ARM, result, target, constraint).all()


def test_a_position_alone_may_be_given_as_one():
    place = reachable(5)[:, :3, 3]
    assert (ARM(solve_ik(ARM, place, constraint="position").q)[:, :3, 3] - place).norm(dim=-1).max() < 1e-3


def test_a_square_box_takes_the_nearest_quarter_turn():
    q = configurations(50, 6, seed=5)
    quarter = torch.tensor([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=DOUBLE)
    result = solve_ik(ARM, ARM(q) @ quarter, q0=q, symmetry=4)
    assert torch.equal(result.q, q)
    assert not torch.equal(solve_ik(ARM, ARM(q) @ quarter, q0=q).q, q)


def test_no_joint_moves_more_than_its_limit_in_a_step():
    q = configurations(20, 6, seed=6)
    limit = torch.tensor([0.1, 0.2, 0.05, 0.3, 0.1, 0.4], dtype=DOUBLE)
    result = solve_ik(ARM, reachable(20), q0=q, max_step=limit, iterations=3, rounds=(1,))
    assert ((result.q - q).abs() <= 3 * limit + 1e-12).all()
    assert ((result.q - q).abs() > 2.5 * limit).any()


def test_free_motion_is_drawn_to_the_posture():
    q = configurations(30, 7, seed=7, spread=1.5)
    posture = torch.tensor([0.0, -0.5, 0.0, -1.5, 0.0, 1.0, 0.0], dtype=DOUBLE)
    options = {"q0": q + 0.2, "rounds": (1,), "iterations": 60, "position_tolerance": 1e-6}
    away, drawn = solve_ik(SEVEN, SEVEN(q), **options), solve_ik(SEVEN, SEVEN(q), posture=posture, **options)
    both = (away.status == 0) & (drawn.status == 0)
    assert both.float().mean() > 0.5
    assert ((drawn.q - posture).norm(dim=-1) < (away.q - posture).norm(dim=-1))[both].float().mean() > 0.9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": torch.zeros(3, 4)}, r"target must have shape \(\*B, 4, 4\), got \(3, 4\)"),
        ({"target": torch.zeros(4, 4)}, "target is torch.float32, but the arm is torch.float64"),
        ({"target": torch.zeros(4, 4, device="meta", dtype=DOUBLE)}, "target is on meta, but the arm is on cpu"),
        ({"q0": torch.zeros(5, dtype=DOUBLE)}, r"q0 must have shape \(\*B, 6\), got \(5,\)"),
        ({"q0": torch.zeros(3, 6, dtype=DOUBLE)}, r"q0 must have shape \(2, 6\) or \(6,\), got \(3, 6\)"),
        (
            {"target": torch.eye(4, dtype=DOUBLE), "q0": torch.zeros(2, 6, dtype=DOUBLE)},
            r"q0 must have shape \(6,\) or",
        ),
        ({"posture": torch.zeros(6)}, "posture is torch.float32"),
        ({"constraint": "axes"}, r"unknown constraint 'axes' \(did you mean 'axis'"),
        ({"symmetry": 0}, "symmetry must be >= 1, got 0"),
        ({"iterations": 2.5}, "iterations must be an integer"),
    ],
)
def test_a_mistake_is_named(options, message):
    with pytest.raises(InputError, match=message):
        solve_ik(ARM, **{"target": reachable(2), **options})
