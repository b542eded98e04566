"""IKPlanner with poses and with an acceleration, on a UR5 that follows its joint speeds at once."""

import math

import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, quat_matrix, rotation_vector
from torchdyn_plan.kinematics.dls import braked_step
from torchdyn_plan.kinematics.quaternions import matrix_quat
from torchdyn_plan.planners import DynamicPlanner, IKPlanner, TargetPursuit, TurnedToGoal, WithTarget

STEP = 0.02
ARM = Arm.ur5(tool_length=0.1)
HOME = torch.tensor([[-1.4, -1.6, 2.0, -2.0, -1.5, 0.2], [0.3, -1.2, 1.5, -1.8, -1.6, -0.4]])


def drive(planner, goals, joints=HOME):
    """Joint angles ``(T + 1, N, 6)`` on the way to the goals of each step, (T, N, 7 or 3)."""
    state, path = TensorDict(batch_size=[len(joints)]), [joints]
    for step, goal in enumerate(goals):
        state.update({"joint_pos": path[-1], planner.goal_key: goal, "step_count": torch.full((len(joints), 1), step)})
        with torch.no_grad():
            planner(state)
        path.append(path[-1] + STEP * ARM.speed_limit * state["action"])
    return torch.stack(path)


def pose_goal(joints, offset=(0.0, 0.0, 0.0)):
    """The pose of the tool at some joints, moved by an offset, as ``goal_pose``."""
    pose = ARM(joints)
    return torch.cat([pose[:, :3, 3] + torch.tensor(offset), matrix_quat(pose[:, :3, :3])], dim=-1)


def turn_left(joints, goal):
    """Angle between tool and goal [rad]."""
    return rotation_vector(quat_matrix(goal[..., 3:]) @ ARM(joints)[:, :3, :3].mT).norm(dim=-1)


def planner_of(**settings):
    return IKPlanner(ARM, control_step=STEP, **({"approach": TurnedToGoal(), "acceleration": 8.0} | settings))


def test_the_tool_comes_to_a_pose_and_rests_there():
    goal = pose_goal(HOME + 0.3)
    path = drive(planner_of(), goal.expand(80, 2, 7))
    assert (ARM(path[-1])[:, :3, 3] - goal[:, :3]).norm(dim=-1).max() < 1e-3
    assert turn_left(path[-1], goal).max() < 2e-3
    assert (path[-1] - path[-2]).abs().max() < 1e-4


def test_a_braked_step_ends_at_rest_at_its_goal_and_never_brakes_harder_than_it_may():
    way = torch.tensor([[1.5, -0.3], [0.002, 0.001]], dtype=torch.float64)
    limit, brake = torch.tensor([0.05, 0.04]).double(), torch.tensor([0.003, 0.006]).double()
    steps = []
    for _ in range(80):
        steps.append(braked_step(way, limit, brake))
        way = way - steps[-1]
    steps = torch.stack(steps)
    assert way.abs().max() < 1e-5
    assert (steps * steps[0].sign() >= 0.0).all()
    assert (steps.abs() <= limit + 1e-12).all()
    assert (-steps.abs().diff(dim=0) <= brake + 1e-9).all()
    assert steps[:, 0, 0].max() > 0.99 * limit[0]
    # Joints arrive together: the way is straight.
    torch.testing.assert_close(steps[:, 0, 1], -0.2 * steps[:, 0, 0], rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("rest", [0.0, 1e-9, -1e-7])
def test_a_joint_that_takes_no_part_holds_up_no_other(rest):
    limit, brake = torch.full((3,), 0.02), torch.full((3,), 8e-4)
    alone = braked_step(torch.tensor([0.5, -0.2]), limit[:2], brake[:2])
    step = braked_step(torch.tensor([0.5, -0.2, rest]), limit, brake)
    torch.testing.assert_close(step[:2], alone)
    assert step[2].abs() <= abs(rest)


@pytest.mark.parametrize("how", [{"acceleration": 8.0}, {"acceleration": None, "gain": 0.2}], ids=["brakes", "gain"])
def test_a_round_tool_turns_about_its_own_axis_as_its_joints_like(how):
    goal = pose_goal(HOME + torch.tensor([0.4, 0.2, -0.3, 0.2, 0.4, 1.5]))
    planner = planner_of(approach=TurnedToGoal(symmetry=0), **how)
    path = drive(planner, goal.expand(80, 2, 7))
    end = ARM(path[-1])
    assert (end[:, :3, 3] - goal[:, :3]).norm(dim=-1).max() < 2e-3
    axis = quat_matrix(goal[:, 3:])[..., 2]
    assert ((end[:, :3, 2] * axis).sum(-1) > 0.9999).all()
    # The last joint turns the tool about its axis alone.
    torch.testing.assert_close(path[-1, :, 5], HOME[:, 5], rtol=0.0, atol=1e-4)
    found, reached = planner.goal_joints(HOME, goal)
    assert reached.all()
    torch.testing.assert_close(found[:, 5], HOME[:, 5], rtol=0.0, atol=1e-4)


def test_a_joint_with_next_to_nothing_to_go_does_not_stop_the_others():
    limit, brake = torch.tensor([0.05, 0.04]), torch.tensor([0.003, 0.006])
    first, second = braked_step(torch.tensor([[0.4, 1e-11], [0.4, 0.0]]), limit, brake)
    assert first[0] == second[0] > 0.04


def test_zeros_leave_the_tool_turned_as_it_is():
    goal = pose_goal(HOME, (0.05, -0.1, 0.05))
    free = torch.cat([goal[:, :3], torch.zeros(2, 4)], dim=-1)
    path = drive(planner_of(), free.expand(60, 2, 7))
    assert (ARM(path[-1])[:, :3, 3] - goal[:, :3]).norm(dim=-1).max() < 1e-3
    assert turn_left(path[-1], goal).max() < 0.02


@pytest.mark.parametrize(("symmetry", "angle"), [(2, math.pi), (4, math.pi / 2), (0, 0.7)])
def test_turns_that_are_alike_for_the_tool_need_none(symmetry, angle):
    pose = ARM(HOME)
    c, s = math.cos(angle), math.sin(angle)
    about_z = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    goal = torch.cat([pose[:, :3, 3], matrix_quat(pose[:, :3, :3] @ about_z)], dim=-1)
    entries = pose[:, :3].flatten(-2).unbind(-1)
    twist = torch.stack(TurnedToGoal(symmetry=symmetry).twist(entries, goal.unbind(-1)), dim=-1)
    assert twist.abs().max() < 1e-3
    whole = torch.stack(TurnedToGoal().twist(entries, goal.unbind(-1)), dim=-1)
    assert whole[:, 3:].norm(dim=-1).min() > 0.6


def test_a_goal_that_moves_is_followed_a_step_behind():
    start = pose_goal(HOME)
    velocity = torch.tensor([0.2, 0.1, -0.1, 0.0, 0.0, 0.0, 0.0])
    # It speeds up smoothly, and goes on.
    way = torch.linspace(0.0, 1.0, 40).clamp(max=1.0).cumsum(0).unsqueeze(-1).unsqueeze(-1) * STEP * velocity
    goals = start + way
    path = drive(planner_of(), goals)
    late = ARM(path[1:].flatten(0, 1))[:, :3, 3].view(40, 2, 3) - goals[..., :3]
    assert late[20:].norm(dim=-1).max() < 1.5e-3
    # By the gain alone it lags by several steps.
    lags = drive(IKPlanner(ARM, control_step=STEP), goals[..., :3])
    behind = ARM(lags[1:].flatten(0, 1))[:, :3, 3].view(40, 2, 3) - goals[..., :3]
    assert behind[-1].norm(dim=-1).min() > 8e-3


def test_its_arrival_model_knows_when_a_pose_is_reached():
    planner, joints = planner_of(), HOME
    goal = pose_goal(HOME + torch.tensor([0.6, 0.2, -0.3, 0.2, 0.1, 0.8]))
    state = torch.cat([joints, torch.zeros_like(joints)], dim=-1).unsqueeze(1)
    arrival = planner.arrival_model().arrival(state, goal.unsqueeze(1))
    path = drive(planner, goal.expand(100, 2, 7))
    left = torch.stack([turn_left(at, goal) + (ARM(at)[:, :3, 3] - goal[:, :3]).norm(dim=-1) for at in path])
    first = (left < 0.03).int().argmax(0)
    assert not arrival.never.any()
    # This robot is at its speed at once, which the model does not take for granted.
    assert (first.unsqueeze(-1) <= arrival.steps).all()
    assert (first.unsqueeze(-1) >= 0.5 * arrival.steps).all()
    twice = planner.arrival_model().arrival(state, torch.cat([goal, goal], -1).view(2, 2, 7))
    torch.testing.assert_close(twice.steps[:, :1], arrival.steps)


def test_what_cannot_be_is_named():
    with pytest.raises(InputError, match="compiled IKPlanner takes neither poses nor an acceleration"):
        planner_of(compiled=True)
    with pytest.raises(InputError, match="acceleration must be one number, or 6"):
        planner_of(acceleration=(1.0, 2.0))
    with pytest.raises(InputError, match="acceleration must be >="):
        planner_of(acceleration=-1.0)
    with pytest.raises(InputError, match="symmetry must be"):
        TurnedToGoal(symmetry=-1)
    with pytest.raises(InputError, match=r"goal_pose must have shape"):
        drive(planner_of(), torch.zeros(1, 2, 3))
    with pytest.raises(InputError, match="IKPlanner reads goal_pose: give the planner a turn"):
        DynamicPlanner(planner_of())


def test_pursuit_turns_the_tool_with_its_target():
    pursuit = TargetPursuit(planner_of(), turn=WithTarget(quat=(1.0, 0.0, 0.0, 0.0)))
    goal = pose_goal(HOME + 0.2)
    state = {"joint_pos": HOME, "step_count": torch.zeros(2, 1), "target_pos": goal[:, :3], "target_quat": goal[:, 3:]}
    found = pursuit(TensorDict(state, batch_size=[2]))
    torch.testing.assert_close(found["goal_pose"], goal)
    torch.testing.assert_close(found["action"], planner_of().step(HOME, goal)[0])
