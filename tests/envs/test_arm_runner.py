"""Robots of any environment driven to goals, its targets left alone."""

import pytest
import torch
from tensordict import TensorDict

from tests.envs.points import STRIDE, PointEnv
from torchdyn_plan.envs import EnvRunner
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import ProportionalController

GOALS = torch.tensor([[0.55, 0.0, 0.0], [0.0, -0.25, 0.0], [3.0, 0.0, 0.0]])


def make_runner(planner=None):
    planner = planner or ProportionalController(gain=1.0 / STRIDE)
    return EnvRunner(planner, PointEnv(3, max_steps=4), radius=0.02)


def arrivals(runner, steps=20):
    found = torch.full((3,), -1)
    for step in range(steps + 1):
        found = torch.where((found < 0) & runner.is_reached(GOALS), step, found)
        runner.step(GOALS)
    return found.tolist()


def test_arrivals_are_what_the_speed_says_however_long_episodes_are():
    runner = make_runner()
    assert arrivals(runner) == [6, 3, -1]
    runner.reset()
    assert torch.equal(runner.robot_state, torch.zeros(3, 3))
    assert arrivals(runner) == [6, 3, -1]


def test_the_planner_is_shown_goal_step_and_its_own_memory():
    seen = []

    def planner(td):
        seen.append(td.clone())
        counted = td["plan", "counted"] + 1 if "plan" in td.keys() else torch.ones(3)  # noqa: SIM118
        td["plan"] = TensorDict({"counted": counted}, [3])
        return td.set("action", torch.zeros(3, 3))

    runner = make_runner(planner)
    for step in range(3):
        runner.step(GOALS)
        assert torch.equal(seen[-1]["goal"], GOALS)
        assert torch.equal(seen[-1]["desired_goal"], GOALS)
        assert seen[-1]["step_count"].tolist() == [step] * 3
    assert seen[-1]["plan", "counted"].tolist() == [2] * 3
    runner.reset()
    runner.step(GOALS)
    assert "plan" not in seen[-1].keys()  # noqa: SIM118


def test_a_radius_that_is_none_is_refused():
    with pytest.raises(InputError, match="radius"):
        EnvRunner(ProportionalController(gain=1.0), PointEnv(), radius=-1.0)
