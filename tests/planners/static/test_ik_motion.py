import pytest
import torch

from tests.planners.follower import APPROACH, DOUBLE, MIDDLE, SCENE, SINGLE, after, goals, home, observe, tool
from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.kinematics import upright_error


@pytest.mark.parametrize("height", [0.0, 0.3, -0.4])
def test_actions_stay_within_the_speed_limits_and_angles_within_theirs(height):
    arm = SINGLE.arm
    random = torch.Generator().manual_seed(2)
    joint_pos = arm.lower + (arm.upper - arm.lower) * torch.rand(500, 6, generator=random)
    joint_pos[::7] = arm.upper
    joint_pos[1::7] = arm.lower - 0.01
    goal = (torch.rand(500, 3, generator=random) * 2 - 1) * 3 + torch.tensor([0.0, 0.0, height])
    path = SINGLE.path(joint_pos, goal)
    assert path.isfinite().all()
    assert path.abs().max() <= 1.0 + 1e-5
    assert path.abs().max() > 0.9
    way = joint_pos.unsqueeze(1) + (path * arm.speed_limit * SCENE.control_step).cumsum(1)
    assert (way <= arm.upper + 1e-5).all()
    assert (way >= arm.lower - 1e-5)[:, -1].all()


def test_a_goal_on_the_table_is_approached_above_the_ball_and_dropped_on_at_the_end():
    goal = goals(40)
    path, _ = after(observe(home(40), goal), SINGLE, 250)
    place = tool(path)
    away = (place[..., :2] - goal[:, :2]).norm(dim=-1)
    far = away > APPROACH.drop_distance + 0.015
    assert place[..., 2][far].min() > 2 * SCENE.ball_radius
    assert away[-1].max() < 0.005
    down = torch.full((40,), APPROACH.down_height, dtype=torch.float64)
    torch.testing.assert_close(place[-1, :, 2], down, atol=2e-3, rtol=0)
    assert upright_error(DOUBLE.arm(path[-1].double())[..., :3, :3]).abs().max() < 0.02


def test_a_box_that_is_down_lifts_before_it_moves_sideways():
    _, td = after(observe(home(1), MIDDLE), SINGLE, 250)
    goal = MIDDLE + torch.tensor([[0.2, 0.2, 0.0]])
    down = tool(td["joint_pos"])
    path, _ = after(td.set("goal", goal), SINGLE, 250)
    place = tool(path)
    low = place[..., 2] < APPROACH.clear_height - 0.02
    beside = (place - goal)[..., :2].norm(dim=-1) > APPROACH.drop_distance + 0.015
    assert bool(low[0, 0])
    assert (place - down)[low & beside][:, :2].norm(dim=-1).max() < 0.003
    assert (place[-1] - goal)[..., :2].norm() < 0.005


def test_a_goal_above_the_table_is_held():
    # The arm's reach shrinks with height: at 0.2 m by three centimetres.
    goal = goals(40, height=0.2, margin=0.05)
    path, _ = after(observe(home(40), goal), SINGLE, 300)
    assert (tool(path[-50:]) - goal).norm(dim=-1).max() < 0.005


def test_a_goal_where_the_tool_is_moves_nothing():
    joint_pos = home(1, dtype=torch.float64)
    action = DOUBLE(observe(joint_pos, tool(joint_pos)))["action"]
    assert action.abs().max() < 1e-2


def test_random_goals_on_the_table_are_all_reached_in_simulation():
    runner, goal = TrapperArmRunner(SINGLE, 64, num_threads=1), goals(64)
    reached = torch.zeros(64, dtype=torch.bool)
    for _ in range(400):
        runner.step(goal)
        reached |= runner.is_reached(goal)
    assert reached.all(), goal[~reached]
    assert runner.is_reached(goal).all()
