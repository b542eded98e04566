import dataclasses
import math

import pytest
import torch

from tests.kinematics.arms import ARMS, configurations, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, IKStatus, branches, constraint_error, solve_ik
from torchdyn_plan.kinematics.dls import dls_step, dls_step_within

DOUBLE = torch.float64
TURN = 2.0 * math.pi
ARM = Arm.ur5(dtype=DOUBLE)
PANDA = Arm.from_urdf(urdf(ARMS["panda"]), tip="tool", dtype=DOUBLE)


def travel(arm, q, start):
    return ((q - start).abs() / arm.speed_limit).amax(dim=-1)


def reaches(arm, q, target):
    error = constraint_error(arm(q), target)
    return (error[..., :3].norm(dim=-1) <= 1.001e-3) & (error[..., 3:].norm(dim=-1) <= 1.001 * math.radians(0.5))


def inside(arm, q):
    return ((q >= arm.lower) & (q <= arm.upper)).all(dim=-1)


@pytest.mark.parametrize("options", [{}, {"solutions": 8}])
@pytest.mark.parametrize("spread", [0.2, 1.0])
def test_the_nearest_of_all_solutions_is_found(options, spread):
    start, end = ARM.upper * configurations(600, 6, seed=1, spread=spread).view(2, 300, 6)
    target = ARM(end)
    result = solve_ik(ARM, target, q0=start, **options)
    q = result.q[:, 0] if options else result.q
    every = branches(ARM, target, q0=start)
    least = travel(ARM, every.q, start.unsqueeze(1)).masked_fill(~every.valid, torch.inf).amin(dim=1)
    extra = travel(ARM, q, start) - least
    assert (extra <= 0.01).double().mean() >= 0.99
    assert extra.mean() <= 0.01


def slow_base():
    """A UR5 whose first joint is slow."""
    joints = list(ARM.part_settings()["joints"])
    joints[0] = dataclasses.replace(joints[0], speed_limit=0.05)
    return Arm(joints, dtype=DOUBLE)


def test_near_is_what_is_reached_soon():
    arm = slow_base()
    start, end = configurations(2, 600, seed=2).view(2, 100, 6)
    even, slow = solve_ik(ARM, ARM(end), q0=start).q, solve_ik(arm, arm(end), q0=start).q
    assert (travel(arm, slow, start) <= travel(arm, even, start) + 1e-9).all()
    assert (travel(arm, slow, start) < travel(arm, even, start) - 1.0).double().mean() > 0.2


def test_no_joint_goes_the_long_way_round():
    start, end = ARM.upper * configurations(600, 6, seed=3, spread=1.0).view(2, 300, 6)
    for rounds in ((1, 4, 16, 64, 128), (16,)):
        result = solve_ik(ARM, ARM(end), q0=start, rounds=rounds)
        for turn in (-TURN, TURN):
            other = result.q + turn
            allowed = (other >= ARM.lower) & (other <= ARM.upper)
            assert not (allowed & ((other - start).abs() < (result.q - start).abs() - 1e-9)).any()


def endless(dtype=DOUBLE):
    """An arm of six joints, of no family, that turn without an end."""
    rows = [row._replace(kind="continuous") if row.kind == "revolute" else row for row in ARMS["panda"]]
    return Arm.from_urdf(urdf(rows), tip="tool", dtype=dtype)


def test_endless_joints_are_not_unwound():
    arm, q = endless(), configurations(100, 7, seed=4)
    wound = q + TURN * torch.tensor([40.0, -3.0, 0.0, 7.0, -160.0, 1.0, 2.0], dtype=DOUBLE)
    result = solve_ik(arm, arm(q + 0.1), q0=wound)
    assert (result.status == IKStatus.SOLVED).all()
    # Where the first try fails, others may be half a turn away, never a turn.
    assert (result.q - wound).abs().max() <= math.pi + 0.2


def test_endless_joints_are_as_precise_after_many_turns():
    arm, q = endless(torch.float32), configurations(100, 7, seed=5, dtype=torch.float32)
    wound = q + TURN * 160.0
    result = solve_ik(arm, arm(q), q0=wound, position_tolerance=2e-5, rotation_tolerance=2e-5)
    assert (result.status == IKStatus.SOLVED).all()
    # Where the last place of q itself is coarser than the tolerances, the pose of q modulo 2π holds them.
    exact = (result.q.double() - TURN * (result.q.double() / TURN).round()).float()
    error = constraint_error(arm(exact), arm(q))
    assert error[:, :3].norm(dim=-1).max() <= 3e-5


@pytest.mark.parametrize(("arm", "count"), [(ARM, 8), (PANDA, 5)])
def test_several_solutions_differ_and_the_nearest_comes_first(arm, count):
    n = arm.num_joints
    start, end = configurations(2, 60 * n, seed=6, spread=2.5).view(2, 60, n)
    target = arm(end)
    result = solve_ik(arm, target, q0=start, solutions=count)
    assert (result.q.shape, result.status.shape) == ((60, count, n), (60, count))
    assert result.residual.shape == (60, count, 2)
    solved = result.status == IKStatus.SOLVED
    assert solved[:, 0].all()
    assert solved.sum(dim=1).double().mean() > 3.5
    assert reaches(arm, result.q, target.unsqueeze(1))[solved].all()
    assert inside(arm, result.q)[solved].all()
    way = travel(arm, result.q, start.unsqueeze(1)).masked_fill(~solved, torch.inf)
    assert torch.equal(way, way.sort(dim=1).values)
    apart = result.q.unsqueeze(1) - result.q.unsqueeze(2)
    apart = (apart - TURN * (apart / TURN).round()).abs().amax(dim=-1)
    both = solved.unsqueeze(1) & solved.unsqueeze(2) & ~torch.eye(count, dtype=torch.bool)
    assert apart[both].min() > 0.01
    assert torch.equal(result.q[~solved], result.q[:, :1].expand_as(result.q)[~solved])
    assert result.residual[~solved].isinf().all()


@pytest.mark.parametrize("batch", [(), (2, 3), (0,)])
def test_several_solutions_of_any_batch(batch):
    target = ARM(configurations(math.prod(batch), 6)).reshape(*batch, 4, 4)
    result = solve_ik(ARM, target, solutions=3, differentiable=True)
    assert (result.q.shape, result.status.shape, result.residual.shape) == ((*batch, 3, 6), (*batch, 3), (*batch, 3, 2))


def test_a_move_is_bound():
    start, end = configurations(2, 600, seed=7, spread=2.0).view(2, 100, 6)
    bound = torch.tensor([0.5, 1.0, 1.0, 2.0, 2.0, 2.0], dtype=DOUBLE)
    near = start + 0.9 * bound * torch.sign(end)
    found = solve_ik(ARM, ARM(near), q0=start, max_move=bound)
    assert (found.status == IKStatus.SOLVED).all()
    assert ((found.q - start).abs() <= bound + 1e-12).all()
    for q0, target in ((start, ARM(end)), (configurations(100, 7, spread=2.0), PANDA(configurations(100, 7, seed=8)))):
        arm = ARM if q0.shape[1] == 6 else PANDA
        result = solve_ik(arm, target, q0=q0, max_move=0.4, rounds=(1, 4), solutions=2)
        assert ((result.q - q0.unsqueeze(1)).abs() <= 0.4 + 1e-12).all()
        assert (result.status != IKStatus.SOLVED).double().mean() > 0.5


@pytest.mark.parametrize("far", [7.0, 1e-4])
def test_nothing_outside_the_limits_is_solved(far):
    for arm in (ARM, PANDA):
        q0 = arm.upper + far * torch.rand(50, arm.num_joints, dtype=DOUBLE)
        for options in ({}, {"rounds": (1,)}, {"solutions": 2}):
            result = solve_ik(arm, arm(q0), q0=q0, **options)
            solved = result.status == IKStatus.SOLVED
            assert inside(arm, result.q)[solved].all()
            target = arm(q0) if result.q.ndim == 2 else arm(q0).unsqueeze(1)
            assert reaches(arm, result.q, target)[solved].all()


def test_joints_at_their_limits_are_left_out_of_the_step():
    q, error = configurations(200, 7, seed=9), configurations(200, 6, seed=10, spread=0.1)
    jacobian, damping = PANDA.pose_and_jacobian(q)[1], torch.full((200,), 0.02, dtype=DOUBLE)
    lower, upper = torch.full_like(q, -10.0), torch.full_like(q, 10.0)
    # Two joints of each row are at the limit towards which the plain step pushes them.
    plain = dls_step(jacobian, error, damping)
    for joint in (1, 4):
        lower[:, joint] = torch.where(plain[:, joint] < 0, q[:, joint], lower[:, joint])
        upper[:, joint] = torch.where(plain[:, joint] > 0, q[:, joint], upper[:, joint])
    step = dls_step_within(jacobian, error, damping, q, lower, upper)
    assert (q + step >= lower).all()
    assert (q + step <= upper).all()
    cut = torch.clamp(q + plain, lower, upper) - q
    left = [(error - (jacobian @ one.unsqueeze(-1)).squeeze(-1)).norm(dim=-1) for one in (step, cut)]
    assert left[0].mean() < 0.5 * left[1].mean()


def test_limits_inside_the_step_solve_what_restarts_alone_did_not():
    rows = [row._replace(lower=-1.2, upper=1.2) for row in ARMS["panda"]]
    narrow = Arm.from_urdf(urdf(rows), tip="tool", dtype=DOUBLE)
    target = narrow(configurations(200, 7, seed=11, spread=1.2))
    result = solve_ik(narrow, target)
    assert (result.status == IKStatus.SOLVED).all()
    assert inside(narrow, result.q).all()


def scaled(arm, factor):
    joints = []
    for joint in arm.part_settings()["joints"]:
        offset = joint.offset.clone()
        offset[:3, 3] *= factor
        joints.append(dataclasses.replace(joint, offset=offset))
    return Arm(joints, dtype=DOUBLE)


@pytest.mark.parametrize("factor", [0.05, 30.0, 1000.0])
def test_arms_of_any_size_and_in_any_unit_are_solved(factor):
    arm = scaled(PANDA, factor)
    start, end = configurations(2, 700, seed=12, spread=2.9).view(2, 100, 7)
    result = solve_ik(arm, arm(end), q0=start, position_tolerance=1e-3 * factor)
    assert (result.status == IKStatus.SOLVED).all()


def test_short_steps_arrive_as_long_ones_do():
    start, end = configurations(2, 700, seed=13, spread=1.0).view(2, 100, 7)
    options = {"q0": start, "rounds": (1,)}
    long = solve_ik(PANDA, PANDA(end), **options, iterations=100).status == IKStatus.SOLVED
    short = solve_ik(PANDA, PANDA(end), **options, iterations=500, max_step=0.02).status == IKStatus.SOLVED
    assert short.double().mean() > long.double().mean() - 0.1


@pytest.mark.parametrize("joint", [0, 3])
@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_start_that_is_no_position_is_named(value, joint):
    q0 = configurations(3, 6)
    q0[1, joint] = value
    assert solve_ik(ARM, ARM(configurations(3, 6)), q0=q0).status.tolist() == [0, IKStatus.INVALID, 0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solutions": 0}, "solutions must be >= 1, got 0"),
        ({"max_move": 0.5}, "give q0 with it"),
        ({"max_move": -0.5, "q0": torch.zeros(6, dtype=DOUBLE)}, "max_move must be positive"),
        ({"max_move": torch.ones(5), "q0": torch.zeros(6, dtype=DOUBLE)}, "max_move must be positive, a number or of"),
        ({"max_step": math.nan}, "max_step must be a finite number, got nan"),
        ({"position_tolerance": 0.0}, "position_tolerance must be >= 1e-12, got 0.0"),
        ({"rotation_tolerance": -0.1}, "rotation_tolerance must be >= 1e-12, got -0.1"),
        ({"rounds": ()}, r"rounds must be numbers of starts, one for each round, got \(\)"),
        ({"rounds": 3}, "rounds must be numbers of starts"),
        ({"rounds": (1, 0)}, "each of rounds must be >= 1, got 0"),
    ],
)
def test_a_mistake_is_named(options, message):
    with pytest.raises(InputError, match=message):
        solve_ik(ARM, ARM(configurations(2, 6)), **options)
