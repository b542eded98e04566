"""The planner's step against the same written out plainly, one operation after the other."""

import copy
import math

import pytest
import torch

from tests.planners.follower import APPROACH, SCENE, after, goals, home, observe
from torchdyn_plan.kinematics import Arm, dls_step, limited_step, upright_error
from torchdyn_plan.planners import IKPlanner
from torchdyn_plan.tasks.trapper.task import ik_planner

BASE = torch.tensor(APPROACH.base_pos, dtype=torch.float64)
ARM = Arm.ur5(tool_length=SCENE.tool_length, dtype=torch.float64)
LIMIT = ARM.speed_limit * 0.004


@pytest.fixture(scope="module")
def compiled():
    return ik_planner(compiled=True)


def plain_target(goal):
    a = APPROACH
    on_table = goal[..., 2] <= a.on_table_below
    place = goal[..., :2].clamp(-a.half_extent, a.half_extent) - BASE[:2]
    radius = place.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    place = (place * (radius.clamp(a.min_radius, a.max_radius) / radius) + BASE[:2]).clamp(
        -a.half_extent, a.half_extent
    )
    height = torch.where(on_table, a.down_height, goal[..., 2])
    return torch.cat([place, height.unsqueeze(-1)], dim=-1), on_table


def plain_way(tool, target, on_table):
    a = APPROACH
    x, y, z = tool.unbind(-1)
    goal_x, goal_y, goal_z = target.unbind(-1)
    radius = torch.hypot(x, y).clamp_min(1e-6)
    away = torch.hypot(goal_x - x, goal_y - y)
    forward = (torch.hypot(goal_x, goal_y) - radius) / radius
    turn = torch.atan2(x * goal_y - y * goal_x, x * goal_x + y * goal_y)
    side = torch.stack([x * forward - y * turn, y * forward + x * turn], dim=-1)
    far = ((away - a.drop_distance) / 0.015).clamp(0.0, 1.0)
    height, lift = z + BASE[2], a.travel_height - a.down_height
    wanted = goal_z + BASE[2] + torch.where(on_table, lift * far, 0.0)
    low = torch.maximum(far, (~on_table).to(far.dtype)) * (a.clear_height - height) / 0.02
    return torch.cat([side * (1.0 - low.clamp(0.0, 1.0)).unsqueeze(-1), (wanted - height).unsqueeze(-1)], dim=-1)


def plain_step(joint_pos, goal):
    joint_pos, goal = joint_pos.double(), goal.double()
    target, on_table = plain_target(goal)
    pose, jacobian = ARM.pose_and_jacobian(joint_pos)
    way = plain_way(pose[..., :3, 3], target - BASE, on_table)
    error = torch.cat([way, upright_error(pose[..., :3, :3])], dim=-1)
    step = torch.stack([one_step(*row) for row in zip(joint_pos, jacobian, error, strict=True)])
    return (step / LIMIT).clamp(-1.0, 1.0), joint_pos + step


def one_step(joint_pos, jacobian, error):
    """A row's step: of the joints that may move, and solved anew, twice at most, without those that may not."""
    free = list(range(6))
    for _ in range(3):
        whole = torch.zeros(6, dtype=torch.float64)
        whole[free] = dls_step(jacobian[:, free], error, 0.02)
        low, high = ARM.lower - joint_pos, ARM.upper - joint_pos
        free = [i for i in free if not ((low[i] >= 0 and whole[i] < 0) or (high[i] <= 0 and whole[i] > 0))]
    return torch.clamp(limited_step(whole, LIMIT, 0.25), low, high)


def situations(count=2000):
    random = torch.Generator().manual_seed(0)
    joint_pos = home(count, spread=0.3)
    joint_pos[::5] = (torch.rand(len(joint_pos[::5]), 6, generator=random) * 2 - 1) * 2 * math.pi
    goal = (torch.rand(count, 3, generator=random) * 2 - 1) * torch.tensor([0.9, 0.9, 0.1])
    return joint_pos, goal


def test_the_step_is_the_plain_one():
    joint_pos, goal = situations()
    double = IKPlanner(ARM, approach=APPROACH).step(joint_pos.double(), goal.double())
    for value, expected in zip(double, plain_step(joint_pos, goal), strict=True):
        torch.testing.assert_close(value, expected, atol=1e-9, rtol=0)


@pytest.mark.slow
def test_the_compiled_step_is_the_plain_one(compiled):
    joint_pos, goal = situations()
    expected, eager = plain_step(joint_pos, goal), ik_planner().step(joint_pos, goal)
    for value, plain, other in zip(compiled.step(joint_pos, goal), expected, eager, strict=True):
        error, usual = (value.double() - plain).abs(), (other.double() - plain).abs()
        assert error.median() < 1e-5
        assert error.quantile(0.99) < 3 * usual.quantile(0.99) + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_the_compiled_planner_takes_any_batch(compiled, batch):
    joint_pos, goal = home(*batch, spread=0.1), goals(max(math.prod(batch), 1))[: math.prod(batch)].reshape(*batch, 3)
    path, _ = after(observe(joint_pos, goal), compiled, 12)
    expected, _ = after(observe(joint_pos, goal), ik_planner(), 12)
    torch.testing.assert_close(path, expected, atol=1e-4, rtol=0)
    assert path.shape == (12, *batch, 6)


@pytest.mark.slow
def test_compiled_rows_do_not_depend_on_their_batch(compiled):
    joint_pos, goal = situations(300)
    whole = compiled.step(joint_pos, goal)
    for rows in (slice(0, 1), slice(3, 5), slice(4, 21), slice(290, 300)):
        for part, other in zip(compiled.step(joint_pos[rows], goal[rows]), whole, strict=True):
            assert torch.equal(part, other[rows])


@pytest.mark.slow
def test_a_compiled_planner_is_copied(compiled):
    joint_pos, goal = situations(4)
    assert torch.equal(copy.deepcopy(compiled).step(joint_pos, goal)[0], compiled.step(joint_pos, goal)[0])
