import dataclasses
import math

import pytest
import torch

from tests.kinematics.arms import ARMS, configurations, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, IKStatus, constraint_error, follow, solve_ik

DOUBLE = torch.float64
DT = 0.02
ARM = Arm.ur5(dtype=DOUBLE)
PANDA = Arm.from_urdf(urdf(ARMS["panda"]), tip="tool", dtype=DOUBLE)
HOME = torch.tensor([0.0, -1.0, 1.3, 0.4, 1.2, 0.0], dtype=DOUBLE)


def without_speed_limits():
    joints = [dataclasses.replace(joint, speed_limit=math.inf) for joint in ARM.part_settings()["joints"]]
    return Arm(joints, dtype=DOUBLE)


def joint_paths(arm, count, steps, seed=0, speed=0.5):
    """Smooth joint motions ``(count, steps + 1, N)`` within the limits, at up to ``speed`` times those of speed."""
    random = torch.Generator().manual_seed(seed)
    draw = torch.rand(3, count, 1, arm.num_joints, generator=random, dtype=DOUBLE)
    times = DT * torch.arange(steps + 1, dtype=DOUBLE).view(1, -1, 1)
    rate = 1.0 + 2.0 * draw[0]
    size = (speed * arm.speed_limit / rate).clamp(max=0.8)
    return 2.0 * (draw[1] - 0.5) + size * torch.sin(rate * times + 6.0 * draw[2])


def wild(arm, count, steps, seed=0):
    """Poses ``(count, steps, 4, 4)`` all over the place, each of a position that has nothing to do with the last."""
    return arm(configurations(count * steps, arm.num_joints, seed, spread=2.9)).view(count, steps, 4, 4)


def moves(q, q0):
    return q.diff(dim=1, prepend=q0.unsqueeze(1)).abs()


def reaches(arm, q, poses):
    error = constraint_error(arm(q), poses)
    return (error[..., :3].norm(dim=-1) <= 1.001e-3) & (error[..., 3:].norm(dim=-1) <= 1.001 * math.radians(0.5))


@pytest.mark.parametrize("arm", [ARM, PANDA], ids=["ur5", "panda"])
def test_a_smooth_target_is_followed_without_a_jump(arm):
    path = joint_paths(arm, 40, 100, speed=0.25)
    q0, poses = path[:, 0], arm(path[:, 1:])
    result = follow(arm, poses, q0, DT)
    solved = result.status == IKStatus.SOLVED
    assert solved.double().mean() > 0.97
    assert torch.equal(reaches(arm, result.q, poses), solved)
    # Of an arm without spare joints there is one way.
    assert arm is PANDA or (result.q - path[:, 1:]).abs().amax(dim=(1, 2)).median() < 0.05
    # As fast as they like, they do not jump either.
    free = Arm(arm.part_settings()["joints"], speed_limit=1e6, dtype=DOUBLE)
    jumped = (moves(follow(free, poses, q0, DT).q, q0).amax(dim=-1) > 0.8).any(dim=1)
    assert jumped.double().mean() <= 0.05


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("name", ["ur5", "panda", "gantry"])
@pytest.mark.parametrize("kind", ["smooth", "wild"])
def test_limits_of_place_and_speed_are_never_passed(name, kind, dtype):
    arm = Arm.from_urdf(urdf(ARMS[name]), tip="tool", dtype=dtype)
    exact = Arm.from_urdf(urdf(ARMS[name]), tip="tool", dtype=DOUBLE)
    path = joint_paths(exact, 20, 60, speed=2.0)
    q0 = path[:, 0].clamp(exact.lower, exact.upper).to(dtype)
    poses = (exact(path[:, 1:]) if kind == "smooth" else wild(exact, 20, 60)).to(dtype)
    result = follow(arm, poses, q0, DT)
    assert ((result.q >= arm.lower) & (result.q <= arm.upper)).all()
    assert (moves(result.q, q0) <= arm.speed_limit * DT).all()
    assert (moves(result.q, q0) > 0.99 * arm.speed_limit * DT).any()


def test_the_velocity_of_the_target_is_fed_forward():
    # At a constant speed well within the limits, nothing lags: each pose is met when it is due.
    path = HOME + torch.linspace(0.0, 1.0, 101, dtype=DOUBLE).unsqueeze(-1) * torch.full((6,), 0.6, dtype=DOUBLE)
    result = follow(ARM, ARM(path[1:]), HOME, DT)
    assert (result.status == IKStatus.SOLVED).all()
    assert (result.residual[:, 0] < 1.01e-4).all()
    assert (result.q - path[1:]).abs().max() < 2e-3


def test_a_far_target_is_gone_to_at_once_and_at_full_speed():
    end = HOME + torch.tensor([0.9, 0.3, -0.4, 0.2, 0.5, 0.1], dtype=DOUBLE)
    result = follow(ARM, ARM(end).repeat(60, 1, 1), HOME, DT)
    at_speed = (moves(result.q.unsqueeze(0), HOME.unsqueeze(0)) > 0.999 * ARM.speed_limit * DT).any(dim=-1)[0]
    first = int((result.status == IKStatus.SOLVED).nonzero()[0])
    assert at_speed[: first - 1].all()
    assert (result.status[:first] == IKStatus.LATE).all()
    assert (result.status[first:] == IKStatus.SOLVED).all()
    fewest = math.ceil(0.9 / float(ARM.speed_limit[0] * DT))
    assert first + 1 <= 1.5 * fewest


def test_who_cannot_get_there_is_not_late():
    far = ARM(HOME).clone()
    far[:3, 3] *= 3.0
    result = follow(ARM, far.repeat(80, 1, 1), HOME, DT)
    assert result.status[0] == IKStatus.LATE
    assert result.status[-1] in (IKStatus.SINGULAR, IKStatus.UNREACHED)
    rows = [row._replace(lower=-0.6, upper=0.6) for row in ARMS["ur5"]]
    narrow = Arm.from_urdf(urdf(rows), tip="tool", dtype=DOUBLE)
    start = torch.full((6,), 0.3, dtype=DOUBLE)
    beyond = ARM(start + torch.tensor([1.0, 0, 0, 0, 0, 0], dtype=DOUBLE))
    result = follow(narrow, beyond.repeat(60, 1, 1), start, DT)
    assert result.q[-1, 0] == narrow.upper[0]
    assert result.status[-1] in (IKStatus.LIMITED, IKStatus.SINGULAR)


def test_another_way_is_taken_where_a_limit_bars_the_first():
    # Joint 6 has come to its limit, and the target turns on: the arm must change over, and does so within its speed.
    start = HOME.clone()
    start[5] = 6.2
    path = start.repeat(200, 1)
    path[:, 5] += torch.linspace(0.0, 0.8, 200, dtype=DOUBLE)
    path[100:] = path[100].clone()
    result = follow(ARM, ARM(path), start, DT)
    assert (result.q[:, 5] <= ARM.upper[5]).all()
    assert result.status[50] != IKStatus.SOLVED
    assert result.status[-1] == IKStatus.SOLVED
    assert (moves(result.q.unsqueeze(0), start.unsqueeze(0)) <= ARM.speed_limit * DT).all()


@pytest.mark.parametrize("far", [1e-4, 2.0])
def test_a_start_outside_the_limits_comes_back_as_fast_as_it_can(far):
    start = PANDA.upper - 0.5
    start[3] = PANDA.upper[3] + far
    poses = PANDA(PANDA.upper - 0.5).repeat(80, 1, 1)
    result = follow(PANDA, poses, start, DT)
    outside = (result.q > PANDA.upper).any(dim=-1)
    assert (result.status[outside] == IKStatus.LIMITED).all()
    assert abs(int(outside.sum()) - far / float(PANDA.speed_limit[3] * DT)) <= 1.0
    assert (moves(result.q.unsqueeze(0), start.unsqueeze(0)) <= PANDA.speed_limit * DT).all()
    assert result.status[-1] == IKStatus.SOLVED


def test_a_pose_that_is_none_stops_its_row_alone_and_for_its_time():
    path = joint_paths(ARM, 4, 30, seed=1, speed=0.2)
    poses = ARM(path[:, 1:])
    poses[1, 10:13] = math.nan
    poses[2, 5, :3, :3] = 0.0
    q0 = path[:, 0].clone()
    q0[3, 2] = math.inf
    result = follow(ARM, poses, q0, DT)
    assert (result.status[0] == IKStatus.SOLVED).all()
    assert (result.status[1, 10:13] == IKStatus.INVALID).all()
    assert (result.q[1, 10:13] == result.q[1, 9]).all()
    assert result.residual[1, 10:13].isinf().all()
    assert (result.status[1, 20:] == IKStatus.SOLVED).all()
    assert result.status[2].tolist() == [0] * 5 + [IKStatus.INVALID] + [0] * 24
    assert (result.status[3] == IKStatus.INVALID).all()


def test_a_row_does_not_depend_on_its_company():
    path = joint_paths(PANDA, 70, 20, seed=2, speed=1.5)
    poses = PANDA(path[:, 1:])
    result = follow(PANDA, poses, path[:, 0], DT)
    for rows in (slice(0, 1), slice(5, 66, 20)):
        alone = follow(PANDA, poses[rows], path[rows, 0], DT)
        for one, other in zip(alone, result, strict=True):
            assert torch.equal(one, other[rows])


@pytest.mark.parametrize("batch", [(), (2, 3), (0,)])
def test_batch_dimensions_are_free(batch):
    poses = wild(ARM, math.prod(batch), 4).reshape(*batch, 4, 4, 4)
    result = follow(ARM, poses, HOME, DT)
    assert result.q.shape == (*batch, 4, 6)
    assert (result.status.shape, result.residual.shape) == ((*batch, 4), (*batch, 4, 2))


def test_a_place_alone_is_followed_and_the_posture_kept():
    q = joint_paths(PANDA, 10, 60, seed=3, speed=0.3)
    places = PANDA(q[:, 1:])[..., :3, 3]
    result = follow(PANDA, places, q[:, 0], DT, constraint="position")
    assert (result.status == IKStatus.SOLVED).double().mean() > 0.98
    posture = torch.tensor([0.0, -0.5, 0.0, -1.5, 0.0, 1.0, 0.0], dtype=DOUBLE)
    drawn = follow(PANDA, places, q[:, 0], DT, constraint="position", posture=posture)
    assert ((drawn.q - posture).norm(dim=-1) < (result.q - posture).norm(dim=-1))[:, -1].all()


def test_slow_joints_take_less_of_a_motion():
    joints = list(PANDA.part_settings()["joints"])
    joints[0] = dataclasses.replace(joints[0], speed_limit=0.2)
    slow = Arm(joints, dtype=DOUBLE)
    q = joint_paths(slow, 10, 40, seed=4, speed=0.3)
    poses = slow(q[:, 1:])
    used = [moves(follow(arm, poses, q[:, 0], DT).q, q[:, 0])[..., 0].sum() for arm in (PANDA, slow)]
    assert used[1] < 0.7 * used[0]


def test_an_arm_without_speed_limits_is_at_every_pose_that_can_be_reached():
    arm = without_speed_limits()
    target = wild(arm, 10, 1)
    result = follow(arm, target.repeat(1, 30, 1, 1), configurations(10, 6, seed=5), DT)
    assert (result.status[:, -1] == IKStatus.SOLVED).all()
    assert (solve_ik(arm, target[:, 0]).status == IKStatus.SOLVED).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poses": torch.eye(4, dtype=DOUBLE)}, r"poses must have shape \(\*B, T, 4, 4\), got \(4, 4\)"),
        ({"poses": torch.zeros(3, 5, dtype=DOUBLE)}, r"poses must have shape \(\*B, 4, 4\)"),
        ({"poses": torch.zeros(3, 4, 4)}, "poses is torch.float32, but the arm is torch.float64"),
        ({"poses": torch.zeros(3, 3), "constraint": "position"}, "poses is torch.float32"),
        ({"poses": torch.zeros(3, 3, device="meta", dtype=DOUBLE), "constraint": "position"}, "poses is on meta"),
        ({"q0": torch.zeros(2, 6, dtype=DOUBLE)}, r"q0 must have shape \(6,\) or \(6,\), got \(2, 6\)"),
        ({"dt": 0.0}, "dt must be >= 1e-09, got 0.0"),
        ({"dt": math.nan}, "dt must be a finite number, got nan"),
        ({"iterations": 0}, "iterations must be >= 1"),
        ({"constraint": "poses"}, "unknown constraint 'poses'"),
        ({"rotation_tolerance": 0.0}, "rotation_tolerance must be >= 1e-12"),
    ],
)
def test_a_mistake_is_named(options, message):
    with pytest.raises(InputError, match=message):
        follow(ARM, **{"poses": wild(ARM, 1, 2)[0], "q0": HOME, "dt": DT, **options})
