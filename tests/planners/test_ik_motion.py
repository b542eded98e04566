import math

import pytest
import torch

from tests.planners.follower import APPROACH, BASE, DOUBLE, MIDDLE, SCENE, after, goals, home, observe, tool
from torchdyn_plan.envs.reaching import ReachingTask
from torchdyn_plan.kinematics import upright_error
from torchdyn_plan.planners import IKPlanner
from torchdyn_plan.planners.approach import Approach, tool_target, way_to


@pytest.mark.parametrize("height", [0.0, 0.3, -0.4])
def test_actions_stay_within_the_speed_limits_and_angles_within_theirs(height):
    arm = IKPlanner().arm
    random = torch.Generator().manual_seed(2)
    joint_pos = arm.lower + (arm.upper - arm.lower) * torch.rand(500, 6, generator=random)
    joint_pos[::7] = arm.upper
    joint_pos[1::7] = arm.lower - 0.01
    goal = (torch.rand(500, 3, generator=random) * 2 - 1) * 3 + torch.tensor([0.0, 0.0, height])
    path = IKPlanner().path(joint_pos, goal)
    assert path.isfinite().all()
    assert path.abs().max() <= 1.0 + 1e-5
    assert path.abs().max() > 0.9
    way = joint_pos.unsqueeze(1) + (path * arm.speed_limit * SCENE.control_step).cumsum(1)
    assert (way <= arm.upper + 1e-5).all()
    assert (way >= arm.lower - 1e-5)[:, -1].all()


def test_a_goal_on_the_table_is_approached_above_the_ball_and_dropped_on_at_the_end():
    goal = goals(40)
    path, _ = after(observe(home(40), goal), IKPlanner(), 250)
    place = tool(path)
    away = (place[..., :2] - goal[:, :2]).norm(dim=-1)
    far = away > APPROACH.drop_distance + 0.015
    assert place[..., 2][far].min() > 2 * SCENE.ball_radius
    assert away[-1].max() < 0.005
    torch.testing.assert_close(
        place[-1, :, 2], torch.full((40,), APPROACH.down_height, dtype=torch.float64), atol=2e-3, rtol=0
    )  # fmt: skip
    assert upright_error(DOUBLE.arm(path[-1].double())[..., :3, :3]).abs().max() < 0.02


def test_a_box_that_is_down_lifts_before_it_moves_sideways():
    _, td = after(observe(home(1), MIDDLE), IKPlanner(), 250)
    goal = MIDDLE + torch.tensor([[0.2, 0.2, 0.0]])
    down = tool(td["joint_pos"])
    path, _ = after(td.set("goal", goal), IKPlanner(), 250)
    place = tool(path)
    low = place[..., 2] < APPROACH.clear_height - 0.02
    beside = (place - goal)[..., :2].norm(dim=-1) > APPROACH.drop_distance + 0.015
    assert bool(low[0, 0])
    assert (place - down)[low & beside][:, :2].norm(dim=-1).max() < 0.003
    assert (place[-1] - goal)[..., :2].norm() < 0.005


def test_a_goal_above_the_table_is_held():
    # The arm's reach shrinks with height: at 0.2 m by three centimetres.
    goal = goals(40, height=0.2, margin=0.05)
    path, _ = after(observe(home(40), goal), IKPlanner(), 300)
    assert (tool(path[-50:]) - goal).norm(dim=-1).max() < 0.005


def test_a_goal_where_the_tool_is_moves_nothing():
    joint_pos = home(1, dtype=torch.float64)
    action = DOUBLE(observe(joint_pos, tool(joint_pos)))["action"]
    assert action.abs().max() < 1e-2


def placed(goal, approach=APPROACH):
    """Place of the box mouth in the world, and whether the goal is on the table."""
    x, y, height, on_table = tool_target(goal.unbind(-1), approach)
    return torch.stack([x + approach.base_pos[0], y + approach.base_pos[1], height], dim=-1), on_table


def target(goal, **approach):
    return placed(torch.tensor(goal), Approach(**approach))[0]


def test_goals_by_the_cushion_are_clamped_to_where_the_box_clears_it():
    for goal in ([SCENE.half_side, -0.5, 0.0], [0.0, SCENE.half_side, 0.0], [-9.0, -9.0, 0.1], [9.0, 0.0, 0.0]):
        place = target(goal)
        assert place[:2].abs().max() <= APPROACH.half_extent + 1e-6
        assert place[:2].abs().max() + SCENE.box_outer <= SCENE.half_side
    pulled_in = target([APPROACH.half_extent, -APPROACH.half_extent, 0.0], max_radius=0.5)
    assert pulled_in[:2].abs().max() <= APPROACH.half_extent + 1e-6


def test_goals_out_of_reach_are_clamped_along_their_direction_from_the_base():
    for goal in ([0.2, 0.7, 0.0], [-0.1, 0.6, 0.2], [0.0, -0.74, 0.0]):
        way, wanted = target(goal)[:2] - BASE[:2], torch.tensor(goal[:2]) - BASE[:2]
        assert APPROACH.min_radius - 1e-6 <= way.norm() <= APPROACH.max_radius + 1e-6
        torch.testing.assert_close(way / way.norm(), wanted / wanted.norm())


def test_goals_within_reach_are_kept_and_only_those_on_the_table_put_down():
    goal = torch.cat([goals(20), goals(20, height=APPROACH.table_height), goals(20, height=0.2)])
    place, on_table = placed(goal)
    assert on_table.tolist() == [True] * 40 + [False] * 20
    torch.testing.assert_close(place[:, :2], goal[:, :2])
    torch.testing.assert_close(place[:40, 2], torch.full((40,), APPROACH.down_height))
    torch.testing.assert_close(place[40:, 2], goal[40:, 2])


@pytest.mark.parametrize(
    ("end", "expected"), [((0.0, 0.6, 0.2), (0.0, 0.6 * math.pi / 2, 0.0)), ((0.8, 0.0, 0.1), (0.2, 0.0, -0.1))]
)
def test_the_way_sideways_turns_and_reaches_about_the_arms_axis(end, expected):
    start, end = torch.tensor([0.6, 0.0, 0.2]), torch.tensor(end)
    way = torch.stack(way_to(start.unbind(), end.unbind(), torch.tensor(False), APPROACH))
    torch.testing.assert_close(way, torch.tensor(expected), atol=1e-6, rtol=0)


def test_random_goals_on_the_table_are_all_reached_in_simulation():
    task, goal = ReachingTask(IKPlanner(), 64, num_threads=1), goals(64)
    reached = torch.zeros(64, dtype=torch.bool)
    for _ in range(400):
        task.step(goal)
        reached |= task.is_reached(goal)
    assert reached.all(), goal[~reached]
    assert task.is_reached(goal).all()
