import math

import pytest
import torch

from torchdyn_plan.envs import FetchSimulation
from torchdyn_plan.envs.fetch_reach.goal_motion import GoalStarts
from torchdyn_plan.tasks.fetch_reach.ceiling import FIRST_STRIDE, STRIDE, earliest_meeting, furthest, is_in_range

TOOL = FetchSimulation(1).start.tool_pos


def starts_at(*offsets):
    """Goals that start ``offsets`` from the gripper [m]."""
    place = TOOL + torch.tensor(offsets, dtype=torch.float64)
    return GoalStarts(place, torch.zeros(len(offsets), dtype=torch.float64))


def meet(*offsets, velocity, **settings):
    starts = starts_at(*offsets)
    return earliest_meeting(starts, motion="straight", velocity=velocity, num_threads=1, **settings).tolist()


def test_a_goal_that_comes_is_met_and_one_that_flees_is_not():
    assert meet((-0.1, 0.0, 0.0), (0.05, 0.0, 0.0), velocity=0.05) == [2, -1]


def test_a_resting_goal_is_met_as_soon_as_strides_reach_it():
    assert meet((0.0, 0.0, 0.0), (0.03, 0.0, 0.0), (0.1, 0.05, 0.0), (0.9, 0.0, 0.0), velocity=0.0) == [1, 1, 3, -1]


def test_the_order_of_events_shifts_the_goal_by_a_step():
    at = (-0.05, 0.0, 0.0)
    assert meet(at, velocity=0.05, threshold=0.002, steps=1) == [1]
    assert meet(at, velocity=0.05, threshold=0.002, steps=1, goal_first=False) == [-1]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_no_stride_is_longer_than_the_bound_says(axis, sign):
    simulation = FetchSimulation(1, num_threads=1)
    action = torch.zeros(1, 3)
    action[0, axis] = sign
    for step in range(1, 15):
        simulation.step(action)
        assert (simulation.tool_pos - TOOL).abs().max() <= furthest(step)
    assert furthest(1) == FIRST_STRIDE
    assert furthest(3) == pytest.approx(FIRST_STRIDE + 2 * STRIDE)


def test_range_is_judged_along_each_axis():
    place = TOOL + torch.tensor([[0.04, 0.04, 0.04], [0.05, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    assert is_in_range(place, TOOL, 1, 0.01).tolist() == [True, False, True]
    assert not is_in_range(torch.tensor([[3.0, 0.75, 0.5]]), TOOL.float(), 49, 0.01).item()
    assert math.isfinite(furthest(50))
