import math

import pytest
import torch

from tests.kinematics.arms import ARMS, configurations, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, ArmSolver, IKStatus
from torchdyn_plan.kinematics.joint import rotation_about, transform
from torchdyn_plan.kinematics.targets import rotation_matrix, rotation_vector

torchrl_envs = pytest.importorskip("torchrl.envs", reason="TorchRL has the macro actions")

DOUBLE = torch.float64
ARM = Arm.ur5(dtype=DOUBLE)
PANDA = Arm.from_urdf(urdf(ARMS["panda"]), tip="tool", dtype=DOUBLE)
BASE = transform(rotation_about(torch.tensor([0.6, 0.0, 0.8], dtype=DOUBLE), 0.7), (0.3, -0.2, 0.5))
GRIPPER = 0.25


def quaternion(rotation):
    """Unit quaternions wxyz ``(*B, 4)`` of rotations ``(*B, 3, 3)``, by their axis and angle."""
    vector = rotation_vector(rotation)
    angle = vector.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.cat([torch.cos(0.5 * angle), torch.sin(0.5 * angle) * vector / angle], dim=-1)


def as_pose7(pose):
    return torch.cat([pose[..., :3, 3], quaternion(pose[..., :3, :3])], dim=-1)


def action(q):
    return torch.cat([q, torch.full_like(q[..., :1], GRIPPER)], dim=-1)


def problem(count, seed=0, arm=ARM, near=0.5):
    """Start actions, and poses in the world of positions not far from them."""
    q = configurations(count, arm.num_joints, seed, spread=2.0)
    end = q + configurations(count, arm.num_joints, seed + 1, spread=near)
    return action(q), BASE @ arm(end)


def world(arm, actions):
    return BASE @ arm(actions[..., :-1])


def turn_off(reached, wanted):
    """Rotation vectors about the world's axes, ``(*B, 3)``."""
    return rotation_vector(wanted[..., :3, :3] @ reached[..., :3, :3].mT)


def test_it_is_what_torchrl_asks_for():
    assert isinstance(ArmSolver(ARM), torchrl_envs.CartesianSolver)


@pytest.mark.parametrize("arm", [ARM, PANDA], ids=["ur5", "panda"])
@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_poses_of_the_world_are_reached_and_the_gripper_passes_through(arm, dtype):
    start, pose = problem(60, arm=arm)
    found = ArmSolver(arm, base=BASE)(as_pose7(pose).to(dtype), start.to(dtype))
    assert (found.dtype, found.shape) == (dtype, start.shape)
    assert (found[:, -1] == GRIPPER).all()
    reached = world(arm, found.double())
    assert (reached - pose)[:, :3, 3].norm(dim=-1).max() < 1.1e-4
    assert turn_off(reached, pose).norm(dim=-1).max() < 1.1 * math.radians(0.1)


@pytest.mark.parametrize("none", [0.0, math.nan, math.inf])
def test_a_quaternion_that_is_none_leaves_the_orientation_free(none):
    start, pose = problem(20, seed=2)
    target = as_pose7(pose)
    target[::2, 3:] = none
    found = ArmSolver(ARM, base=BASE)(target, start)
    reached = world(ARM, found)
    assert (reached - pose)[:, :3, 3].norm(dim=-1).max() < 1.1e-4
    turn = turn_off(reached, pose).norm(dim=-1)
    assert turn[1::2].max() < 1.1 * math.radians(0.1)
    assert turn[::2].mean() > 0.05


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_mask_frees_the_rotation_about_one_axis_of_the_world(axis):
    start, pose = problem(30, seed=4, near=0.3)
    mask = torch.ones(30, 3, dtype=DOUBLE)
    mask[:, axis] = 0.0
    # Turned about that axis by another half radian, the pose asks for the same.
    turn = torch.zeros(3, dtype=DOUBLE)
    turn[axis] = 0.4
    other = pose.clone()
    other[:, :3, :3] = rotation_matrix(turn) @ pose[:, :3, :3]
    solver = ArmSolver(ARM, base=BASE)
    result = solver.solve(as_pose7(other), start, orientation_mask=mask)
    assert (result.status == IKStatus.SOLVED).all()
    off = turn_off(BASE @ ARM(result.q), other)
    kept = [index for index in range(3) if index != axis]
    assert off[:, kept].norm(dim=-1).max() < 1.1 * math.radians(0.1)
    assert off[:, axis].abs().mean() > 0.02


def test_a_mask_that_is_no_number_is_none_in_its_row():
    start, pose = problem(10, seed=5)
    mask = torch.zeros(10, 3, dtype=DOUBLE)
    mask[::2, 1] = math.nan
    found = ArmSolver(ARM, base=BASE)(as_pose7(pose), start, orientation_mask=mask)
    assert turn_off(world(ARM, found), pose)[::2].norm(dim=-1).max() < 1.1 * math.radians(0.1)


def test_waypoints_are_on_the_straight_way():
    q = torch.tensor([0.3, -1.0, 1.3, 0.4, 1.2, 0.0], dtype=DOUBLE) + configurations(20, 6, seed=6, spread=0.3)
    start, pose = action(q), BASE @ ARM(q + configurations(20, 6, seed=7, spread=0.2))
    found = ArmSolver(ARM, base=BASE)(as_pose7(pose), start, waypoints=10)
    assert found.shape == (20, 10, 7)
    assert (found[..., -1] == GRIPPER).all()
    reached, begin = world(ARM, found), world(ARM, start)
    share = torch.arange(1, 11, dtype=DOUBLE).view(10, 1) / 10
    straight = begin[:, None, :3, 3] + share * (pose - begin)[:, None, :3, 3]
    assert (reached[..., :3, 3] - straight).norm(dim=-1).max() < 1.1e-4
    whole = turn_off(begin, pose).unsqueeze(1)
    turned = turn_off(begin.unsqueeze(1), reached)
    assert (turned - share * whole).norm(dim=-1).max() < 0.01
    assert found[..., :6].diff(dim=1).abs().max() < 0.3


def test_a_mask_holds_at_every_waypoint():
    start, pose = problem(10, seed=8, near=0.2)
    level = pose.clone()
    level[:, :3, :3] = world(ARM, start)[:, :3, :3]
    mask = torch.tensor([1.0, 1.0, 0.0], dtype=DOUBLE).expand(10, 3)
    result = ArmSolver(ARM, base=BASE).solve(as_pose7(level), start, orientation_mask=mask, waypoints=8)
    solved = result.status == IKStatus.SOLVED
    assert solved.double().mean() > 0.8
    off = turn_off(BASE @ ARM(result.q), level.unsqueeze(1))[..., :2].norm(dim=-1)
    assert off[solved].max() < 1.1 * math.radians(0.1)


def test_what_cannot_be_reached_is_said_and_the_rest_is_not_disturbed():
    start, pose = problem(6, seed=9)
    pose[2, :3, 3] += 5.0
    target = as_pose7(pose)
    target[4, 0] = math.nan
    start[5, 1] = math.inf
    result = ArmSolver(ARM, base=BASE).solve(target, start)
    assert (result.status[[0, 1, 3]] == IKStatus.SOLVED).all()
    assert result.status[2] not in (IKStatus.SOLVED, IKStatus.INVALID)
    assert (result.status[[4, 5]] == IKStatus.INVALID).all()
    alone = ArmSolver(ARM, base=BASE).solve(target[3:4], start[3:4])
    assert torch.equal(alone.q, result.q[3:4])


@pytest.mark.parametrize("batch", [(), (2, 3), (0,)])
@pytest.mark.parametrize("waypoints", [None, 4])
def test_batch_dimensions_are_free(batch, waypoints):
    start, pose = problem(max(1, math.prod(batch)))
    start, pose = start[: math.prod(batch)].reshape(*batch, 7), pose[: math.prod(batch)].reshape(*batch, 4, 4)
    found = ArmSolver(ARM, base=BASE)(as_pose7(pose), start, waypoints=waypoints)
    assert found.shape == ((*batch, 7) if waypoints is None else (*batch, waypoints, 7))


def test_torchrls_own_macro_actions_run_by_it():
    from tensordict import TensorDict

    start, pose = problem(5, seed=10, near=0.2)
    target = as_pose7(pose)
    transform_ = torchrl_envs.URScriptPrimitiveTransform(cartesian_solver=ArmSolver(ARM, base=BASE), macro_steps=6)
    for path in ("joint", "cartesian"):
        macro = torchrl_envs.RobotMacroAction.reach_pose(
            position=target[:, :3].float(), quaternion=target[:, 3:].float(), steps=6, path=path
        )
        seen = TensorDict(
            {"action": macro, "robot_qpos": start[:, :6].float(), "gripper_qpos": torch.zeros(5, 2)}, batch_size=[5]
        )
        actions = transform_.inv(seen)["action"]
        assert actions.shape == (5, 6, 7)
        reached = world(ARM, actions[:, 5].double())
        assert (reached - pose)[:, :3, 3].norm(dim=-1).max() < 1.5e-4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ArmSolver("ur5"), r"arm must be an Arm, such as Arm.ur5\(\) or Arm.from_urdf\(...\), got str"),
        (lambda: ArmSolver(ARM, base=[[1.0]]), r"base must be a pose of shape \(4, 4\), got"),
        (lambda: ArmSolver(ARM, base=torch.zeros(4, 4)), r"base must be a pose of shape \(4, 4\), got"),
        (lambda: ArmSolver(ARM, base=torch.eye(4, dtype=torch.int64)), r"base must be a pose of shape \(4, 4\)"),
        (lambda: ArmSolver(ARM, position_tolerance=0.0), "position_tolerance must be >= 1e-12"),
        (lambda: ArmSolver(ARM, iterations=0), "iterations must be >= 1"),
    ],
)
def test_a_mistake_in_its_making_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target_pose": torch.zeros(2, 6)}, r"target_pose must have shape \(\*B, 7\), got \(2, 6\)"),
        ({"start_action": torch.zeros(2, 6)}, r"start_action must have shape \(\*B, 2, 7\), got \(2, 6\)"),
        ({"start_action": torch.zeros(3, 7)}, r"start_action must have shape \(\*B, 2, 7\), got \(3, 7\)"),
        ({"orientation_mask": torch.zeros(3)}, r"orientation_mask must have shape \(\*B, 2, 3\), got \(3,\)"),
        ({"target_pose": torch.zeros(2, 7, device="meta")}, "target_pose is on meta, but the arm is on cpu"),
        ({"waypoints": 0}, "waypoints must be >= 1, got 0"),
    ],
)
def test_a_mistake_is_named(options, message):
    with pytest.raises(InputError, match=message):
        ArmSolver(ARM)(**{"target_pose": torch.zeros(2, 7), "start_action": torch.zeros(2, 7), **options})
