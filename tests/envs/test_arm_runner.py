"""Robots of any environment driven to goals, its targets left alone."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.envs.points import STRIDE, PointEnv
from torchdyn_plan.envs import EnvRunner, FunctionRunner
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


def test_a_pose_is_shown_as_one_and_reached_as_its_function_says():
    seen, asked = [], []

    def planner(td):
        seen.append(td.clone())
        return td.set("action", torch.zeros(3, 3))

    def at_goal(joint_pos, goal):
        asked.append((joint_pos, goal))
        return goal[:, 3] > 0.5

    runner = EnvRunner(planner, PointEnv(3), at_goal=at_goal)
    runner._seen["joint_pos"] = torch.ones(3, 2)
    poses = torch.cat([GOALS, torch.eye(4)[:3]], dim=-1)
    assert runner.is_reached(poses).tolist() == [True, False, False]
    assert torch.equal(asked[0][0], torch.ones(3, 2))
    runner.step(poses)
    assert torch.equal(seen[0]["goal_pose"], poses)
    assert torch.equal(seen[0]["goal"], GOALS)
    with pytest.raises(InputError, match="either a radius or at_goal"):
        EnvRunner(planner, PointEnv(3), radius=0.02, at_goal=at_goal)


def test_a_radius_that_is_none_is_refused():
    with pytest.raises(InputError, match="radius"):
        EnvRunner(ProportionalController(gain=1.0), PointEnv(), radius=-1.0)


def points(**changes):
    """Points that functions move, a stride a step: `FunctionRunner`'s arguments."""
    place = torch.zeros(3, 3)

    def entries():
        return {"tool_pos": place.clone(), "robot_state": place.clone()}

    def start():
        place.zero_()
        return entries()

    def step(action):
        place.add_(STRIDE * action / action.norm(dim=-1, keepdim=True).clamp_min(1.0))
        return entries()

    return {"start": start, "step": step, "radius": 0.02} | changes


def test_functions_move_robots_as_an_environment_does():
    runner = FunctionRunner(ProportionalController(gain=1.0 / STRIDE), **points())
    assert arrivals(runner) == [6, 3, -1]
    runner.reset()
    assert torch.equal(runner.robot_state, torch.zeros(3, 3))
    assert arrivals(runner) == [6, 3, -1]


class PointVector:
    """Gymnasium's vector environments as far as a runner looks at them: points, and an end of their episodes."""

    def __init__(self, steps):
        self.steps, self.of = steps, points()

    def reset(self):
        self.count = 0
        return self._seen(self.of["start"]()), {}

    def step(self, action):
        self.count += 1
        ended = np.full(3, self.count >= self.steps)
        return self._seen(self.of["step"](torch.from_numpy(action))), np.zeros(3), ended & False, ended, {}

    @staticmethod
    def _seen(entries):
        place = entries["tool_pos"].double().numpy()
        return {"observation": place, "achieved_goal": place, "desired_goal": place}


def test_gymnasium_environments_move_robots_until_an_episode_ends():
    planner = ProportionalController(gain=1.0 / STRIDE)
    assert arrivals(FunctionRunner.of_gym(planner, PointVector(50), radius=0.02)) == [6, 3, -1]
    with pytest.raises(InputError, match="an episode of the environments ended within a sequence"):
        arrivals(FunctionRunner.of_gym(planner, PointVector(10), radius=0.02))


def test_functions_that_tell_too_little_are_refused():
    planner, place = ProportionalController(gain=1.0), torch.zeros(3, 3)
    with pytest.raises(InputError, match="what start returns lacks robot_state"):
        FunctionRunner(planner, **points(start=lambda: {"tool_pos": place}))
    with pytest.raises(InputError, match="tool_pos"):
        FunctionRunner(planner, **points(start=lambda: {"tool_pos": place, "robot_state": place[:2]}))
    runner = FunctionRunner(planner, **points(step=lambda action: {"robot_state": place}))
    with pytest.raises(InputError, match="what step returns lacks tool_pos"):
        runner.step(GOALS)
